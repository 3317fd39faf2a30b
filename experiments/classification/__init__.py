"""Data, training and evaluation of the ground classifier: `touchdown dataset`, `train`, `evaluate`,
`quantize`, `ensemble`, `classify`. Produces images and labels; networks live in
``landing.classification``."""
