"""Checks a model file before onnxruntime may open it."""
