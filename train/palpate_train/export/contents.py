"""The content of a bundle before it is written: models, class means, golden sweeps."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray

from palpate.answer.contact import DisplacementRule
from palpate.answer.disturbance import Disturbances
from palpate.answer.early import Early
from palpate.answer.objects import softmax
from palpate.answer.unknown import Classes, Known, shaped_distances
from palpate.bundle import arrays, bundle
from palpate.core.errors import BundleError
from palpate_train.answer.fit_contact import Contacts
from palpate_train.data.sets import Dataset
from palpate_train.models.method_fit import MethodFit
from palpate_train.models.methods import model_inputs
from palpate_train.onnx_tools.graph_builder import run, run_output, slim

Array = NDArray[Any]
FEWEST_SWEEPS = 5
"""Number of training sweeps of a material below which that is the reason why none is recognised."""
COARSEST = 8
"""Largest step to which golden sweeps are rounded, in usual changes of a number from frame to
frame. Larger steps save little more."""
NEAR = 0.1
"""Largest change of a golden sweep's probability by rounding, so that its label stays about as
certain."""


class ExportRefused(BundleError):
    """The model answers differently in its bundle than on the desktop, or the box could not use
    it."""


@dataclass(frozen=True)
class Content:
    """The content of a bundle.

    model: `sweep` or `features` -> `logits`, and the outputs that `early` and `known` need. input:
    as in the manifest. train, held_out: the training sweeps and the others, split by the group
    `held_out_by`. about: description of the training; figures: its results; both for the manifest.
    early, known, displacement, disturbances: for the manifest. classes: of the embedding, if there
    is `known`. contacts: of the training sweeps; None
    to find them. unseen: the same content with heads that did not see the held-out sweeps; None if
    no part of the model has seen them.
    """

    model: onnx.ModelProto
    input: str
    train: Dataset
    held_out: Dataset
    held_out_by: str
    about: dict[str, Any]
    figures: dict[str, Any] = field(default_factory=dict)
    early: Early | None = None
    known: Known | None = None
    displacement: DisplacementRule | None = None
    disturbances: Disturbances | None = None
    classes: Classes | None = None
    contacts: Contacts | None = None
    unseen: Content | None = None


def content_of(fit: MethodFit) -> Content:
    """The content of a bundle of this method."""
    return Content(fit.model, fit.input, fit.train, fit.held, fit.held_out_by, fit.about)


def files_of(content: Content) -> dict[str, bytes]:
    """The files of a bundle but its manifest, by name."""
    logits = run(content.model, model_inputs(content.input, content.train))
    of_means = logits_of_means(content, content.train) if content.known else logits
    golden = golden_sweeps(content.train, logits, of_means)
    files = {bundle.MODEL: slim(content.model).SerializeToString()}
    files |= {bundle.GOLDEN: golden_file(content, golden)}
    return files | ({bundle.MEANS: means_file(content.classes)} if content.classes else {})


def means_file(classes: Classes) -> bytes:
    """The file means.npz."""
    return arrays.packed(**classes.arrays())


def logits_of_means(content: Content, sweeps: Dataset) -> Array:
    """Logits [N, K] that the box computes from class means once a label is enrolled, before
    temperature scaling."""
    assert content.classes
    logits: Array = (
        _embedded(content, sweeps.samples) @ content.classes.means.T + content.classes.bias
    )
    return logits


def _unknown(content: Content, sweeps: Dataset) -> Array:
    """bool [N], the sweeps that the box calls unknown; none if the bundle has no limit of known
    materials."""
    if not (content.known and content.classes):
        return np.zeros(len(sweeps), bool)
    means, shapes = (a.astype(np.float64) for a in (content.classes.means, content.classes.shapes))
    distances = shaped_distances(_embedded(content, sweeps.samples)[:, None] - means, shapes)
    beyond: Array = distances.min(axis=1) > content.known.balanced
    return beyond


def _embedded(content: Content, samples: Array) -> Array:
    """The embeddings [n, r] of raw counts [n, T, R, C]."""
    return run_output(content.model, "embedding", samples)


def golden_sweeps(sweeps: Dataset, logits: Array, logits_of_means: Array) -> Dataset:
    """One training sweep of the first and the last material.

    It is the sweep with the median probability among all that both kinds of logits recognise:
    certain enough that rounding does not change its label, and not so certain that a small fault is
    hidden. Raises ExportRefused if none is recognised.
    """
    index = []
    for label in (0, len(sweeps.materials) - 1):
        known = np.flatnonzero(
            (sweeps.labels == label)
            & (logits.argmax(1) == label)
            & (logits_of_means.argmax(1) == label)
        )
        if not len(known):
            raise ExportRefused(
                f"no training sweep of {sweeps.materials[label]!r} is recognised: "
                f"{_why(sweeps, label)}"
            )
        order = np.argsort(softmax(logits[known])[:, label], kind="stable")
        index.append(known[order[len(order) // 2]])
    return sweeps.take(np.array(index))


def golden_file(content: Content, golden: Dataset) -> bytes:
    """The file golden.npz: sweeps, and the logits of the model for exactly these.

    Sweeps are rounded because noise cannot be compressed: as coarsely as possible without a change
    of a label, a change of a probability by more than NEAR, or a known sweep that becomes unknown.
    """

    def answers(samples: Array) -> tuple[Array, ...]:
        sweeps = replace(golden, samples=samples)
        logits = run(content.model, model_inputs(content.input, sweeps))
        return (logits, logits_of_means(content, sweeps)) if content.known else (logits,)

    def same(answer: Array, exact: Array) -> bool:
        near = np.abs(softmax(answer) - softmax(exact)).max() <= NEAR
        return bool(near and (answer.argmax(1) == golden.labels).all())

    exact, unknown = answers(golden.samples), _unknown(content, golden)
    for samples in _rounded(golden.samples):
        still = _unknown(content, replace(golden, samples=samples)) <= unknown
        if still.all() and all(map(same, rounded := answers(samples), exact)):
            return bundle.golden_file(samples, rounded[0])
    return bundle.golden_file(golden.samples, exact[0])


def _rounded(samples: Array) -> Iterator[Array]:
    """Sweeps as multiples of powers of two, from COARSEST usual changes of a number from frame to
    frame down to half of that change. Sweeps of whole numbers stay whole."""
    whole = samples.dtype.kind != "f"
    usual = float(np.median(np.abs(np.diff(samples.astype(np.float64), axis=1))))
    if not usual:
        return
    step = 2.0 ** np.floor(np.log2(usual * COARSEST))
    while step >= (2 if whole else usual / 4):
        rounded = np.rint(samples / step) * step
        if whole:
            rounded = rounded.clip(np.iinfo(samples.dtype).min, np.iinfo(samples.dtype).max)
        yield rounded.astype(samples.dtype)
        step /= 2


def _why(sweeps: Dataset, label: int) -> str:
    """The reason why a material is not recognised, and the remedy."""
    of_it = sweeps.samples[sweeps.labels == label]
    if not np.ptp(of_it, axis=1).any():
        return "every taxel of its sweeps is constant; check the skin, and record it again"
    if len(of_it) < FEWEST_SWEEPS:
        return f"there are {len(of_it)} of it; record {FEWEST_SWEEPS} or more"
    return "they look like others; record it at more positions, or leave it out with --only"
