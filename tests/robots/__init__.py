"""Delays of each connection to a robot: docs/data/robots-latency.json."""
