"""Accuracy with its interval."""
