"""Ground classification: predicts the class of the ground in an aerial image.

The paper calls it place recognition, which in SLAM means loop closure. ``networks`` and
``learning`` load torch; in flight the shipped network runs in ONNX Runtime.
"""
