"""The rules of the answer, fitted: `fit_NAME.py` makes the parameters of the box's rule
`answer/NAME.py` from sweeps. Heads and embeddings in closed form serve several of them."""
