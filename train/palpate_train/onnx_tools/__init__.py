"""Builds, quantizes, compares and measures ONNX graphs."""
