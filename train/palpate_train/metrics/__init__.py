"""Scores of answers and of bundles, their intervals, and calibration of probabilities."""
