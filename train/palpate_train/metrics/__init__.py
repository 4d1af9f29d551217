"""Accuracy, its intervals, and calibration of probabilities."""
