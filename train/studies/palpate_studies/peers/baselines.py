"""The paper's classical classifiers on features, as models that the box runs.

`learn` trains every method on features: it fits a scikit-learn estimator, writes it as an ONNX
graph and finds one temperature on held-out groups. A model answers by running its graph as the box
does, so the scored model is the exported one.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator
from copy import copy
from functools import partial
from itertools import combinations
from typing import Any, Protocol, Self

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper
from skl2onnx import convert_sklearn
from skl2onnx.common.data_types import FloatTensorType
from sklearn.base import BaseEstimator, ClassifierMixin
from sklearn.model_selection import StratifiedGroupKFold
from sklearn.neighbors import KNeighborsClassifier
from sklearn.pipeline import Pipeline, make_pipeline
from sklearn.preprocessing import StandardScaler
from sklearn.svm import SVC

from palpate.core.errors import FormatError
from palpate.core.status import LEAST_PROBABILITY
from palpate_train.data.sets import Dataset
from palpate_train.metrics.temperature import platt_temperature
from palpate_train.models.methods import Method
from palpate_train.onnx_tools.graph_builder import IR, OPSET, GraphBuilder, GraphModel

Array = NDArray[Any]
NEIGHBOURS = 4
"""The paper's k; also the fewest sweeps that a feature method is trained on."""
SMOOTHING = 0.1
"""Added to the neighbours' votes before their logarithm, so that a class without a vote is unlikely
rather than impossible."""
FOLDS = 5
"""Largest number of parts of the training set that are held out in turn to find the temperature."""
SHARPENING = 10
"""Factor on logits before platt_temperature, which only softens: votes are less certain than they
could be."""
ABSENT = math.log(LEAST_PROBABILITY)
"""Log probability of a material without a sweep in training: the box's lower limit when it fuses
sweeps."""
LIMIT = 1e9
"""Features are clipped here, so that a broken reading does not overflow float32; valid readings are
far below."""
OPSETS = {"": OPSET, "ai.onnx.ml": 3, "com.microsoft": 1}
"""Operators that the box's onnxruntime has."""


class Estimator(Protocol):
    """An estimator of scikit-learn, as far as it is used here."""

    classes_: Array

    def fit(self, x: Array, y: Array) -> Self:
        """x: float64 [n, F], y: labels [n]."""
        ...

    def predict(self, x: Array) -> Array:
        """Labels [n] of features [n, F]."""
        ...


class Gauss(ClassifierMixin, BaseEstimator):  # type: ignore[misc]  # scikit-learn ships no types
    """One normal distribution for each class (Bishop 2006, sec. 4.2), with equal priors.

    The covariance of a class is that of its sweeps and of one more sweep, which varies as the whole
    set does, each feature by itself. This ridge of 1 / (n + 1) keeps the matrix regular if sweeps
    are few or features collinear. independent: no covariance between features. first: number of
    features to use, from the first on; 0 for all.
    """

    def __init__(self, independent: bool = False, first: int = 0) -> None:
        self.independent, self.first = independent, first

    def fit(self, x: Array, y: Array) -> Self:
        """x: float64 [n, F], y: labels [n]. Keeps means [K, F] and each class's whitening matrix
        [K, F, F']."""
        self.classes_ = np.unique(y)
        used = slice(0, self.first or x.shape[1])
        spread = x[:, used].var(axis=0)
        spread[spread == 0] = 1.0
        self.means_ = np.stack([x[y == k].mean(axis=0) for k in self.classes_])
        whites = []
        for k, mean in zip(self.classes_, self.means_, strict=True):
            from_mean = (x[y == k] - mean)[:, used]
            covariance = (from_mean.T @ from_mean + np.diag(spread)) / (len(from_mean) + 1)
            if self.independent:
                covariance = np.diag(np.diag(covariance))
            whites.append(np.linalg.inv(np.linalg.cholesky(covariance)).T)
        self.constants_ = np.array([np.log(np.diag(white)).sum() for white in whites])
        self.whites_ = np.zeros((len(whites), x.shape[1], len(spread)))
        self.whites_[:, used] = whites
        return self

    def decision_function(self, x: Array) -> Array:
        """Log likelihoods [n, K] of features [n, F], up to a term that all classes share."""
        white = (x[:, None, None] - self.means_[:, None]) @ self.whites_
        scores: Array = self.constants_ - 0.5 * (white**2).sum(axis=(2, 3))
        return scores

    def predict(self, x: Array) -> Array:
        """Labels [n] of features [n, F]."""
        labels: Array = self.classes_[self.decision_function(x).argmax(axis=1)]
        return labels

    def nodes(self, g: GraphBuilder, features: str) -> str:
        """`decision_function` in ONNX, which skl2onnx does not have; returns the name of its output
        [1, K]."""
        white = g(
            "MatMul", g("Sub", features, g.constant(self.means_[:, None])), g.constant(self.whites_)
        )
        squares = g("ReduceSum", g("Mul", white, white), [1, 2], keepdims=0)
        half = g("Mul", squares, g.constant(-0.5))
        return g("Add", half, g.constant(self.constants_[None]))


def svm(**options: Any) -> Pipeline:
    """A one-against-one SVM with C = 1, gamma = 1 / N (if RBF) on standardised features.

    The paper does not say that features were standardised. But gamma = 1 / N suits features of unit
    variance: on raw H-features, which are small fractions, the RBF kernel is nearly flat.
    break_ties: if several classes have equally many votes, the larger confidence wins, as in the
    graph.
    """
    return make_pipeline(StandardScaler(), SVC(gamma="auto", break_ties=True, **options))


def knn() -> KNeighborsClassifier:
    """The paper's k nearest neighbours."""
    return KNeighborsClassifier(NEIGHBOURS)


def learn(make: Callable[[], Estimator], sweeps: Dataset, inputs: Array, seed: int) -> GraphModel:
    """Train an estimator of `make` on `inputs`, features float32 [N, F] of `sweeps`. `seed` is
    unused because nothing is random.

    The temperature is that of sweeps held out in turn: by position, or by recording if there is
    only one position or if each position has its own materials; 1 if nothing can be held out.
    Raises FormatError if there are too few sweeps or only one material.
    """
    if len(sweeps.require_materials()) < NEIGHBOURS:
        raise FormatError(
            f"{sweeps.source}: {len(sweeps)} sweeps are too few to learn from; give {NEIGHBOURS} "
            "or more"
        )
    features, labels, classes = inputs.astype(np.float64), sweeps.labels, len(sweeps.materials)
    held_out, held_out_labels = [np.empty((0, classes))], [labels[:0]]
    for train, test in _folds(sweeps):
        estimator = make().fit(features[train], labels[train])
        held_out.append(GraphModel(to_onnx(estimator, classes)).logits(inputs[test]))
        held_out_labels.append(labels[test])
    logits, truth = np.concatenate(held_out), np.concatenate(held_out_labels)
    temperature = platt_temperature(SHARPENING * logits, truth) / SHARPENING if len(logits) else 1.0
    return GraphModel(to_onnx(make().fit(features, labels), classes, temperature))


def _folds(sweeps: Dataset) -> Iterator[tuple[Array, Array]]:
    """(training, held-out) numbers of sweeps; only sweeps whose material is in training are held
    out."""
    names = ("position", "recording") if "position" in sweeps.groups else ("recording",)
    for group in map(sweeps.group, names):
        folds = []
        n = min(FOLDS, len(np.unique(group)), np.bincount(sweeps.labels).max())
        with warnings.catch_warnings():
            # of a material with fewer sweeps than folds
            warnings.simplefilter("ignore", UserWarning)
            splits = StratifiedGroupKFold(n).split(group, sweeps.labels, group) if n > 1 else ()
            for train, test in splits:
                test = test[np.isin(sweeps.labels[test], sweeps.labels[train])]
                if len(test) and len(train) >= NEIGHBOURS and np.ptp(sweeps.labels[train]):
                    folds.append((train, test))
        if folds:
            yield from folds
            return


def to_onnx(estimator: Estimator, classes: int, temperature: float = 1.0) -> onnx.ModelProto:
    """A fitted estimator in ONNX: `features` float32 [1, F] -> `logits`, log probabilities float32
    [1, classes].

    temperature: divides the estimator's scores: log likelihoods of Gauss, log votes of kNN, votes
    and bounded confidences of the SVM. A class that the estimator never saw gets ABSENT.
    """
    g = GraphBuilder()
    size = (
        estimator.means_.shape[1]
        if isinstance(estimator, Gauss)
        else int(getattr(estimator, "n_features_in_", 0))
    )
    clipped = g("Clip", "features", g.constant(-LIMIT), g.constant(LIMIT), output="sound")
    scores = (
        estimator.nodes(g, clipped)
        if isinstance(estimator, Gauss)
        else _converted(g, estimator, clipped, size)
    )
    log_p = g("LogSoftmax", g("Mul", scores, g.constant(1 / temperature)))
    column = np.full(classes, len(estimator.classes_))
    column[estimator.classes_] = np.arange(len(estimator.classes_))
    with_absent = g("Concat", log_p, g.constant([[ABSENT]]), axis=1)
    g("Gather", with_absent, column, axis=1, output="logits")
    features = helper.make_tensor_value_info("features", TensorProto.FLOAT, [1, size])
    logits = helper.make_tensor_value_info("logits", TensorProto.FLOAT, [1, classes])
    graph = helper.make_graph(g.nodes, "palpate", [features], [logits], g.constants)
    opsets = [helper.make_opsetid(domain, version) for domain, version in OPSETS.items()]
    model = helper.make_model(graph, opset_imports=opsets, ir_version=IR, producer_name="palpate")
    onnx.checker.check_model(model)
    return model


def _converted(g: GraphBuilder, estimator: Estimator, features: str, size: int) -> str:
    """skl2onnx's nodes for a KNeighborsClassifier or Pipeline, added to `g`; the name of its scores
    [1, K]."""
    steps: list[Any] = (
        [step for _, step in estimator.steps] if isinstance(estimator, Pipeline) else [estimator]
    )
    *before, last = steps
    options: dict[str, Any]
    if votes := isinstance(last, KNeighborsClassifier):
        # skl2onnx's default distances are a loop over all sweeps, twelve times as slow
        options = {"optim": "cdist"}
    else:
        # skl2onnx's votes are thousands of nodes for 36 classes
        last = copy(last).set_params(decision_function_shape="ovo")
        options = {"raw_scores": True}
    with warnings.catch_warnings():
        warnings.simplefilter(
            "ignore", FutureWarning
        )  # skl2onnx reads attributes of SVC that will be removed
        inputs, of_last = (
            [(features, FloatTensorType([1, size]))],
            {id(last): options | {"zipmap": False}},
        )
        model = convert_sklearn(
            make_pipeline(*before, last), "m", inputs, options=of_last, target_opset=OPSETS
        )
    g.nodes.extend(model.graph.node)
    g.constants.extend(model.graph.initializer)
    scores: str = model.graph.output[1].name
    if votes:
        return g(
            "Log", g("Add", g("Mul", scores, g.constant(float(NEIGHBOURS))), g.constant(SMOOTHING))
        )
    return scores if len(last.classes_) == 2 else _votes(g, scores, len(last.classes_))


def _votes(g: GraphBuilder, decisions: str, classes: int) -> str:
    """SVC's `decision_function`: decisions one against one [1, pairs] -> votes and bounded
    confidences [1, classes].

    The decision of a pair (i, j), i < j, is a vote for j where it is below 0, else for i; a sum s
    of a class's decisions adds s / 3 (|s| + 1), which only decides between equally many votes.
    """
    pairs = list(combinations(range(classes), 2))
    side = np.array([[(k == i) - (k == j) for k in range(classes)] for i, j in pairs])
    lost = g("Cast", g("Less", decisions, g.constant([[0.0]])), to=TensorProto.FLOAT)
    sides = g.constant(side)
    won = g("Sub", g.constant((side > 0).sum(axis=0)[None]), g("MatMul", lost, sides))
    total = g("MatMul", decisions, sides)
    bound = g("Mul", g("Add", g("Abs", total), g.constant(1.0)), g.constant(3.0))
    return g("Add", won, g("Div", total, bound))


ESTIMATORS: dict[str, Callable[[], Estimator]] = {
    "L-gauss": Gauss,
    "L-knn": lambda: make_pipeline(StandardScaler(), knn()),
    "L-svm": svm,
    "H-knn": knn,
    "H-svm": svm,
}
"""The paper's classifiers on the paper's features. L-features have units (log, Hz, Hz): kNN gets
them standardised."""
ABOUT = (
    "L-features, a normal distribution for each class (sec. III.C; Bishop 2006)",
    "L-features standardised, 4 nearest neighbours (sec. III.C)",
    "L-features standardised, RBF SVM, one against one, gamma = 1/N (sec. III.C)",
    "H-features, 4 nearest neighbours (sec. III.C)",
    "H-features standardised, RBF SVM, one against one, gamma = 1/N (sec. III.C)",
)
METHODS = tuple(
    Method(name, about, name[0], partial(learn, make))
    for (name, make), about in zip(ESTIMATORS.items(), ABOUT, strict=True)
)
