"""Names of the directions in which a finger slides over a surface."""

DIRECTIONS = ("rows+", "rows-", "cols+", "cols-")
"""Towards higher or lower rows or columns."""
