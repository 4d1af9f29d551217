"""Features of prior work, which the box does not compute, and all feature sets by name."""
