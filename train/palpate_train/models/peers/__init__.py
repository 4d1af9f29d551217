"""The methods that the recipe is compared with: the paper's CNN, its baselines, and later ones."""
