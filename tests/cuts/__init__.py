"""Cuts: the contents of the disk after a program is killed, or after the power fails, at any
moment.

`python -m tests.cuts` runs the whole campaign; tests/campaigns/test_cuts.py runs a small part of
it.
"""
