"""Training, checkpoints, export and quantisation of networks; needs torch and onnx."""
