"""The library: our recipe as a scikit-learn classifier, and bundles as classifiers.

`import palpate` imports this package, where palpate-train is installed; in a checkout,
`from train import PalpateClassifier` does the same.
"""

from train.library.bundles import BundleClassifier as BundleClassifier
from train.library.bundles import load_bundle as load_bundle
from train.library.estimator import PalpateClassifier as PalpateClassifier

__all__ = ["BundleClassifier", "PalpateClassifier", "load_bundle"]
