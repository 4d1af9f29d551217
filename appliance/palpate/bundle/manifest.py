"""Reads, checks and writes the manifest of a bundle. The dataclasses are its schema."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.answer import features
from palpate.answer.contact import ContactPositions
from palpate.answer.disturbance import Disturbances
from palpate.answer.early import Early
from palpate.answer.slide import SpeedRange
from palpate.answer.taxels import Bridging
from palpate.answer.unknown import UNSURE, DisplacementRule, Known
from palpate.answer.vibration import SlideLimits
from palpate.answer.window_check import WindowLimits
from palpate.core.errors import BundleError, FormatError
from palpate.core.names import LABEL, MOST_SHOWN, can_be_shown
from palpate.core.schema import typed
from palpate.core.types import SweepFormat

SCHEMA = 1
"""Version of the schema."""
MANIFEST, MODEL, GOLDEN, MEANS = "manifest.json", "model.onnx", "golden.npz", "means.npz"
INPUTS = ("raw", *features.KINDS)
MOST_BYTES = 64 << 20
"""Largest file. The largest of our models, the paper's network in int8, has 16 MB. The memory that
a model needs shows in its trial."""
_SHA256 = re.compile(r"[0-9a-f]{64}")
_VERSION = re.compile(r"[0-9]{1,6}(\.[0-9]{1,6}){2}")


@dataclass(frozen=True, slots=True)
class Thresholds(WindowLimits):
    """Limits for a window before the network runs, and for the network's answer.

    dead_taxels: largest number that the model tolerates. unsure: least probability for status ok.
    """

    unsure: float = UNSURE


@dataclass(frozen=True, slots=True)
class Manifest:
    """The manifest of a bundle. Raises BundleError for values out of range.

    input: "raw" or a feature set.
    files: name -> sha256 and size.
    figures: results by evaluation protocol.
    made: commit, seed and machine of the export.
    early, known: rules for early answers and unknown materials; None if not supported.
    contact: contact positions in training; None if unknown.
    displacement: rule for contacts elsewhere; None if not supported.
    runtime: least version of the program that can run the bundle.
    counter: increases with each signed bundle, so that an older bundle cannot be installed
        unnoticed; 0 for a bundle that was never signed.
    unloaded: raw counts of the skin without contact, the values of a frame in their order; () if
        unknown.
    speeds: range of the measured speeds in training; None if unknown.
    bridging: broken taxels that the model tolerates; None if that was not measured.
    sliding: what tells a slide from a rest; None if unknown.
    disturbances: allowances for noise, load, speed, lost frames and hum; None if they were not
        measured.
    displays: names of materials for people, in any language, by label; {} if labels are shown.
    """

    name: str
    version: str
    format: SweepFormat
    input: str
    labels: tuple[str, ...]
    thresholds: Thresholds
    files: dict[str, dict[str, Any]]
    figures: dict[str, Any] = field(default_factory=dict)
    made: dict[str, Any] = field(default_factory=dict)
    early: Early | None = None
    known: Known | None = None
    contact: ContactPositions | None = None
    displacement: DisplacementRule | None = None
    runtime: str = "0.0.0"
    counter: int = 0
    unloaded: tuple[float, ...] = ()
    speeds: SpeedRange | None = None
    bridging: Bridging | None = None
    sliding: SlideLimits | None = None
    disturbances: Disturbances | None = None
    displays: dict[str, str] = field(default_factory=dict)
    schema: int = SCHEMA

    def __post_init__(self) -> None:
        if type(self.schema) is not int or self.schema != SCHEMA:
            raise BundleError(
                f"manifest schema {self.schema} is unknown; this version reads {SCHEMA}: update "
                "one of them"
            )
        if self.input not in INPUTS:
            raise BundleError(
                f"manifest input {self.input!r} is unknown; use one of {', '.join(INPUTS)}"
            )
        _check_files(self.files)
        _check_labels(self.labels)
        _check_displays(self.displays, self.labels)
        _check_thresholds(self.thresholds, self.format.rows * self.format.cols)
        _check_parts(self)
        if self.unloaded and len(self.unloaded) != self.format.channels:
            raise BundleError(
                f"manifest gives {len(self.unloaded)} counts of the unloaded skin, its frames have "
                f"{self.format.channels}; export the bundle again"
            )
        if self.early and self.input != "raw":
            raise BundleError(
                f"manifest has `early`, but input {self.input!r} needs the whole window; export it "
                "without"
            )
        if type(self.counter) is not int or not 0 <= self.counter < 1 << 53:
            raise BundleError(
                f"manifest counter {self.counter!r} must be a whole number from 0 on; sign the "
                "bundle again"
            )
        version(self.runtime)

    @property
    def taught(self) -> str:
        """Who has taught the bundle on a box and when, in words; "" if a desktop has trained it."""
        about = self.made.get("taught")
        if not isinstance(about, dict):
            return ""
        by, at = (str(about.get(name, "?"))[:40] for name in ("by", "at"))
        return f"taught here by {by}, {at} UTC by the box's clock"

    def json(self) -> bytes:
        """The bytes of manifest.json; equal manifests give equal bytes."""
        values = asdict(self) | {"format": self.format.json()}
        return (json.dumps(values, indent=1, sort_keys=True) + "\n").encode()

    @property
    def tare(self) -> NDArray[np.float64]:
        """Raw counts of the unloaded skin in the shape of a frame, the first tare of the box; 0 if
        unknown."""
        return np.array(self.unloaded or (0.0,) * self.format.channels).reshape(self.format.shape)

    @classmethod
    def parse(cls, text: bytes) -> Manifest:
        """Read a manifest. Raises BundleError if a key is missing or unknown, or a value has the
        wrong type."""
        try:
            made = typed(cls, json.loads(text))
            made.json()  # raises if it is nested too deeply to be written again after enrolment
            return made
        except (ValueError, TypeError, AttributeError, RecursionError, FormatError) as e:
            raise BundleError(f"manifest cannot be read: {e}; export the bundle again") from e


def version(text: object) -> tuple[int, ...]:
    """A version such as 1.2.3 as a tuple of numbers, for comparison. Raises BundleError for other
    text."""
    if not isinstance(text, str) or not _VERSION.fullmatch(text):
        raise BundleError(f"version {text!r} is not of the form 1.2.3; export the bundle again")
    return tuple(map(int, text.split(".")))


def _check_thresholds(limits: Thresholds, taxels: int) -> None:
    """Raises BundleError for a limit out of range. taxels: of the skin."""
    ranges = (
        ("contact", 0, sys.float_info.max),
        ("full_scale", sys.float_info.min, sys.float_info.max),
        ("saturated", 0, 1),
        ("dead_taxels", 0, taxels - 1),
        ("unsure", 0, sys.float_info.max),  # above 1 no sweep is ok
    )
    for name, least, most in ranges:
        value = getattr(limits, name)
        if not (value is None and name == "contact") and not least <= value <= most:
            raise BundleError(
                f"manifest has {value} for thresholds.{name}, which must be {least:.3g} to "
                f"{most:.3g}; export the bundle again"
            )


def _check_parts(manifest: Manifest) -> None:
    """Parts that need each other are there together. Raises BundleError."""
    if (manifest.known is not None) != (MEANS in manifest.files):
        raise BundleError(
            f"manifest must have both `known` and {MEANS}, or neither; export the bundle again"
        )
    if manifest.early and manifest.early.limits and not manifest.known:
        raise BundleError("manifest has `early.limits` without `known`; export the bundle again")
    if manifest.displacement and not (manifest.known and manifest.contact):
        raise BundleError(
            "manifest has `displacement` without `known` and `contact`; export the bundle again"
        )
    taxels = manifest.format.rows * manifest.format.cols
    if manifest.bridging and manifest.bridging.taxels >= taxels:
        raise BundleError(
            f"manifest bridges {manifest.bridging.taxels} of {taxels} taxels, which leaves none; "
            "export the bundle again"
        )
    loads = manifest.bridging and manifest.bridging.loads
    if loads and len(loads.mean) != manifest.format.channels:
        raise BundleError(
            f"manifest has {len(loads.mean)} loads in `bridging` for {manifest.format.channels} "
            "values of a frame; export the bundle again"
        )
    if manifest.sliding and len(manifest.sliding.least) > len(manifest.labels):
        raise BundleError(
            f"manifest has {len(manifest.sliding.least)} limits in `sliding` for "
            f"{len(manifest.labels)} labels; export the bundle again"
        )
    if manifest.contact and manifest.thresholds.contact is None:
        raise BundleError(
            "manifest has `contact` without `thresholds.contact`; export the bundle again"
        )


def _check_files(files: Mapping[str, Mapping[str, Any]]) -> None:
    """Raises BundleError for an unknown file, or an entry without sha256 and size."""
    for name, entry in files.items():
        if name not in (MODEL, GOLDEN, MEANS):
            raise BundleError(
                f"manifest names a file {name!r}; a bundle has {MODEL}, {GOLDEN} and {MEANS} alone"
            )
        hashed, size = entry.get("sha256"), entry.get("bytes")
        if (
            entry.keys() != {"sha256", "bytes"}
            or not isinstance(hashed, str)
            or not _SHA256.fullmatch(hashed)
        ):
            raise BundleError(
                f"manifest has {dict(entry)} for {name}; sha256 and bytes are wanted: export the "
                "bundle again"
            )
        if type(size) is not int or not 0 <= size <= MOST_BYTES:
            raise BundleError(
                f"manifest gives {name} {size!r} bytes; 0 to {MOST_BYTES} are allowed: export a "
                "smaller model"
            )


def _check_labels(labels: tuple[str, ...]) -> None:
    """Raises BundleError for fewer than two labels, equal labels, and labels that cannot be
    sent."""
    if len(labels) < 2 or len(set(labels)) < len(labels):
        raise BundleError(
            f"manifest labels {list(labels)} must be at least two different names; "
            "export the bundle again"
        )
    for label in labels:
        if not isinstance(label, str) or not LABEL.fullmatch(label):
            raise BundleError(
                f"label {label!r} cannot be sent; use 1 to 24 letters, digits, spaces, '.', '_' "
                "or '-'"
            )


def _check_displays(displays: Mapping[str, str], labels: tuple[str, ...]) -> None:
    """Raises BundleError for a display name that cannot be shown, or that belongs to no label."""
    for label, text in displays.items():
        if label not in labels:
            raise BundleError(
                f"manifest has a display name of {label!r}, which is not a label; export the "
                "bundle again"
            )
        if not can_be_shown(text):
            raise BundleError(
                f"display name {text!r} of {label!r} cannot be shown; use 1 to {MOST_SHOWN} "
                "characters that are printed"
            )
