"""Demo and bench on simulated devices, and tools for the skin alone."""
