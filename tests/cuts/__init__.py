"""What a program leaves on the disk when it is killed, or when the power goes, at any moment. In:
commands and what must hold after them. Out: moments, the disks that they may leave, and what is
wrong with these.

`python -m tests.cuts` runs the whole campaign; tests/campaigns/test_cuts.py a small part of it with
each run of the tests.
"""
