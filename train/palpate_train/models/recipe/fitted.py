"""A finished model: a trunk, its heads, its calibration, the contact positions, and the sweeps that
all of it was fitted to.

`palpate-train fit` writes one to a file; `export` makes a bundle of it. PyTorch is not needed;
stages.network_of gives the stages of a fit in PyTorch.
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import checker, shape_inference

from palpate.core import storage
from palpate.core.errors import BundleError, FormatError
from palpate.core.sweep_set import read
from palpate.sweeps.sweep_folder import NOT_THIS
from palpate_train.answer import stranger_limits
from palpate_train.answer.calibrate import Calibration, CalibrationInputs, fit_calibration
from palpate_train.answer.fit_contact import AugmentedCopies, Contacts
from palpate_train.answer.fit_early import no_limits
from palpate_train.answer.heads import HeadData, HeadPlan
from palpate_train.data.augment import COPIES, Augmentation, copies
from palpate_train.data.junk import FOR_LIMITS, JUNK, windows
from palpate_train.data.sets import OWN_NUMBERS, Dataset
from palpate_train.data.splitters import WEIGHT
from palpate_train.metrics.score import outcomes
from palpate_train.models.linear_head import hold_out
from palpate_train.models.methods import Model
from palpate_train.models.recipe import graph, spectrum
from palpate_train.models.recipe.architectures import Architecture
from palpate_train.onnx_tools.graph_builder import run, with_head

Array = NDArray[Any]
Json = dict[str, Any]
WHAT = "a fit (made by palpate-train fit)"
HELD_COPIES_SEED, FAULTS_SEED, JUNK_SEED = 1, 2, 3
"""Added to a fit's seed for the copies of its held-out sweeps, for the copies with faults, and for
junk."""
MOST_BY_JUNK = 10
"""Largest number of sweeps of a material whose limits junk helps to find. More sweeps show by
themselves where unknown materials lie, and junk would only make the limit narrower for known
ones."""
FAULTS = Augmentation(
    displaced=0.0,
    gain=0.1,
    gains=0.05,
    silent=0.06,
    damped=0.0,
    colour=0.0,
    noise=0.4,
    hum=0.3,
    drift=0.1,
)
"""Changes of a known material in service: a worse amplifier, hum of the mains, a taxel that
fails."""
ONE_IN = 10
"""One in this many training sweeps has a copy with faults; docs/decisions/0005 compares other
shares."""


@dataclass(frozen=True, eq=False)
class Fit:
    """A fitted trunk with its heads.

    weights: of the trunk, as graph.trunk_graph takes them; `head.weight` [K, F] and `head.bias`
    [K], fitted to the features of the float trunk, and `int8.weight` and `int8.bias`, fitted to
    features of the int8 trunk, the temperature folded into both. architecture: only the parts that
    the heads see. ranges: of int8; None for a float trunk alone. train, held: the training sweeps
    and the held-out sweeps. about: JSON, how the fit was made and validated. plan: fits the heads
    again, before a temperature. calibration: of the int8 trunk if there is one; None if the sweeps
    do not suffice, with the reason in `uncalibrated`. contacts: None until the fit is `finished`.
    given: inputs of the calibration, kept for export if it knows other things than materials; not
    in the file. strangers: raw counts [n, T, ...] of materials that were not taught.
    """

    weights: dict[str, Array]
    scale: float
    architecture: Architecture
    ranges: graph.Ranges | None
    train: Dataset
    held: Dataset
    about: Json
    plan: HeadPlan
    calibration: Calibration | None = None
    uncalibrated: str = ""
    contacts: Contacts | None = None
    given: CalibrationInputs | None = None
    strangers: Array | None = None

    @property
    def bands(self) -> int:
        """Number of features of the spectrum, which are the last ones and were not trained."""
        return self.architecture.spectrum * spectrum.count(self.train.format)

    @property
    def augmentation(self) -> Augmentation:
        """The augmentation of its training."""
        return Augmentation(**self.about["recipe"]["augmentation"])

    def trunk(self, int8: bool = True, prefixes: bool = False) -> onnx.ModelProto:
        """`sweep` -> `features` float32 [1, F]; with `prefixes` float32 [1, 10, F]. See
        graph.trunk_graph."""
        ranges, format = self.ranges if int8 else None, self.train.format
        return graph.trunk_graph(
            format, self.scale, self.weights, self.architecture, ranges, prefixes
        )

    def in_float(self) -> Fit:
        """The same fit with its float trunk and float head instead of those in int8; not
        calibrated yet."""
        head = {f"int8.{name}": self.weights[f"head.{name}"] for name in ("weight", "bias")}
        return replace(self, weights=self.weights | head, ranges=None, calibration=None, given=None)

    def int8_head(self) -> tuple[Array, Array]:
        """Weight [K, F] and bias [K] of the int8 trunk's head, the temperature folded in."""
        return self.weights["int8.weight"], self.weights["int8.bias"]

    @property
    def tare(self) -> Array:
        """Counts of the unloaded skin in the shape of a frame, 0 if unknown."""
        contacts, shape = self.contacts or Contacts.of(self.train), self.train.format.shape
        known = contacts.limit.known_tare()
        return np.array(known).reshape(shape) if known else np.zeros(shape)

    def values(self, group: str) -> Array:
        """The values of a group among all sweeps."""
        return np.union1d(self.train.group(group), self.held.group(group))

    def held_out_figures(self) -> Json:
        """Figures of sweeps by heads that did not see their value of a condition, for each
        condition, the hardest first, as a manifest holds them, and what the limits of known
        materials cost; none without a calibration."""
        figures: Json = {}
        if self.calibration:
            labels = np.append(self.train.labels, self.held.labels)
            recordings = np.append(self.train.group("recording"), self.held.group("recording"))
            for name, held in self.calibration.held.items():
                of, at = held.numbers, recordings[held.numbers]
                figures |= held.answers(at).figures(labels[of], at, f"held-out {name}")
            figures[stranger_limits.FIGURES] = self.calibration.limits.figures
        return figures

    def worst_values(self) -> dict[str, tuple[Any, int, int, bool]]:
        """For each condition of `held_out_figures` but recordings the value of whose sweeps the
        smallest share is classified correctly: the value, its correct sweeps and all, and whether
        it is the least or the largest of numbers."""
        found: dict[str, tuple[Any, int, int, bool]] = {}
        labels = np.append(self.train.labels, self.held.labels)
        for name, held in self.calibration.held.items() if self.calibration else ():
            of, group = held.numbers, np.append(self.train.group(name), self.held.group(name))
            answers = held.answers(of)
            right = outcomes(answers.labels, answers.ok, labels[of])["right"]
            values, member = np.unique(group[of], return_inverse=True)
            counts, total = np.bincount(member, right), np.bincount(member)
            worst = int((counts / total).argmin())
            scale = group.dtype.kind in "iuf" and name not in OWN_NUMBERS
            outermost = scale and worst in (0, len(values) - 1)
            if name != "recording" and len(values) > 1:
                value = values[worst].item()
                found[name] = value, int(counts[worst]), int(total[worst]), outermost
        return found

    @property
    def sweeps(self) -> int:
        """Number of sweeps that its heads saw; without a held-out part both sides are the same."""
        alone = self.about["held_out_by"] == "nothing"
        return len(self.train) if alone else len(self.train) + len(self.held)

    def save(self, path: Path) -> None:
        """Write the fit as one .npz without pickle. Training and held-out sweeps are one set, the
        training sweeps first."""
        arrays, meta = sides_of(self.train, self.held)
        arrays |= {f"weight_{k}": v for k, v in self.weights.items()}
        for kind, part in (("calibration", self.calibration), ("contacts", self.contacts)):
            arrays |= {f"{kind}_{k}": v for k, v in (part.arrays() if part else {}).items()}
        arrays |= {} if self.strangers is None else {"strangers": self.strangers}
        meta |= {
            "scale": self.scale,
            "architecture": asdict(self.architecture),
            "ranges": asdict(self.ranges) if self.ranges else None,
            "about": self.about,
            "plan": self.plan.json(),
            "calibration": self.calibration.figures() if self.calibration else None,
            "uncalibrated": self.uncalibrated,
            "contacts": self.contacts.figures() if self.contacts else None,
        }
        write(path, arrays, meta)

    @classmethod
    def load(cls, path: Path) -> Fit:
        """Read the file that `save` wrote. Raises FormatError if it is another file."""
        return cls.read(path.name, read(path, WHAT))

    @classmethod
    def read(cls, name: str, arrays: Mapping[str, Array]) -> Fit:
        """The arrays of the file `name`. Raises FormatError as `load`."""
        try:
            fit = cls._read(arrays, json.loads(str(arrays["meta"])))
        except (KeyError, ValueError, TypeError, BundleError) as e:
            raise FormatError(f"{name}: not {WHAT}; fit again: {e}") from e
        try:
            with_head(fit.trunk(), *fit.int8_head())
        except (KeyError, ValueError, checker.ValidationError, shape_inference.InferenceError) as e:
            raise FormatError(
                f"{name}: its weights do not fit its {fit.architecture}; fit again"
            ) from e
        return fit

    @classmethod
    def _read(cls, arrays: Mapping[str, Array], meta: Json) -> Fit:
        weights, calibration, contacts = (
            named(arrays, prefix) for prefix in ("weight_", "calibration_", "contacts_")
        )
        shape, ranges = meta["architecture"], meta["ranges"]
        Augmentation(**meta["about"]["recipe"]["augmentation"])  # as `augmentation` will, later
        return cls(
            weights,
            meta["scale"],
            Architecture(**shape | {key: tuple(shape[key]) for key in ("channels", "pools")}),
            ranges and graph.Ranges(ranges["counts"], tuple(ranges["responses"])),
            *read_sides(arrays, meta),
            meta["about"],
            HeadPlan.read(meta["plan"]),
            calibration=meta["calibration"] and Calibration.of(calibration, meta["calibration"]),
            uncalibrated=meta["uncalibrated"],
            contacts=meta["contacts"] and Contacts.read(contacts, meta["contacts"]),
            strangers=arrays.get("strangers"),
        )


def write(path: Path, arrays: Mapping[str, Array], meta: Json) -> None:
    """Write the .npz file of a fit, compressed little: that takes half the time of NumPy's own
    level, for a twentieth more bytes."""
    path.parent.mkdir(parents=True, exist_ok=True)
    every = {**arrays, "meta": np.array(json.dumps(meta))}
    with (
        storage.file(path) as f,
        zipfile.ZipFile(f, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as packed,
    ):
        for name, values in every.items():
            with packed.open(f"{name}.npy", "w", force_zip64=True) as entry:
                np.lib.format.write_array(  # type: ignore[no-untyped-call]
                    entry, np.asarray(values), allow_pickle=False
                )


def sides_of(train: Dataset, held: Dataset) -> tuple[dict[str, Array], Json]:
    """The arrays and the JSON that the file of a fit has of its training and held-out sweeps."""
    names = ("samples", "labels", *("unloaded",) * (train.unloaded is not None))
    arrays = {f"set_{k}": np.concatenate([getattr(s, k) for s in (train, held)]) for k in names}
    for name in train.groups:
        arrays[f"group_{name}"] = np.concatenate([s.groups[name] for s in (train, held)])
    about = ("materials", "rate_hz", "source", "units", "displays")
    return arrays, {k: getattr(train, k) for k in about} | {"trained_on": len(train)}


def read_sides(arrays: Mapping[str, Array], meta: Json) -> tuple[Dataset, Dataset]:
    """The training and held-out sweeps of `sides_of`. Raises KeyError if something is missing."""
    sweeps = Dataset(
        arrays["set_samples"],
        arrays["set_labels"],
        tuple(meta["materials"]),
        meta["rate_hz"],
        named(arrays, "group_"),
        meta["source"],
        arrays.get("set_unloaded"),
        meta["units"],
        meta["displays"],
    )
    first = np.arange(len(sweeps)) < meta["trained_on"]
    return sweeps.take(first), sweeps.take(~first)


def named(arrays: Mapping[str, Array], prefix: str) -> dict[str, Array]:
    """The arrays whose names begin so, without this prefix."""
    return {k.removeprefix(prefix): v for k, v in arrays.items() if k.startswith(prefix)}


def finished(fit: Fit, known: HeadData | None = None, displaced: bool = True) -> Fit:
    """`fit` with its contacts, and with its calibration if there are sweeps to judge it by, and
    enough for its early answers. known, displaced: as for `calibration_inputs`."""
    fit = replace(fit, contacts=fit.contacts or Contacts.of(fit.train), calibration=None)
    try:
        early = no_limits(len(fit.held)) is None
        given = calibration_inputs(fit, known, early, displaced)
        calibration = fit_calibration(given)
    except FormatError as e:  # nothing was held out, or of too few groups
        return replace(fit, uncalibrated=str(e))
    return replace(fit, calibration=calibration, given=given if given.junk else None)


def calibration_inputs(
    fit: Fit, known: HeadData | None = None, early: bool = False, displaced: bool = False
) -> CalibrationInputs:
    """Features from the trunk of `fit`: of the training sweeps, the held-out sweeps and the copies
    with faults, in this order, and of augmented copies of the first two. known: the training sweeps
    with their copies, if there are such features already. early: of all prefixes of the window, not
    of the whole alone. displaced: with displaced copies of the held-out sweeps. Raises FormatError
    if no sweep was held out."""
    train, held, seed = fit.train, fit.held, fit.about["seed"]
    if (by := fit.about["held_out_by"]) == "nothing":
        hold_out(train, seed)  # raises, with the reason
    shuffled = np.random.default_rng(seed + FAULTS_SEED).permutation(len(train))
    (faulty,) = copies(train.take(shuffled[::ONE_IN]), FAULTS, seed + FAULTS_SEED, 1)
    of_all = train, held, faulty
    role = np.repeat(np.arange(3), [len(sweeps) for sweeps in of_all])
    conditions = {
        name: np.unique(np.concatenate([s.group(name) for s in of_all]), return_inverse=True)[1]
        for name in (by, *fit.about["conditions"])
    }
    labels = np.concatenate([s.labels for s in of_all])
    recordings = np.concatenate([s.group("recording") for s in of_all])
    seen = run(fit.trunk(prefixes=early), np.concatenate([s.samples for s in of_all]))
    return CalibrationInputs(
        seen if early else seen[:, None],
        labels,
        conditions,
        role == 1,
        bool(fit.architecture.channels),
        fit.bands,
        _augmented_copies(fit, known, displaced),
        role == 2,
        fit.plan,
        np.concatenate([s.groups[WEIGHT] for s in of_all]) if WEIGHT in train.groups else None,
        np.unique(np.stack([labels, recordings]), axis=1, return_inverse=True)[1].ravel(),
        _junk(fit),
    )


def _junk(fit: Fit) -> Mapping[str, Array]:
    """Features of junk by kind, none where sweeps suffice without; and of strangers."""
    every = np.append(fit.train.labels, fit.held.labels)
    trunk, tare, seed = fit.trunk(), fit.tare, fit.about["seed"]
    own = {} if fit.strangers is None else {NOT_THIS: run(trunk, fit.strangers)}
    if np.bincount(every).min() > MOST_BY_JUNK:
        return own
    return own | {
        kind: run(trunk, windows(kind, fit.train, FOR_LIMITS, tare, seed + JUNK_SEED))
        for kind in JUNK
    }


def _augmented_copies(fit: Fit, known: HeadData | None, displaced: bool) -> AugmentedCopies:
    """Copies of the training sweeps as the heads see them, and displaced copies of the held-out
    sweeps, whose numbers follow the training sweeps. Where heads see no copies, one copy of each
    training sweep suffices with displaced copies, and none without."""
    trunk, seed = fit.trunk(), fit.about["seed"]

    def seen(sweeps: Dataset, change: Augmentation, drawn: int, count: int) -> Array:
        every = copies(sweeps, change, drawn, count)
        none = np.empty((0, fit.weights["head.weight"].shape[1]), np.float32)
        return np.concatenate([none, *(run(trunk, copy.samples) for copy in every)])

    each = COPIES if any(part.copies for part in fit.plan.parts) else int(displaced)
    of_train = known.copied if known else seen(fit.train, fit.augmentation, seed, each)
    moved, count = fit.augmentation.without_faults(), COPIES * displaced
    of_held = seen(fit.held, moved, seed + HELD_COPIES_SEED, count)
    numbers = np.arange(len(fit.train)), len(fit.train) + np.arange(len(fit.held))
    source = np.concatenate([np.resize(numbers[0], len(of_train)), np.tile(numbers[1], count)])
    labels = np.append(fit.train.labels, fit.held.labels)[source]
    is_held = np.repeat([False, True], [len(of_train), len(of_held)])
    return AugmentedCopies(np.concatenate([of_train, of_held]), labels, source, is_held)


@dataclass(frozen=True, eq=False)
class FittedModel:
    """A fit as the box runs it.

    fit: its origin, with training and held-out sweeps. weight [K, F], bias [K]: its head for all
    materials. ran: a description of the computation. precisions: "float", the model before
    quantization.
    """

    fit: Fit
    weight: Array
    bias: Array
    ran: str
    precisions: Mapping[str, Model] = field(default_factory=dict)

    def features(self, inputs: Array, prefixes: bool = False) -> Array:
        """Raw counts [n, T, R, C] -> the features that the head sees, float32 [n, F]; with
        `prefixes` [n, 10, F], see graph.trunk_graph."""
        return run(self.fit.trunk(prefixes=prefixes), inputs)

    def logits(self, inputs: Array) -> Array:
        """Raw counts [n, T, R, C] -> float32 [n, K]."""
        return run(self.graph(), inputs)

    def graph(self) -> onnx.ModelProto:
        """`sweep` [1, T, R, C] -> `logits` float32 [1, K]."""
        return with_head(self.fit.trunk(), self.weight, self.bias)
