"""Names and descriptions of methods for pictures and pages."""

from __future__ import annotations

from palpate_train.models.methods import PACKAGED, SHIPPED
from palpate_train.models.recipe.sizes import SIZES

OURS = "Palpate"
NAMES = {
    SHIPPED: (
        f"{OURS}, all views",
        "filters, spectra, relations of taxels and trained layers, as the training sweeps ask for; "
        "int8",
    ),
    PACKAGED: (
        f"{OURS}, for a skin put back",
        "the packaged bundle’s recipe, `fit --reattached`: altered copies shown to every head, "
        "filters only where they are better; int8",
    ),
    **{
        f"{SHIPPED}-{name}": (f"{OURS}, {name}", f"{size.about} at most; int8")
        for name, size in SIZES.items()
    },
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


def plain_name(method: str) -> str:
    """The name of a method for people."""
    return NAMES[method][0] if method in NAMES else method


def about(method: str) -> str:
    """A method in a line, or ""."""
    return NAMES[method][1] if method in NAMES else ""


def short_name(method: str) -> str:
    """The name of a method in a picture, where all of ours have one colour."""
    if method == PACKAGED:
        return "packaged recipe"
    return plain_name(method).removeprefix(f"{OURS}, ")
