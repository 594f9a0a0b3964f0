"""Networks, training, evaluation and ONNX export for nightfix."""
