"""Names and descriptions of methods for pictures and pages."""

from __future__ import annotations

from train.models import methods
from train.models.methods import SHIPPED

OURS = "Palpate"
TRAINED = "compact"
"""Our trained networks. The name in commands contains a bound of the weights, so people see the
number of weights."""
NAMES = {
    SHIPPED: (
        f"{OURS}, as shipped",
        "what the box runs: filters, spectra and trained layers, as the training sweeps ask for; "
        "int8",
    ),
    "default-reattached": (
        f"{OURS}, for a skin put back",
        "the packaged bundle’s recipe, `fit --reattached`: altered copies shown to every head, "
        "filters only where they are better; int8",
    ),
    "filter-bank": (
        f"{OURS}, filters alone",
        "a part of what is shipped: random filters and a head in closed form, nothing trained",
    ),
    "compact-bands": (
        f"{OURS}, spectrum alone",
        "a part of what is shipped: the spectrum that all taxels share",
    ),
    "minirocket": (
        "MiniRocket",
        "10,000 features of fixed small filters and ridge regression: the usual quick choice for "
        "time series",
    ),
    "minirocket-augmented": (
        "MiniRocket, augmented",
        "the same, trained on altered copies of each sweep too, as ours is",
    ),
    "multirocket-hydra": (
        "MultiRocket-Hydra",
        "among the most accurate methods for time series on public archives",
    ),
    "quant": ("QUANT", "quantiles of intervals and extremely randomised trees"),
    "ds-cnn": (
        "DS-CNN",
        "a small network of separable convolutions, as deployed on microcontrollers",
    ),
    "lite": ("LITE", "a small network with some filters made by hand"),
    "edge-spectral": (
        "spectra + small net",
        "spectra, statistics and two small dense layers: the recipe of edge-computing tools",
    ),
    "paper-cnn": ("paper’s CNN, raw", "the convolutional network of the paper, on raw counts"),
    "paper-cnn-centred": (
        "paper’s CNN",
        "the convolutional network of the paper, behind a layer that removes each taxel’s mean",
    ),
    "tactnet2": ("TactNet-II", "a later network of the paper’s group, as far as it is published"),
    "L-gauss": (
        "L, Gauss",
        "the paper’s features of whole sweeps, a normal distribution for each material",
    ),
    "L-knn": ("L, neighbours", "the paper’s features of whole sweeps, four nearest neighbours"),
    "L-svm": ("L, SVM", "the paper’s features of whole sweeps, a support vector machine"),
    "H-knn": (
        "H, neighbours",
        "the paper’s features of short pieces of a sweep, four nearest neighbours",
    ),
    "H-svm": (
        "H, SVM",
        "the paper’s features of short pieces of a sweep, a support vector machine",
    ),
    "st-hmp": ("ST-HMP", "codes of learned dictionaries, pooled"),
}


FAMILIES = {
    "train.models.recipe.default": OURS,
    "train.models.recipe.methods": OURS,
    "train.models.peers.baselines": "L and H",
    "train.models.peers.paper_cnn": "deep networks",
    "train.models.peers.recurrent": "deep networks",
    "train.models.peers.minirocket": "MiniRocket",
    "train.models.peers.minirocket_augmented": "MiniRocket",
    "train.models.peers.aeon_peers": "aeon",
    "train.models.peers.ds_cnn": "edge tools",
    "train.models.peers.lite": "edge tools",
    "train.models.peers.edge_spectral": "edge tools",
}
OTHERS = "related work"
"""The origin of a method, by its module."""


def plain_name(method: str, weights: int | None = None) -> str:
    """The name of a method for people. A trained network of ours has its number of `weights`, if
    that is known."""
    if method in NAMES:
        return NAMES[method][0]
    if method.partition("-")[0] == TRAINED:
        return f"{OURS}, {size(weights)} weights" if weights else f"{OURS}, trained layers alone"
    return method


def about(method: str) -> str:
    """A method in a line; "" if there is no description."""
    if method in NAMES:
        return NAMES[method][1]
    return (
        "trained layers and a spectrum, without the filters"
        if method.partition("-")[0] == TRAINED
        else ""
    )


def size(weights: int) -> str:
    """A number of weights in words: 28638 is "29 k", 2248 is "2.2 k"."""
    return f"{weights / 1000:.{0 if weights >= 9950 else 1}f} k"


def family(method: str) -> str:
    """The origin of a method: OURS for ours."""
    return FAMILIES.get(methods.module_of(method), OTHERS) if method in methods.every() else OTHERS
