"""Computed from the raw counts of a sweep: the paper's features, and the position of the
contact."""
