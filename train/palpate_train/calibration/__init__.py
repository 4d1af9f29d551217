"""Closed-form statistics of features: heads, early answers, unknown materials, displaced
contacts."""
