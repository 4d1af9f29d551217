"""The model bundle: a folder in, a checked Bundle out. Nothing in it is trusted before its hash and form are.

A bundle is `manifest.json`, `model.onnx`, `golden.npz` and, where the manifest has `known`, `means.npz`. The graph
takes the sensor's own digits as `sweep` [1, T, R, C] (or float32 features [1, n] as `features`, where the manifest's
input is one of features.KINDS); all scaling is inside it. It gives, by name:

- `logits` float32 [1, K0] for the K0 labels that training knew;
- `early` float32 [1, D, K0], optional: row d (from 0) is the logits after (d + 1) / (D + 1) of the window;
- `embedding` float32 [1, r], optional: a linear image in which the sweeps of each material scatter with covariance 1.

Golden sweeps come with the logits that export, or the box at enrolment, saw.
"""

from __future__ import annotations

import io
import json
import re
import sys
import zipfile
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import features
from .errors import BundleError, FormatError
from .keys import typed
from .sweep import SweepFormat

try:  # not from hashlib: that loads OpenSSL, 4 MB for a function which Python has by itself
    from _sha2 import sha256  # type: ignore[import-not-found,unused-ignore]
except ImportError:  # Python 3.11
    from _sha256 import sha256  # type: ignore[import-not-found,unused-ignore]

SCHEMA = 2
"""What is written. Schema 1, the same without `early` and `known`, is still read."""
DEFAULT = Path(__file__).with_name("default_bundle")
MANIFEST, MODEL, GOLDEN, MEANS = "manifest.json", "model.onnx", "golden.npz", "means.npz"
INPUTS = ("raw", *features.KINDS)
LABEL = re.compile(r"[A-Za-z0-9][A-Za-z0-9 _.-]{0,23}")
"""What a label may look like: it travels in a sentence, so no comma, star or dollar, and at most 24 characters."""
GOLDEN_TOLERANCE = 0.02
"""Largest allowed difference of a probability between export and this machine; the label must be the same."""


@dataclass(frozen=True, slots=True)
class Thresholds:
    """What is checked before the network is asked, in digits above the tare, and what its answer must reach.

    contact: least temporal mean of a loaded taxel. full_scale: the highest digit the sensor gives.
    saturated: share of full-scale digits in a window that is still accepted. dead_taxels: how many the model bears.
    unsure: least probability for status ok.
    """

    contact: float
    full_scale: float
    saturated: float = 0.01
    dead_taxels: int = 0
    unsure: float = 0.5


@dataclass(frozen=True, slots=True)
class Early:
    """When the answer goes out before the sweep has ended. Raises BundleError where a number makes no sense.

    least: [D], the probability that a label must reach at each step; above 1: never there. agree: so many steps, the
    newest included, must name the same label.
    """

    least: tuple[float, ...]
    agree: int

    def __post_init__(self) -> None:
        if not self.least or not all(_positive(p) for p in self.least):
            raise BundleError(f"early.least {list(self.least)} must be numbers above 0, one for each step")
        if type(self.agree) is not int or self.agree < 1:
            raise BundleError(f"early.agree {self.agree!r} must be a whole number from 1 on")


@dataclass(frozen=True, slots=True)
class Known:
    """What a trained material looks like. Raises BundleError where a number makes no sense.

    limit: largest squared distance of a sweep's embedding to the nearest class mean; beyond it the material is unknown.
    temperature: what logits from class means are divided by.
    """

    limit: float
    temperature: float

    def __post_init__(self) -> None:
        for name, value in (("limit", self.limit), ("temperature", self.temperature)):
            if not _positive(value):
                raise BundleError(f"known.{name} {value!r} must be a number above 0")


def _positive(value: object) -> bool:
    return type(value) in (int, float) and 0 < value <= sys.float_info.max  # type: ignore[operator]


@dataclass(frozen=True, slots=True)
class Manifest:
    """What a bundle says of itself. `files` maps each name to its sha256 and size, `figures` each protocol to numbers,
    `made` names commit, seed and machine. early, known: None where the bundle cannot do it."""

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
    schema: int = SCHEMA

    def __post_init__(self) -> None:
        if self.schema not in (1, SCHEMA):
            raise BundleError(
                f"manifest schema {self.schema} is unknown; this version reads 1 and {SCHEMA}: update one of them"
            )
        if self.input not in INPUTS:
            raise BundleError(f"manifest input {self.input!r} is unknown; use one of {', '.join(INPUTS)}")
        if self.schema == 1 and (self.early or self.known):
            raise BundleError("manifest schema 1 has no `early` and no `known`; export the bundle again")
        if (self.known is not None) != (MEANS in self.files):
            raise BundleError(f"manifest must have both `known` and {MEANS}, or neither; export the bundle again")
        if self.early and self.input != "raw":
            raise BundleError(
                f"manifest has `early`, but input {self.input!r} needs the whole window; export it without"
            )
        if len(self.labels) < 2 or len(set(self.labels)) < len(self.labels):
            raise BundleError(f"manifest labels {list(self.labels)} must be at least two different names")
        for label in self.labels:
            if not isinstance(label, str) or not LABEL.fullmatch(label):
                raise BundleError(
                    f"label {label!r} cannot be sent; use 1 to 24 letters, digits, spaces, '.', '_' or '-'"
                )

    def json(self) -> bytes:
        """The manifest as it is written: one text for one content."""
        return (json.dumps(asdict(self), indent=1, sort_keys=True) + "\n").encode()

    @classmethod
    def parse(cls, text: bytes) -> Manifest:
        """Read a manifest. Raises BundleError naming what is missing, unknown or of the wrong type."""
        try:
            raw = json.loads(text)
            for name, kind in (("format", SweepFormat), ("thresholds", Thresholds), ("early", Early), ("known", Known)):
                if raw.get(name) is not None:
                    raw[name] = typed(kind, raw[name])
            made = typed(cls, raw)
            made.json()  # nested so deeply that it could not be written again after enrolment
            return made
        except (ValueError, TypeError, AttributeError, RecursionError, FormatError) as e:
            raise BundleError(f"manifest cannot be read: {e}; export the bundle again") from e


@dataclass(frozen=True, slots=True)
class Classes:
    """means.npz: where each label lies in the embedding, in the order of the labels.

    means: float32 [K, r]. bias: float32 [K], what is added to means . embedding. sweeps: int64 [K], how many a label
    was enrolled from; 0 where it was trained. spread: float32 [K], variance of its sweeps in a direction of the
    embedding; 1 where it was trained, and for all labels where the file does not hold this array.
    """

    means: NDArray[np.float32]
    bias: NDArray[np.float32]
    sweeps: NDArray[np.int64]
    spread: NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Bundle:
    """A bundle whose files were found as its manifest says.

    golden: digits [G, T, R, C]; golden_logits float32 [G, K]. id: see `identity`.
    classes: where the manifest has `known`.
    """

    manifest: Manifest
    id: str
    model: bytes
    golden: NDArray[Any]
    golden_logits: NDArray[np.float32]
    classes: Classes | None = None

    @property
    def enrolled(self) -> dict[str, int]:
        """The labels that training did not know, with the number of sweeps they come from."""
        if self.classes is None:
            return {}
        return {label: int(n) for label, n in zip(self.manifest.labels, self.classes.sweeps, strict=True) if n}

    @property
    def format(self) -> SweepFormat:
        """The sweep format that the model was trained for."""
        return self.manifest.format


def file_entry(data: bytes) -> dict[str, Any]:
    """sha256 and size of one file, as the manifest holds them."""
    return {"sha256": sha256(data).hexdigest(), "bytes": len(data)}


def identity(manifest: bytes) -> str:
    """A bundle's id: the first eight hex digits of its manifest's sha256."""
    return str(sha256(manifest).hexdigest()[:8])


def load(folder: Path) -> Bundle:
    """Read and check the bundle in `folder`. Raises BundleError where a file is missing, altered or of another form."""
    try:
        text = (folder / MANIFEST).read_bytes()
    except OSError as e:
        raise BundleError(f"no bundle at {folder}: {e.strerror}; name its folder with classifier.bundle") from e
    manifest = Manifest.parse(text)
    model, golden = (_checked(folder, manifest, name) for name in (MODEL, GOLDEN))
    samples, logits = _golden(golden, manifest)
    classes = _classes(_checked(folder, manifest, MEANS), manifest) if manifest.known else None
    return Bundle(manifest, identity(text), model, samples, logits, classes)


def _checked(folder: Path, manifest: Manifest, name: str) -> bytes:
    """The bytes of one file, compared with its entry in the manifest."""
    if name not in manifest.files:
        raise BundleError(f"{folder}: the manifest does not name {name}; export the bundle again")
    try:
        data = (folder / name).read_bytes()
    except OSError as e:
        raise BundleError(f"{folder}: {name} cannot be read: {e.strerror}; copy the bundle again") from e
    want, have = manifest.files[name], file_entry(data)
    if want != have:
        raise BundleError(f"{folder}: {name} was altered: {have} instead of {want}; copy the bundle again")
    return data


def _arrays(data: bytes, file: str, *names: str) -> dict[str, NDArray[Any]]:
    """Arrays of an .npz by name, `names` among them; never unpickled."""
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as z:
            held = dict(z.items())
        return {name: held[name] for name in names} | held
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as e:
        raise BundleError(f"{file} cannot be read: {e}; export the bundle again") from e


def _golden(data: bytes, manifest: Manifest) -> tuple[NDArray[Any], NDArray[np.float32]]:
    """Golden sweeps and their logits."""
    f = manifest.format
    held = _arrays(data, GOLDEN, "samples", "logits")
    samples, logits = held["samples"], held["logits"]
    if samples.shape[1:] != (f.window, f.rows, f.cols) or samples.dtype != f.digits or not len(samples):
        raise BundleError(f"{GOLDEN} holds {samples.dtype} {samples.shape}, which does not fit the format {f}")
    if logits.shape != (len(samples), len(manifest.labels)):
        raise BundleError(
            f"{GOLDEN} holds logits {logits.shape} for {len(samples)} sweeps, {len(manifest.labels)} labels"
        )
    return samples, logits.astype(np.float32)


def _classes(data: bytes, manifest: Manifest) -> Classes:
    """What means.npz holds: one row a label, trained ones first."""
    n = len(manifest.labels)
    held = {"spread": np.ones(n, np.float32)} | _arrays(data, MEANS, "means", "bias", "sweeps")
    found = Classes(*(held[name] for name in Classes.__slots__))
    for name, kind in (("means", "float32"), ("bias", "float32"), ("sweeps", "int64"), ("spread", "float32")):
        values = held[name]
        if values.dtype != kind or values.ndim != 1 + (name == "means") or len(values) != n or 0 in values.shape:
            raise BundleError(
                f"{MEANS} holds {name} {values.dtype} {values.shape} for {n} labels; {kind} is wanted, a row a label"
            )
        if not np.isfinite(values).all():
            raise BundleError(f"{MEANS} holds {name} that are not finite; export the bundle again")
    sweeps = found.sweeps
    if not (found.spread > 0).all():
        raise BundleError(
            f"{MEANS} holds spread {found.spread.tolist()}, which must be above 0; export the bundle again"
        )
    if sweeps[0] or (sweeps[1:] < np.sign(sweeps[:-1])).any():
        raise BundleError(f"{MEANS} holds sweeps {sweeps.tolist()}; trained labels (0) come first, enrolled ones after")
    if manifest.early and sweeps.any():
        raise BundleError(
            "manifest has `early`, whose heads do not know the enrolled labels; enrol again from the original"
        )
    return found
