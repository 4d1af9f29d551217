"""The default recipe of the box: features, candidates, choice, trained stages, and their fit."""
