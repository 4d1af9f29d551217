"""Applies enrolment.npz, the labels that a box has enrolled into a bundle by itself.

The files of the bundle do not change, and its signature still covers them. For each label
enrolment.npz holds its name for people, the mean of its sweeps in the embedding, their number and
spread, and a golden sweep. Bias, shape and the mean of displaced sweeps are computed from these. So
an enrolment can add labels and nothing else.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.answer.unknown import Classes, DisplacedClasses
from palpate.bundle import arrays
from palpate.bundle.contents import AddedLabels, Bundle
from palpate.core.errors import BundleError

ENROLMENT = "enrolment.npz"
TEXTS = ("base", "labels", "displays")
ARRAYS = (*TEXTS, "means", "sweeps", "spread", "changes", "logits", "least")
"""Arrays in the file; `changes` are the packed golden sweeps (arrays.changes)."""
MOST_SWEEPS = 1_000_000
"""Largest number of sweeps for a label that the file may give."""
AGAIN = "teach again (palpate teach)"


def file(added: AddedLabels) -> bytes:
    """The bytes of enrolment.npz; equal content gives equal bytes."""
    return arrays.packed(
        base=np.array(added.base),
        labels=np.array(added.labels),
        means=added.means,
        sweeps=added.sweeps,
        spread=added.spread,
        changes=arrays.changes(added.golden),
        logits=added.logits,
        least=np.array(added.least),
        displays=np.array(added.displays),
    )


def applied(bundle: Bundle, data: bytes, identity: str) -> Bundle:
    """`bundle` with the labels of `data`, under this id. Raises BundleError if `data` is malformed
    or is the enrolment of another bundle."""
    return joined(bundle, _read(bundle, data), identity)


def joined(bundle: Bundle, added: AddedLabels, identity: str) -> Bundle:
    """`bundle` with these labels, under this id. Raises BundleError for a label that is taken or
    cannot be sent, and for numbers out of range."""
    made = bundle
    for k in range(len(added.labels)):
        made = _with_label(made, added, k)
    assert made.classes
    assert made.manifest.known
    arrays.check_classes(made.classes.arrays(), len(made.manifest.labels), 0)
    known = replace(made.manifest.known, enrolled=added.least)
    manifest = replace(made.manifest, known=known)
    more = {"manifest": manifest, "golden_logits": added.logits, "id": identity, "added": added}
    return replace(made, before=bundle, **more)  # type: ignore[arg-type]


def _with_label(bundle: Bundle, added: AddedLabels, k: int) -> Bundle:
    """`bundle` with the label `k` as well. Id and logits of golden sweeps do not change. The early
    heads do not have the label, and the figures of `bundle` no longer hold, so both are removed."""
    assert bundle.classes
    m, label, display = bundle.manifest, added.labels[k], added.displays[k]
    sweeps = int(added.sweeps[k])
    manifest = replace(
        m,
        labels=(*m.labels, label),
        displays=m.displays | ({label: display} if display else {}),
        version=f"{m.version}+{label}",
        early=None,
        figures={},
        made=m.made | {"enrolled": bundle.enrolled | {label: sweeps}},
    )
    classes = extended(bundle.classes, added.means[k], sweeps, float(added.spread[k]))
    golden = np.concatenate([bundle.golden, added.golden[k][None]])
    return replace(bundle, manifest=manifest, classes=classes, golden=golden)


def extended(classes: Classes, mean: NDArray[Any], sweeps: int, spread: float) -> Classes:
    """`classes` with one more label, whose `sweeps` have this mean [r] in the embedding.

    The bias is -|m|^2 / 2 + r / (2 n): on average |m|^2 of a mean of n sweeps exceeds |m|^2 of the
    true mean by r / n. The shape is the identity, the scatter of all materials together. A
    displacement is assumed to change the mean by its average change for trained labels.
    """
    row, displaced = mean.astype(np.float32).astype(np.float64), classes.displaced
    if displaced:
        trained = classes.sweeps == 0
        change = (displaced.means - classes.means.astype(np.float64) @ displaced.turn)[
            trained
        ].mean(axis=0)
        means = np.vstack([displaced.means, row @ displaced.turn + change]).astype(np.float32)
        displaced = DisplacedClasses(displaced.turn, means, _one_more(displaced.shapes))
    with np.errstate(over="ignore"):  # values that are not finite are refused below
        bias = -(row @ row) / 2 + len(row) / (2 * sweeps)
        return Classes(
            np.vstack([classes.means, row]).astype(np.float32),
            np.append(classes.bias, bias).astype(np.float32),
            np.append(classes.sweeps, sweeps),
            np.append(classes.spread, spread).astype(np.float32),
            _one_more(classes.shapes),
            displaced,
            changes=classes.changes,
        )


def _one_more(shapes: NDArray[np.float16]) -> NDArray[np.float16]:
    """`shapes` [K, b, b] followed by the shape of all materials together: [K + 1, b, b]."""
    return np.concatenate([shapes, np.eye(shapes.shape[1], dtype=np.float16)[None]])


def _read(bundle: Bundle, data: bytes) -> AddedLabels:
    """The content of `data`, checked against `bundle`. Raises BundleError."""
    held = arrays.read(data, ENROLMENT, *ARRAYS)
    base, labels, displays = (held[name] for name in TEXTS)
    if (
        any(held[name].dtype.kind != "U" for name in TEXTS)
        or base.shape != ()
        or labels.ndim != 1
        or not len(labels)
        or displays.shape != labels.shape
    ):
        raise BundleError(f"{ENROLMENT} names no bundle and its labels; {AGAIN}")
    if base.item() != bundle.base:
        raise BundleError(
            f"{ENROLMENT} belongs to bundle {base.item()[:8]!r}, and the files next to it to "
            f"{bundle.id}; {AGAIN}"
        )
    if bundle.classes is None or not bundle.manifest.known:
        raise BundleError(
            f"{ENROLMENT} adds labels to bundle {bundle.id}, which has no class means; remove the "
            "file"
        )
    _check(held, bundle, len(labels))
    golden = arrays.summed(held["changes"], bundle.format, ENROLMENT)
    return AddedLabels(
        base.item(),
        tuple(labels.tolist()),
        held["means"],
        held["sweeps"],
        held["spread"],
        golden,
        held["logits"],
        float(held["least"]),
        tuple(displays.tolist()),
    )


def _check(held: Mapping[str, NDArray[Any]], bundle: Bundle, n: int) -> None:
    """Raises BundleError if an array has a wrong type, shape or range for `n` labels of
    `bundle`."""
    assert bundle.classes
    f = bundle.format
    wanted: dict[str, tuple[str, tuple[int, ...]]] = {
        "means": ("float32", (n, bundle.classes.means.shape[1])),
        "sweeps": ("int64", (n,)),
        "spread": ("float32", (n,)),
        "changes": ("uint8", (f.numpy_type.itemsize, n, f.window, *f.shape)),
        "logits": ("float32", (len(bundle.golden) + n, len(bundle.manifest.labels) + n)),
        "least": ("float64", ()),
    }
    arrays.check(held, wanted, ENROLMENT, AGAIN)
    sweeps = held["sweeps"]
    if not (((sweeps >= 1) & (sweeps <= MOST_SWEEPS)).all() and (held["spread"] >= 1).all()):
        raise BundleError(
            f"{ENROLMENT} holds a number of sweeps or a spread below 1, or too many; {AGAIN}"
        )
