"""Ground classification: predicts the class of the ground in an aerial image.

``networks`` and ``learning`` load torch; in flight the shipped network runs in ONNX Runtime.
"""
