"""Right answers of how many, and how sure that is."""
