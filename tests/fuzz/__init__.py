"""Fuzzing of all input from outside: targets (promises about any bytes), seeds, mutators, a runner,
a saved corpus.

`python -m tests.campaigns fuzz` runs it under Atheris; tests/fuzz/test_fuzzed_input.py
replays the corpus and all former crashes in each run of the tests, without Atheris.
"""
