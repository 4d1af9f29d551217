"""Palpate's desktop: trains, judges and exports the model bundles that the appliance runs.

The library's classes can be imported from here; see palpate_train.library.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from palpate_train.library import BundleClassifier as BundleClassifier
    from palpate_train.library import PalpateClassifier as PalpateClassifier
    from palpate_train.library import load_bundle as load_bundle

LIBRARY = ("BundleClassifier", "PalpateClassifier", "load_bundle")


def __getattr__(name: str) -> Any:
    """The library is imported when it is used, because the commands do not need it."""
    if name in LIBRARY:
        return getattr(import_module("palpate_train.library"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
