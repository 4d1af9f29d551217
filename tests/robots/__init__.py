"""Measures what each connection to a robot costs: docs/robots/latency.json, the table of
docs/robots/README.md."""
