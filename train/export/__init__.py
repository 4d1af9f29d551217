"""From a fit to a bundle, and what it costs."""
