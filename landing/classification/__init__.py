"""Ground classification: predicts the class of the ground in an aerial image.

``networks`` and ``learning`` load torch; in flight the shipped network runs in ONNX Runtime.
"""

import os

# ONNX Runtime reports its use to its maker, and keeps a database below the user's home directory,
# from its import on.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
