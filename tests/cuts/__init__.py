"""The disk after a kill or a loss of power at any moment: `python -m tests.cuts`."""
