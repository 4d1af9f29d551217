"""Reads, checks and writes the manifest of a bundle. The dataclasses are its schema."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from palpate.answer import features
from palpate.answer.rules import Rules
from palpate.answer.window import WindowLimits
from palpate.core.errors import BundleError, FormatError
from palpate.core.names import LABEL, MOST_SHOWN, can_be_shown
from palpate.core.schema import MOST, Within, check, typed
from palpate.core.status import UNSURE
from palpate.core.types import SweepFormat

SCHEMA = 1
"""Version of the schema."""
MANIFEST, MODEL, GOLDEN, MEANS = "manifest.json", "model.onnx", "golden.npz", "means.npz"
INPUTS = ("raw", *features.KINDS)
MOST_BYTES = 64 << 20
"""Largest file, and largest constant, input or output of a model. The largest of our models, the
paper's network in int8, has 16 MB. The memory that a model needs shows in its trial."""
_SHA256 = re.compile(r"[0-9a-f]{64}")
_VERSION = re.compile(r"[0-9]{1,6}(\.[0-9]{1,6}){2}")


@dataclass(frozen=True, slots=True)
class Thresholds(WindowLimits):
    """Limits for a window before the network runs, and for the network's answer.

    dead_taxels: largest number that the model tolerates. unsure: least probability for status ok.
    """

    unsure: Annotated[float, Within(0, MOST)] = UNSURE  # above 1 no sweep is ok


@dataclass(frozen=True, slots=True)
class Manifest(Rules):
    """The manifest of a bundle, with its rules. Raises BundleError for values out of range.

    input: "raw" or a feature set.
    files: name -> sha256 and size.
    figures: results by evaluation protocol.
    made: commit, seed and machine of the export.
    runtime: least version of the program that can run the bundle.
    counter: increases with each signed bundle, so that an older bundle cannot be installed
        unnoticed; 0 for a bundle that was never signed.
    unloaded: raw counts of the skin without contact, the values of a frame in their order; () if
        unknown.
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
    runtime: str = "0.0.0"
    counter: int = 0
    unloaded: tuple[float, ...] = ()
    displays: dict[str, str] = field(default_factory=dict)
    schema: int = SCHEMA

    def __post_init__(self) -> None:
        check(self.thresholds, "thresholds")
        for why in _faults(self):
            raise BundleError(f"manifest {why}; export the bundle again")
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
        """The bytes of manifest.json, without what the bundle lacks; equal manifests give equal
        bytes."""
        known = {name: value for name, value in asdict(self).items() if value is not None}
        values = known | {"format": self.format.json()}
        if self.sliding and self.sliding.whole:
            del values["sliding"]["whole"]  # the usual
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


def _faults(m: Manifest) -> Iterator[str]:
    """The faults of a manifest."""
    if type(m.schema) is not int or m.schema != SCHEMA:
        yield f"schema {m.schema} is unknown, and this version reads {SCHEMA}: update one of them"
    if m.input not in INPUTS:
        yield f"input {m.input!r} is unknown: use one of {', '.join(INPUTS)}"
    if m.unloaded and len(m.unloaded) != m.format.channels:
        counts = f"{len(m.unloaded)} counts of the unloaded skin"
        yield f"gives {counts}, its frames have {m.format.channels}"
    if type(m.counter) is not int or not 0 <= m.counter < 1 << 53:
        yield f"counter {m.counter!r} must be a whole number from 0 on: sign the bundle again"
    yield from _wrong_files(m.files)
    yield from _wrong_names(m.labels, m.displays)
    yield from _wrong_parts(m)


def _wrong_parts(m: Manifest) -> Iterator[str]:
    """Parts that need each other and are not there together, or do not fit the format."""
    taxels, channels = m.format.rows * m.format.cols, m.format.channels
    if (m.known is not None) != (MEANS in m.files):
        yield f"must have both `known` and {MEANS}, or neither"
    if m.early and m.early.limits and not m.known:
        yield "has `early.limits` without `known`"
    if m.early and m.input != "raw":
        yield f"has `early`, but input {m.input!r} needs the whole window"
    if m.displacement and not (m.known and m.contact):
        yield "has `displacement` without `known` and `contact`"
    if m.thresholds.dead_taxels >= taxels:
        yield f"has {m.thresholds.dead_taxels} of {taxels} for thresholds.dead_taxels: none is left"
    if m.bridging and m.bridging.taxels >= taxels:
        yield f"bridges {m.bridging.taxels} of {taxels} taxels, which leaves none"
    loads = m.bridging and m.bridging.loads
    if loads and len(loads.mean) != channels:
        yield f"has {len(loads.mean)} loads in `bridging` for {channels} values of a frame"
    if m.sliding and len(m.sliding.least) > len(m.labels):
        yield f"has {len(m.sliding.least)} limits in `sliding` for {len(m.labels)} labels"
    if m.contact and m.thresholds.contact is None:
        yield "has `contact` without `thresholds.contact`"


def _wrong_files(files: Mapping[str, Mapping[str, Any]]) -> Iterator[str]:
    """An unknown file, or an entry without sha256 and size."""
    for name, entry in files.items():
        if name not in (MODEL, GOLDEN, MEANS):
            yield f"names a file {name!r}, and a bundle has {MODEL}, {GOLDEN} and {MEANS} alone"
        hashed, size = entry.get("sha256"), entry.get("bytes")
        hexadecimal = isinstance(hashed, str) and _SHA256.fullmatch(hashed)
        if entry.keys() != {"sha256", "bytes"} or not hexadecimal:
            yield f"has {dict(entry)} for {name}, where sha256 and bytes are wanted"
        if type(size) is not int or not 0 <= size <= MOST_BYTES:
            yield f"gives {name} {size!r} bytes, and 0 to {MOST_BYTES} are allowed"


def _wrong_names(labels: tuple[str, ...], displays: Mapping[str, str]) -> Iterator[str]:
    """Fewer than two labels, equal labels, and labels that cannot be sent; and a display name that
    cannot be shown, or that belongs to no label."""
    if len(labels) < 2 or len(set(labels)) < len(labels):
        yield f"labels {list(labels)} must be at least two different names"
    for label in labels:
        if not isinstance(label, str) or not LABEL.fullmatch(label):
            allowed = "use 1 to 24 letters, digits, spaces, '.', '_' or '-'"
            yield f"label {label!r} cannot be sent: {allowed}"
    for label, text in displays.items():
        if label not in labels:
            yield f"has a display name of {label!r}, which is not a label"
        if not can_be_shown(text):
            allowed = f"use 1 to {MOST_SHOWN} characters that are printed"
            yield f"display name {text!r} of {label!r} cannot be shown: {allowed}"
