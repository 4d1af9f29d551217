"""Measures what each connection to a robot costs: docs/data/robots-latency.json, the table of
docs/robots/README.md."""
