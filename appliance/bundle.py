"""The model bundle: a folder in, a checked Bundle out. Nothing in it is trusted before its hash and form are.

A bundle is `manifest.json`, `model.onnx` and `golden.npz`. The graph takes the sensor's own digits as `sweep`
[1, T, R, C] (or float32 features [1, n] as `features`, where the manifest's input is one of features.KINDS) and gives
`logits` float32 [1, K]; all scaling is inside it. Golden sweeps come with the logits that export saw.
"""

from __future__ import annotations

import io
import json
import re
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import features
from .errors import BundleError, FormatError
from .sweep import SweepFormat

try:  # not from hashlib: that loads OpenSSL, 4 MB for a function which Python has by itself
    from _sha2 import sha256  # type: ignore[import-not-found,unused-ignore]
except ImportError:  # Python 3.11
    from _sha256 import sha256  # type: ignore[import-not-found,unused-ignore]

SCHEMA = 1
DEFAULT = Path(__file__).with_name("default_bundle")
MANIFEST, MODEL, GOLDEN = "manifest.json", "model.onnx", "golden.npz"
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
class Manifest:
    """What a bundle says of itself. `files` maps each name to its sha256 and size, `figures` each protocol to numbers,
    `made` names commit, seed and machine."""

    name: str
    version: str
    format: SweepFormat
    input: str
    labels: tuple[str, ...]
    thresholds: Thresholds
    files: dict[str, dict[str, Any]]
    figures: dict[str, Any] = field(default_factory=dict)
    made: dict[str, Any] = field(default_factory=dict)
    schema: int = SCHEMA

    def __post_init__(self) -> None:
        if self.schema != SCHEMA:
            raise BundleError(
                f"manifest schema {self.schema} is unknown; this version reads {SCHEMA}: update one of them"
            )
        if self.input not in INPUTS:
            raise BundleError(f"manifest input {self.input!r} is unknown; use one of {', '.join(INPUTS)}")
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
            raw["format"] = SweepFormat(**raw["format"])
            raw["thresholds"] = Thresholds(**raw["thresholds"])
            raw["labels"] = tuple(raw["labels"])
            return cls(**raw)
        except (ValueError, KeyError, TypeError, FormatError) as e:
            raise BundleError(f"manifest cannot be read: {e}; export the bundle again") from e


@dataclass(frozen=True, slots=True)
class Bundle:
    """A bundle whose files were found as its manifest says.

    golden: digits [G, T, R, C]; golden_logits float32 [G, K]. id: the first eight hex digits of the manifest's sha256.
    """

    manifest: Manifest
    id: str
    model: bytes
    golden: NDArray[Any]
    golden_logits: NDArray[np.float32]

    @property
    def format(self) -> SweepFormat:
        """The sweep format that the model was trained for."""
        return self.manifest.format


def file_entry(data: bytes) -> dict[str, Any]:
    """sha256 and size of one file, as the manifest holds them."""
    return {"sha256": sha256(data).hexdigest(), "bytes": len(data)}


def load(folder: Path) -> Bundle:
    """Read and check the bundle in `folder`. Raises BundleError where a file is missing, altered or of another form."""
    try:
        text = (folder / MANIFEST).read_bytes()
    except OSError as e:
        raise BundleError(f"no bundle at {folder}: {e.strerror}; name its folder with classifier.bundle") from e
    manifest = Manifest.parse(text)
    model, golden = (_checked(folder, manifest, name) for name in (MODEL, GOLDEN))
    samples, logits = _golden(golden, manifest)
    return Bundle(manifest, sha256(text).hexdigest()[:8], model, samples, logits)


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


def _golden(data: bytes, manifest: Manifest) -> tuple[NDArray[Any], NDArray[np.float32]]:
    """Golden sweeps and their logits; never unpickled."""
    f = manifest.format
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as z:
            samples, logits = z["samples"], z["logits"]
    except (OSError, ValueError, KeyError) as e:
        raise BundleError(f"{GOLDEN} cannot be read: {e}; export the bundle again") from e
    if samples.shape[1:] != (f.window, f.rows, f.cols) or samples.dtype != f.digits or not len(samples):
        raise BundleError(f"{GOLDEN} holds {samples.dtype} {samples.shape}, which does not fit the format {f}")
    if logits.shape != (len(samples), len(manifest.labels)):
        raise BundleError(
            f"{GOLDEN} holds logits {logits.shape} for {len(samples)} sweeps, {len(manifest.labels)} labels"
        )
    return samples, logits.astype(np.float32)
