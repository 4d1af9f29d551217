"""Features of prior work, which the box does not compute."""
