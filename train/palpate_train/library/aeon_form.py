"""Our recipe as a classifier of aeon, for its pipelines, ensembles and benchmarks. Needs aeon, the
extra `peers`."""

from __future__ import annotations

from inspect import signature
from typing import Any

from aeon.classification.base import BaseClassifier

from palpate.core.sweep_set import Array
from palpate_train.library.estimator import PalpateClassifier


class AeonPalpateClassifier(BaseClassifier):  # type: ignore[misc]  # aeon has no types
    """PalpateClassifier with aeon's base class, without groups. X: [n, channels, time] of sweeps of
    equal length. The parameters are as for PalpateClassifier.

    After `fit`: palpate_ (the fitted PalpateClassifier).
    """

    _tags = {  # noqa: RUF012  # aeon's name and form
        "X_inner_type": "numpy3D",
        "capability:multivariate": True,
        "algorithm_type": "feature",
    }

    def __init__(self, *values: Any, **parameters: Any) -> None:
        for name, value in PalpateClassifier(*values, **parameters).get_params().items():
            setattr(self, name, value)
        super().__init__()

    # scikit-learn reads the parameters from it
    __init__.__signature__ = signature(PalpateClassifier.__init__)  # type: ignore[attr-defined]

    def _fit(self, X: Array, y: Array) -> AeonPalpateClassifier:
        self.palpate_ = PalpateClassifier(**self.get_params()).fit(X, y)
        return self

    def _predict(self, X: Array) -> Array:
        return self.palpate_.predict(X)

    def _predict_proba(self, X: Array) -> Array:
        return self.palpate_.predict_proba(X)

    @classmethod
    def _get_test_params(cls, parameter_set: str = "default") -> dict[str, Any]:
        """Parameters of a fit that takes seconds, for aeon's own checks."""
        return {"steps": 0, "size": "64"}
