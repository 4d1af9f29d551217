"""What the box demands of a model file before onnxruntime may open it."""
