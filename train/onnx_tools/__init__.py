"""ONNX graphs: written, quantized, compared, counted."""
