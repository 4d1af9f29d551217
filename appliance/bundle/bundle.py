"""The model bundle. In: a folder. Out: a checked Bundle. No file is used before its hash and form were checked.

A bundle is `manifest.json`, `model.onnx`, `golden.npz` and, if the manifest has `known`, `means.npz`. The graph takes
the sensor's raw counts as `sweep` [1, T, R, C], or [1, T, R, C, A] where a taxel has several axes (or float32 features
[1, n] as `features`, if the manifest's input is one of features.KINDS); all scaling is inside it. Its outputs by name:

- `logits` float32 [1, K0] for the K0 labels of training;
- `early` float32 [1, D, K0], optional: row d (from 0) holds the logits after (d + 1) / (D + 1) of the window;
- `embedding` float32 [1, r], optional: a linear projection in which the sweeps of each material have covariance 1.

Golden sweeps are test sweeps with the logits that were computed at export, or by the box at enrolment.
"""

from __future__ import annotations

import errno
import io
import os
import stat
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from appliance.bundle.manifest import (
    GOLDEN,
    INPUTS,
    LABEL,
    MANIFEST,
    MEANS,
    MODEL,
    MOST_BYTES,
    Early,
    Known,
    Manifest,
    Moved,
    Thresholds,
)
from appliance.bundle.onnx_check import check
from appliance.core.errors import BundleError
from appliance.core.types import UNREADABLE, SweepFormat
from appliance.signal import features

try:  # not from hashlib: it loads OpenSSL, 4 MB, for a function that Python has built in
    from _sha2 import sha256  # type: ignore[import-not-found,unused-ignore]
except ImportError:  # Python 3.11
    from _sha256 import sha256  # type: ignore[import-not-found,unused-ignore]

__all__ = [
    "DEFAULT", "GOLDEN", "GOLDEN_TOLERANCE", "INPUTS", "LABEL", "MANIFEST", "MEANS", "MODEL", "SIGNATURE",
    "Bundle", "Classes", "Early", "Known", "Manifest", "Moved", "MovedClasses", "Thresholds", "digest", "file_entry", "files",
    "from_files", "identity", "load",
]  # fmt: skip
DEFAULT = Path(__file__).parents[1] / "default_bundle"
SIGNATURE = MANIFEST + ".sig"
MOST_SMALL = 1 << 20
"""Largest size in bytes of a manifest or a signature, which are read before anything is known about them."""
GOLDEN_TOLERANCE = 0.02
"""Largest allowed difference of a golden sweep's probability between export and this machine; labels must be equal."""


@dataclass(frozen=True, slots=True)
class MovedClasses:
    """The classes as they are where the contact has moved, in the embedding turned so that moved sweeps have covariance 1.

    turn: float32 [r, r], embedding @ turn is the turned one. means: float32 [K, r]; shapes: float16 [K, b, b], see
    Classes.
    """

    turn: NDArray[np.float32]
    means: NDArray[np.float32]
    shapes: NDArray[np.float16]


@dataclass(frozen=True, slots=True)
class Classes:
    """Content of means.npz: the class means in the embedding, in the order of the labels.

    means: float32 [K, r]. bias: float32 [K], added to the product of mean and embedding. sweeps: int64 [K], number of
    sweeps that a label was enrolled from; 0 for a trained label. spread: float32 [K], variance of the label's sweeps
    per direction of the embedding; 1 for a trained label, and for all labels if the file has no such array.
    shapes: float16 [K, b, b], how the label's sweeps scatter in the last b directions of the embedding: what a difference
    from the mean is multiplied by before it is squared; 1 for an enrolled label, b = 0 if the file has no such array.
    moved: the same for sweeps whose contact has moved, None if the manifest has no `moved`.
    """

    means: NDArray[np.float32]
    bias: NDArray[np.float32]
    sweeps: NDArray[np.int64]
    spread: NDArray[np.float32]
    shapes: NDArray[np.float16]
    moved: MovedClasses | None = None

    def arrays(self) -> dict[str, NDArray[Any]]:
        """The arrays of means.npz by name."""
        own = {name: getattr(self, name) for name in self.__slots__ if name != "moved"}
        return own | (
            {f"moved_{name}": getattr(self.moved, name) for name in self.moved.__slots__} if self.moved else {}
        )


@dataclass(frozen=True, slots=True)
class Bundle:
    """A bundle whose files agree with its manifest.

    id: see `identity`. model: the bytes of model.onnx. golden: raw counts [G, T, R, C] or [G, T, R, C, A];
    golden_logits: float32 [G, K].
    classes: the class means, None if the manifest has no `known`.
    """

    manifest: Manifest
    id: str
    model: bytes
    golden: NDArray[Any]
    golden_logits: NDArray[np.float32]
    classes: Classes | None = None

    @property
    def enrolled(self) -> dict[str, int]:
        """The labels that were enrolled, with the number of sweeps each was enrolled from."""
        if self.classes is None:
            return {}
        return {label: int(n) for label, n in zip(self.manifest.labels, self.classes.sweeps, strict=True) if n}

    @property
    def format(self) -> SweepFormat:
        """The sweep format that the model was trained for."""
        return self.manifest.format


def file_entry(data: bytes) -> dict[str, Any]:
    """The manifest's entry for one file: sha256 and size."""
    return {"sha256": digest(data), "bytes": len(data)}


def digest(data: bytes) -> str:
    """The sha256 in hexadecimal. The digest of its manifest is a bundle's name in the store."""
    return str(sha256(data).hexdigest())


def identity(manifest: bytes) -> str:
    """A bundle's id: the first eight hexadecimal digits of its manifest's sha256."""
    return digest(manifest)[:8]


def load(folder: Path) -> Bundle:
    """Read and check the bundle in `folder`. Raises BundleError if a file is missing, altered or of another form."""
    return from_files(files(folder), str(folder))


def files(folder: Path) -> dict[str, bytes]:
    """The files of the bundle in `folder` by name: the manifest, the files that it names, the signature if there is
    one.

    Other files are ignored. Links are not followed, and no file is read beyond the size in the manifest.
    Raises BundleError if a file cannot be read or is larger.
    """
    try:
        found = {MANIFEST: _read(folder / MANIFEST, MOST_SMALL)}
    except OSError as e:
        raise BundleError(f"no bundle at {folder}: {MANIFEST}: {e.strerror}; name the folder of one") from e
    for name, size in _named(found[MANIFEST]).items():
        try:
            found[name] = _read(folder / name, size)
        except OSError as e:
            if name == SIGNATURE and e.errno == errno.ENOENT:
                continue
            what = "was altered" if e.errno == errno.EFBIG else "cannot be read"
            raise BundleError(f"{folder}: {name} {what}: {e.strerror}; copy the bundle again") from e
    return found


def _named(manifest: bytes) -> dict[str, int]:
    """The other files to read, with the largest size of each."""
    return {SIGNATURE: MOST_SMALL} | {name: entry["bytes"] for name, entry in Manifest.parse(manifest).files.items()}


def _read(path: Path, most: int) -> bytes:
    """Bytes of a regular file, at most one more than `most`: no link, no device, no pipe that would block."""
    with os.fdopen(os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC), "rb") as f:
        if not stat.S_ISREG(os.fstat(f.fileno()).st_mode):
            raise OSError(errno.EINVAL, "it is no plain file", str(path))
        data = f.read(most + 1)
    if len(data) > most:
        raise OSError(errno.EFBIG, f"it has more than {most} bytes", str(path))
    return data


def from_files(files: Mapping[str, bytes], where: str) -> Bundle:
    """The checked bundle of `files` by name. where: their origin, for messages. Raises BundleError as `load`."""
    manifest = Manifest.parse(files[MANIFEST])
    model, golden = (_checked(files, manifest, name, where) for name in (MODEL, GOLDEN))
    samples, logits = _golden(golden, manifest)
    classes = _classes(_checked(files, manifest, MEANS, where), manifest) if manifest.known else None
    f, kind = manifest.format, manifest.input
    numbers = None if kind == "raw" else len(features.compute(kind, samples[0], f.rate_hz))
    enrolled, rank = (int(np.count_nonzero(classes.sweeps)), classes.means.shape[1]) if classes else (0, None)
    check.check(model, manifest, numbers, enrolled, rank)
    return Bundle(manifest, identity(files[MANIFEST]), model, samples, logits, classes)


def _checked(files: Mapping[str, bytes], manifest: Manifest, name: str, where: str) -> bytes:
    """The bytes of one file after comparing them with its entry in the manifest."""
    if name not in manifest.files or name not in files:
        raise BundleError(f"{where}: the manifest does not name {name}; export the bundle again")
    want, have = manifest.files[name], file_entry(files[name])
    if want != have:
        raise BundleError(f"{where}: {name} was altered: {have} instead of {want}; copy the bundle again")
    return files[name]


def _arrays(data: bytes, file: str, *names: str) -> dict[str, NDArray[Any]]:
    """Arrays of an .npz by name, `names` among them; pickled objects are refused."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as packed:
            size = sum(entry.file_size for entry in packed.infolist())
        if size > MOST_BYTES:
            raise BundleError(
                f"{file} unpacks to {size} bytes, {MOST_BYTES} are allowed; export the bundle with fewer sweeps"
            )
        with np.load(io.BytesIO(data), allow_pickle=False) as z:
            arrays = dict(z.items())
        return {name: arrays[name] for name in names} | arrays
    except (*UNREADABLE, OSError, KeyError, zipfile.BadZipFile) as e:
        raise BundleError(f"{file} cannot be read: {e}; export the bundle again") from e


def golden_file(samples: NDArray[Any], logits: NDArray[Any]) -> bytes:
    """golden.npz of sweeps [G, T, R, C] or [G, T, R, C, A] and their logits [G, K].

    It holds the changes from frame to frame, as whole numbers of the same bits, and of all changes first the lowest byte,
    then the next one: these pack better than the numbers, and not a bit of them is lost.
    """
    bits = np.ascontiguousarray(samples).view(f"<u{samples.itemsize}")
    changes = np.diff(bits, axis=1, prepend=np.zeros_like(bits[:, :1]))
    planes = np.moveaxis(changes.view(np.uint8).reshape(*bits.shape, samples.itemsize), -1, 0)
    packed = io.BytesIO()
    np.savez_compressed(packed, allow_pickle=False, changes=planes, logits=logits)
    return packed.getvalue()


def _golden(data: bytes, manifest: Manifest) -> tuple[NDArray[Any], NDArray[np.float32]]:
    """Golden sweeps [G, T, R, C] or [G, T, R, C, A] and their logits [G, K]. Older files hold `samples` as they are."""
    f = manifest.format
    arrays = _arrays(data, GOLDEN, "logits")
    if not arrays.keys() & {"samples", "changes"}:
        raise BundleError(f"{GOLDEN} holds no sweeps; export the bundle again")
    samples = arrays["samples"] if "samples" in arrays else _summed(arrays["changes"], f)
    logits = arrays["logits"]
    if samples.shape[1:] != (f.window, *f.shape) or samples.dtype != f.numpy_type or not len(samples):
        raise BundleError(f"{GOLDEN} holds {samples.dtype} {samples.shape}, which does not fit the format {f}")
    if logits.shape != (len(samples), len(manifest.labels)):
        raise BundleError(
            f"{GOLDEN} holds logits {logits.shape} for {len(samples)} sweeps, {len(manifest.labels)} labels"
        )
    return samples, logits.astype(np.float32)


def _summed(planes: NDArray[Any], f: SweepFormat) -> NDArray[Any]:
    """Sweeps from the bytes of their changes [bytes, G, T, R, C] or [bytes, G, T, R, C, A]."""
    size = f.numpy_type.itemsize
    if planes.dtype != np.uint8 or planes.shape[:1] + planes.shape[2:] != (size, f.window, *f.shape):
        raise BundleError(f"{GOLDEN} holds changes {planes.dtype} {planes.shape}, which do not fit the format {f}")
    changes = np.ascontiguousarray(np.moveaxis(planes, 0, -1)).view(f"<u{size}")[..., 0]
    return np.cumsum(changes, axis=1, dtype=changes.dtype).view(f.numpy_type)


def _classes(data: bytes, manifest: Manifest) -> Classes:
    """Content of means.npz: one row per label, trained labels first."""
    n = len(manifest.labels)
    moved = [f"moved_{name}" for name in MovedClasses.__slots__] if manifest.moved else []
    arrays = _arrays(data, MEANS, "means", "bias", "sweeps", *moved)
    arrays.setdefault("spread", np.ones(n, np.float32))
    arrays.setdefault("shapes", np.zeros((n, 0, 0), np.float16))
    _check_class_arrays(arrays, n)
    sweeps = arrays["sweeps"]
    if sweeps[0] or (sweeps[1:] < np.sign(sweeps[:-1])).any():
        raise BundleError(f"{MEANS} holds sweeps {sweeps.tolist()}; trained labels (0) come first, enrolled ones after")
    if manifest.early and sweeps.any():
        raise BundleError(
            "manifest has `early`, whose heads do not know the enrolled labels; enrol again from the original"
        )
    return Classes(
        arrays["means"], arrays["bias"], sweeps, arrays["spread"], arrays["shapes"],
        MovedClasses(*(arrays[name] for name in moved)) if moved else None,
    )  # fmt: skip


def _check_class_arrays(arrays: Mapping[str, NDArray[Any]], n: int) -> None:
    """Raises BundleError if an array of means.npz has another type or shape than `n` labels have, or a number out of
    range."""
    rank = arrays["means"].shape[-1] if arrays["means"].ndim else 0
    rows = {"means": (n, rank), "bias": (n,), "sweeps": (n,), "spread": (n,), "shapes": (n, 0, 0), "moved_turn": (rank, rank),
            "moved_means": (n, rank), "moved_shapes": (n, 0, 0)}  # fmt: skip
    kinds = {"sweeps": "int64", "shapes": "float16", "moved_shapes": "float16"}
    for name, wanted in rows.items():
        if name not in arrays:
            continue
        values, kind, shape = arrays[name], kinds.get(name, "float32"), arrays[name].shape
        if name.endswith("shapes") and len(shape) == 3 and shape[1] <= rank:
            wanted = (n, shape[1], shape[1])
        if values.dtype != kind or shape != wanted or (not name.endswith("shapes") and 0 in shape):
            raise BundleError(
                f"{MEANS} holds {name} {values.dtype} {shape} for {n} labels; {kind} {list(wanted)} is wanted, a row a label"
            )
        if not np.isfinite(values).all():
            raise BundleError(f"{MEANS} holds {name} that are not finite; export the bundle again")
    if not (arrays["spread"] > 0).all():
        raise BundleError(
            f"{MEANS} holds spread {arrays['spread'].tolist()}, which must be above 0; export the bundle again"
        )
