"""Measures the delay of each connection to a robot: docs/data/robots-latency.json, the table of
docs/robots/README.md."""
