"""The files that a program leaves on the disk when it is killed, or when the power fails, at any
moment.

`python -m tests.cuts` runs the whole campaign; tests/campaigns/test_cuts.py a small part of it with
each run of the tests.
"""
