"""Our recipe as a classifier of scikit-learn, for sweeps in the arrays of aeon."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from sklearn.base import BaseEstimator, ClassifierMixin
from sklearn.utils.multiclass import check_classification_targets
from sklearn.utils.validation import check_is_fitted

from palpate.answer.objects import softmax
from palpate.bundle.manifest import Manifest
from palpate.core import provenance
from palpate.core.errors import FormatError
from palpate_train.data import labels
from palpate_train.data.run import Run
from palpate_train.data.sets import Dataset
from palpate_train.export import pack, quantized_bundle
from palpate_train.library.sweeps import raw_counts
from palpate_train.models.methods import SkinUse
from palpate_train.models.recipe import recipe
from palpate_train.models.recipe.fitted import finished
from palpate_train.models.recipe.sizes import SIZES, UNLIMITED
from palpate_train.onnx_tools.graph_builder import GraphModel, with_head

Array = NDArray[Any]


class PalpateClassifier(ClassifierMixin, BaseEstimator):  # type: ignore[misc]  # they have no types
    """The recipe of `palpate-train fit`.

    rate_hz: frames per second of X. grid: rows, columns and axes of the channels of X [n, channels,
    time]; None for one column. group: the name of the `groups` of `fit`; whole positions are held
    out where there are several. reattached, mains_hz: as the options of `fit`. steps: of the
    training of stages; 0 for none. size: one of recipe.sizes.SIZES, None for no limit.
    random_state: the seed, a whole number; the same seed and sweeps give the same model.

    After `fit`: classes_ [K], fit_ (a recipe.fitted.Fit), sweeps (its Dataset).
    """

    def __init__(
        self,
        rate_hz: float = 100.0,
        grid: tuple[int, ...] | None = None,
        group: str = "position",
        reattached: bool = False,
        mains_hz: float = 50.0,
        steps: int = 600,
        size: str | None = None,
        random_state: int = 0,
    ) -> None:
        self.rate_hz = rate_hz
        self.grid = grid
        self.group = group
        self.reattached = reattached
        self.mains_hz = mains_hz
        self.steps = steps
        self.size = size
        self.random_state = random_state

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        tags.input_tags.two_d_array = False
        tags.input_tags.three_d_array = True
        return tags

    def fit(self, X: Any, y: Any = None, groups: Any = None) -> Self:
        """Fit to sweeps.

        X: [n, channels, time] or [n, time, rows, columns(, axes)], or a Dataset, which brings its
        labels, groups and rate. y: a label for each sweep. groups: a value for each sweep; sweeps
        with the same value are not split. Raises FormatError.
        """
        sweeps = X if isinstance(X, Dataset) else self._dataset(X, y, groups)
        if self.size not in (None, *SIZES):
            raise FormatError(f"size {self.size!r} is unknown; use one of {', '.join(SIZES)}")
        if not isinstance(X, Dataset):
            self.classes_ = np.unique(np.asarray(y))
            self.n_features_in_ = sweeps.samples[0, 0].size
        else:
            self.classes_ = np.array(sweeps.materials)
        use = SkinUse(self.reattached, float(self.mains_hz))
        size = SIZES[self.size] if self.size else UNLIMITED
        settings = recipe.Settings(self.steps, size=size, use=use, calibrate=False)
        self.fit_ = recipe.fit(sweeps.require_materials(), Run(int(self.random_state)), settings)
        self.sweeps_ = sweeps
        return self

    @property
    def sweeps(self) -> Dataset:
        """The sweeps of the fit, with their groups."""
        check_is_fitted(self, "fit_")
        return self.sweeps_

    def predict_proba(self, X: Any) -> Array:
        """The probability of each of `classes_`, float64 [n, K]."""
        check_is_fitted(self, "fit_")
        samples = X.samples if isinstance(X, Dataset) else raw_counts(X, self.grid)
        wanted = self.sweeps_.samples
        if samples.shape[1:] != wanted.shape[1:]:
            raise FormatError(
                f"X holds sweeps {list(samples.shape[1:])}; the fit is of "
                f"{list(wanted.shape[1:])} (time, rows, columns)"
            )
        model = GraphModel(with_head(self.fit_.trunk(), *self.fit_.int8_head()))
        return softmax(model.logits(samples.astype(wanted.dtype)).astype(np.float64))

    def predict(self, X: Any) -> Array:
        """The most probable of `classes_` for each sweep, [n]."""
        probability = self.predict_proba(X)
        named: Array = self.classes_[probability.argmax(axis=1)]
        return named

    def save_bundle(
        self,
        path: str | Path,
        name: str = "library",
        version: str = "1",
        *,
        licence: str = "",
        full_scale: float | None = None,
        pitch_mm: float | None = None,
        proven: bool = True,
    ) -> Manifest:
        """Calibrate the fit and pack it as a bundle for the box; see palpate_train.export.pack.

        licence: of the data, for the card. Raises FormatError if the box cannot send a label or no
        sweeps were held out, and ExportRefused if the bundle does not answer as the fit does.
        """
        check_is_fitted(self, "fit_")
        labels.check(self.sweeps_)
        fit = finished(self.fit_)
        if licence:
            fit = replace(fit, about=fit.about | {pack.LICENCE: licence})
        return quantized_bundle.export(
            fit, Path(path), name, version, provenance.commit(), full_scale, pitch_mm, proven
        )

    def _dataset(self, x: Any, y: Any, groups: Any) -> Dataset:
        samples = raw_counts(x, self.grid)
        if y is None:
            raise FormatError("y is missing; give a label for each sweep of X")
        check_classification_targets(y)
        names, numbers = np.unique(np.asarray(y), return_inverse=True)
        given = {}
        if groups is not None:
            given[self.group] = np.unique(np.asarray(groups), return_inverse=True)[1]
        for what, values in (("y", numbers), *given.items()):
            if values.shape != (len(samples),):
                raise FormatError(
                    f"{what} holds {list(values.shape)} values for {len(samples)} sweeps; "
                    "give one a sweep"
                )
        materials = tuple(map(str, names))
        return Dataset(samples, numbers, materials, float(self.rate_hz), given, "X")
