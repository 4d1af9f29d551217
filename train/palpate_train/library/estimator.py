"""Our recipe as a classifier of scikit-learn, for sweeps in the arrays of aeon."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from numbers import Integral, Real
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
import onnx
from sklearn.base import (
    BaseEstimator,
    ClassifierMixin,
    ClassNamePrefixFeaturesOutMixin,
    TransformerMixin,
)
from sklearn.utils import check_random_state, column_or_1d
from sklearn.utils._param_validation import Interval, StrOptions
from sklearn.utils.multiclass import check_classification_targets
from sklearn.utils.validation import _check_sample_weight as check_sample_weight
from sklearn.utils.validation import check_is_fitted, validate_data
from threadpoolctl import threadpool_limits

from palpate.answer.objects import softmax
from palpate.bundle.manifest import Manifest
from palpate.core import provenance
from palpate.core.errors import FormatError
from palpate.core.sweep_set import Array
from palpate.inference.session import ModelRunner
from palpate_train.data import labels
from palpate_train.data.run import Run
from palpate_train.data.sets import Dataset
from palpate_train.data.splitters import WEIGHT
from palpate_train.export import pack, quantized_bundle
from palpate_train.library.sweeps import (
    as_value_errors,
    channels_first,
    held,
    of_type,
    one_array,
    raw_counts,
)
from palpate_train.models.methods import SkinUse
from palpate_train.models.recipe import recipe
from palpate_train.models.recipe.architectures import LEAST_WINDOW
from palpate_train.models.recipe.fitted import Fit, finished
from palpate_train.models.recipe.sizes import SIZES, UNLIMITED
from palpate_train.onnx_tools.graph_builder import with_head


class PalpateClassifier(
    ClassNamePrefixFeaturesOutMixin,  # type: ignore[misc]  # they have no types
    TransformerMixin,  # type: ignore[misc]
    ClassifierMixin,  # type: ignore[misc]
    BaseEstimator,  # type: ignore[misc]
):
    """The recipe of `palpate-train fit`.

    rate_hz: frames per second of X. grid: rows, columns and axes of the channels of X [n, channels,
    time]; None for one column. group: the name of the `groups` of `fit`, if these are one array;
    whole positions are held out where there are several. varies: names of the groups that will have
    other values in service; without any, all that can be left out. reattached, mains_hz: as the
    options of `fit`. steps: of the training of stages; 0 for none. size: one of
    recipe.sizes.SIZES, None for no limit. random_state: the seed, a RandomState that gives one, or
    None for another one at each fit; the same seed and sweeps give the same model.

    After `fit`: classes_ [K], model_ (its ONNX graph, bytes), format_ (of its sweeps), fit_ (a
    recipe.fitted.Fit) and sweeps (its Dataset). A pickle has neither sweeps nor fit_: it predicts
    and transforms, and is smaller than a bundle.
    """

    _parameter_constraints: ClassVar[dict[str, list[Any]]] = {
        "rate_hz": [Interval(Real, 0, None, closed="neither")],
        "grid": ["array-like", None],
        "group": [str],
        "reattached": ["boolean"],
        "mains_hz": [Interval(Real, 0, None, closed="neither")],
        "steps": [Interval(Integral, 0, None, closed="left")],
        "size": [StrOptions(set(SIZES)), None],
        "random_state": ["random_state"],
        "varies": ["array-like", str],
    }

    def __init__(
        self,
        rate_hz: float = 100.0,
        grid: tuple[int, ...] | None = None,
        group: str = "position",
        reattached: bool = False,
        mains_hz: float = 50.0,
        steps: int = 0,
        size: str | None = None,
        random_state: int | np.random.RandomState | None = 0,
        varies: Sequence[str] = (),
    ) -> None:
        self.rate_hz = rate_hz
        self.grid = grid
        self.group = group
        self.reattached = reattached
        self.mains_hz = mains_hz
        self.steps = steps
        self.size = size
        self.random_state = random_state
        self.varies = varies

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        tags.input_tags.three_d_array = True
        tags.classifier_tags.poor_score = True  # on tables without time, where only order counts
        tags.transformer_tags.preserves_dtype = ["float32"]
        return tags

    @as_value_errors()
    def fit(self, X: Any, y: Any = None, groups: Any = None, sample_weight: Any = None) -> Self:
        """Fit to sweeps.

        X: [n, channels, time], [n, time] of one channel or [n, time, rows, columns(, axes)], or a
        Dataset, which brings its labels, groups and rate. y: a label for each sweep. groups: a
        value for each sweep, or several groups by name, as a table or dictionary; sweeps with the
        same value are not split. sample_weight: how much each sweep counts for the discriminants;
        it counts 1 for their choice, for trained stages and for the limit of known materials in a
        bundle. Raises FormatError, which is a
        ValueError too.
        """
        self._validate_params()
        sweeps = X if isinstance(X, Dataset) else self._dataset(X, y, groups)
        if isinstance(X, Dataset):
            self.classes_ = np.array(sweeps.materials)
        if sample_weight is not None:
            weights = check_sample_weight(
                sample_weight, sweeps.samples, dtype=np.float64, ensure_non_negative=True
            )
            sweeps = replace(sweeps, groups=sweeps.groups | {WEIGHT: weights})
        use = SkinUse(self.reattached, float(self.mains_hz))
        size = SIZES[self.size] if self.size else UNLIMITED
        varies = (self.varies,) if isinstance(self.varies, str) else tuple(self.varies)
        settings = recipe.Settings(self.steps, size=size, use=use, calibrate=False, varies=varies)
        seen = replace(sweeps.require_materials(), samples=held(sweeps.samples))
        with threadpool_limits(1):  # as in the command
            self.fit_ = recipe.fit(seen, Run(self._seed()), settings)
        self.sweeps_, self.format_ = sweeps, sweeps.format
        self.model_ = _graph(self.fit_)
        self._runner = ModelRunner(self.model_, "logits")
        self._n_features_out = self.fit_.int8_head()[0].shape[1]
        return self

    @property
    def sweeps(self) -> Dataset:
        """The sweeps of the fit, with their groups."""
        check_is_fitted(self, "sweeps_")
        return self.sweeps_

    def predict_proba(self, X: Any) -> Array:
        """The probability of each of `classes_`, float64 [n, K]. Raises FormatError, also for
        counts that are NaN or infinite."""
        return softmax(self._outputs(X, "logits").astype(np.float64))

    def predict(self, X: Any) -> Array:
        """The most probable of `classes_` for each sweep, [n]."""
        probability = self.predict_proba(X)
        named: Array = self.classes_[probability.argmax(axis=1)]
        return named

    def transform(self, X: Any) -> Array:
        """The features that the model's discriminants see, float32 [n, F], for a head of one's
        own."""
        return self._outputs(X, "features")

    @as_value_errors()
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
        check_is_fitted(self, "fit_", msg="only a %(name)s just fitted has the sweeps of a bundle")
        if (frames := self.format_.window) < self.fit_.train.format.window:
            raise FormatError(
                f"sweeps of {frames} frames are too short for a box; record at least {LEAST_WINDOW}"
            )
        labels.check(self.sweeps_)
        fit = finished(self.fit_)
        if licence:
            fit = replace(fit, about=fit.about | {pack.LICENCE: licence})
        return quantized_bundle.export(
            fit,
            Path(path),
            name,
            version,
            provenance.commit(),
            full_scale=full_scale,
            pitch_mm=pitch_mm,
            proven=proven,
        )

    @as_value_errors()
    def _outputs(self, X: Any, name: str) -> Array:
        """The output `name` of the graph for each sweep."""
        check_is_fitted(self, "model_")
        samples = X.samples if isinstance(X, Dataset) else self._counts(X, reset=False)
        wanted = self.format_
        if samples[0, 0].shape != wanted.shape or samples.shape[1] != wanted.window:
            raise FormatError(
                f"X holds sweeps {list(samples.shape[1:])}; the fit is of {wanted} (give time, "
                "rows and columns of the same number)"
            )
        given = self._checked(of_type(samples, wanted.dtype), np.zeros(len(samples), np.int64), {})
        return np.stack([self._runner((name,), one)[0] for one in held(given.samples)])

    def _counts(self, X: Any, y: Any = "no_validation", *, reset: bool = True) -> Array:
        """Raw counts of X, see sweeps.raw_counts; scikit-learn's own checks come first."""
        given, grid = one_array(X), self.grid
        if len(given.shape) > 3:
            grid, given = given.shape[2:], channels_first(np.asarray(given))
        least = 1 + reset  # one feature is a sweep of one frame, of which nothing can be learnt
        found = validate_data(self, given, y, reset=reset, allow_nd=True, ensure_min_features=least)
        return raw_counts(found[0] if isinstance(found, tuple) else found, grid)

    def _dataset(self, X: Any, y: Any, groups: Any) -> Dataset:
        """The sweeps of a fit, with their labels as numbers of `classes_`."""
        samples = self._counts(X, y)
        self.classes_, numbers = _ranked("y", column_or_1d(y, warn=True))
        check_classification_targets(y)
        given = {} if groups is None else {self.group: groups}
        names = groups if isinstance(groups, Mapping) else getattr(groups, "columns", ())
        if len(names):
            given = {str(name): groups[name] for name in names}
        given = {name: _group(name, values) for name, values in given.items()}
        for name, values in given.items():
            if len(values) != len(samples):
                raise FormatError(
                    f"{name} holds {len(values)} values for {len(samples)} sweeps; give one a sweep"
                )
        return self._checked(samples, numbers, given)

    def _checked(self, samples: Array, numbers: Array, groups: Mapping[str, Array]) -> Dataset:
        """Sweeps as a Dataset, which checks all numbers."""
        materials = tuple(map(str, self.classes_))
        return Dataset(samples, numbers, materials, float(self.rate_hz), dict(groups), "X")

    def _seed(self) -> int:
        state = self.random_state
        if isinstance(state, Integral):
            return int(state)
        return int(check_random_state(state).randint(2**31 - 1))

    def __getstate__(self) -> dict[str, Any]:
        left_out = "fit_", "sweeps_", "_runner"
        return {k: v for k, v in super().__getstate__().items() if k not in left_out}

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        if hasattr(self, "model_"):
            self._runner = ModelRunner(self.model_, "logits")


def _graph(fit: Fit) -> bytes:
    """The graph of a fit: `sweep` -> `logits` and the `features` that they are made of."""
    trunk = fit.trunk()
    model: onnx.ModelProto = with_head(trunk, *fit.int8_head())
    model.graph.output.append(trunk.graph.output[0])
    return bytes(model.SerializeToString())


def _group(name: str, values: Any) -> Array:
    """Numbers as they are, recordings and all others as ranks."""
    found: Array = np.asarray(values).squeeze()
    if found.ndim != 1:
        raise FormatError(f"{name} holds {list(found.shape)} values; give one a sweep")
    plain = found.dtype.kind in "iuf" and name != "recording"
    return found if plain else _ranked(name, found)[1]


def _ranked(name: str, values: Array) -> tuple[Array, Array]:
    """The sorted values, and the rank of each. Raises FormatError if they have no order."""
    try:
        found, ranks = np.unique(values, return_inverse=True)
    except TypeError as e:
        raise FormatError(f"{name} has values of several types: {e}; give one type") from e
    return found, ranks
