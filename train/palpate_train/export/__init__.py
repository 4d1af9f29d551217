"""The way from a fit to a bundle, and the cost of the bundle."""
