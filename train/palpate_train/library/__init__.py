"""The library: our recipe as a scikit-learn classifier, and bundles as classifiers.

`import palpate` imports this package, where palpate-train is installed; in a checkout,
`from palpate_train import PalpateClassifier` does the same.
"""

from palpate_train.library.bundles import BundleClassifier as BundleClassifier
from palpate_train.library.bundles import load_bundle as load_bundle
from palpate_train.library.estimator import PalpateClassifier as PalpateClassifier

__all__ = ["BundleClassifier", "PalpateClassifier", "load_bundle"]
