"""Methods of the paper, of its neighbours and of the field, for comparisons.

`palpate-train evaluate --method NAME` finds them through the entry-point group
"palpate_train.methods".
"""

MODULES = tuple(
    f"{__name__}.{name}"
    for name in (
        "baselines",
        "prior_work",
        "sthmp",
        "minirocket",
        "minirocket_augmented",
        "aeon_peers",
        "ds_cnn",
        "lite",
        "edge_spectral",
        "paper_cnn",
        "recurrent",
    )
)
"""Each defines METHODS, or methods(effort) if it trains networks."""
