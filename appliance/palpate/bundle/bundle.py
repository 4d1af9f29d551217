"""Reads and checks a model bundle. No file is used before its hash and content were checked.

A bundle is `manifest.json`, `model.onnx`, `golden.npz` and, if the manifest has `known`,
`means.npz`. The graph takes the sensor's raw counts as `sweep` [1, T, R, C], or [1, T, R, C, A]
for several axes. If the manifest's input is one of features.KINDS, it takes float32 features [1, n]
as `features`. All scaling is inside the graph. Its outputs by name:

- `logits` float32 [1, K0] for the K0 labels of training;
- `early` float32 [1, D, K0], optional: row d (from 0) holds the logits after (d + 1) / (D + 1) of
  the window;
- `early_embedding` float32 [1, D, r], optional: the embedding after each of these steps;
- `embedding` float32 [1, r], optional: a linear projection in which the sweeps of each material
  have covariance 1.

Golden sweeps are test sweeps with the logits that were computed at export, or by the box at
enrolment, and where export refused one of them (`refusals`) with its status.

Enrolment on a box does not change these files; it adds `enrolment.npz` (enrolled.py).
"""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.answer import features
from palpate.answer.unknown import Classes, DisplacedClasses, EarlyClasses
from palpate.bundle import arrays, enrolled
from palpate.bundle.contents import AddedLabels as AddedLabels
from palpate.bundle.contents import Bundle as Bundle
from palpate.bundle.enrolled import ENROLMENT as ENROLMENT
from palpate.bundle.manifest import GOLDEN as GOLDEN
from palpate.bundle.manifest import INPUTS as INPUTS
from palpate.bundle.manifest import MANIFEST as MANIFEST
from palpate.bundle.manifest import MEANS as MEANS
from palpate.bundle.manifest import MODEL as MODEL
from palpate.bundle.manifest import MOST_BYTES
from palpate.bundle.manifest import Manifest as Manifest
from palpate.bundle.manifest import Thresholds as Thresholds
from palpate.bundle.onnx_check import check
from palpate.core.errors import BundleError, TemporaryError, passes
from palpate.core.names import LABEL as LABEL
from palpate.core.status import Status

try:  # not from hashlib, which loads OpenSSL (4 MB) although Python has this function built in
    from _sha2 import sha256  # type: ignore[import-not-found,unused-ignore]
except ImportError:  # Python 3.11
    from _sha256 import sha256  # type: ignore[import-not-found,unused-ignore]

DEFAULT = Path(__file__).parents[1] / "default_bundle"
MOST_SMALL = 1 << 20
"""Largest size in bytes of a manifest or a signature, whose sizes are not given elsewhere."""
SIGNATURE, ENROLMENT_SIGNATURE = MANIFEST + ".sig", ENROLMENT + ".sig"
TAUGHT_SIGNATURE = "taught.sig"
"""Signature of the manifest by the box that has taught the bundle itself."""
EXTRA_FILES = {
    SIGNATURE: MOST_SMALL,
    TAUGHT_SIGNATURE: MOST_SMALL,
    ENROLMENT: MOST_BYTES,
    ENROLMENT_SIGNATURE: MOST_SMALL,
}
"""Files that a manifest does not name, with the largest size of each in bytes."""
GOLDEN_TOLERANCE = 0.02
"""Largest allowed difference of a golden sweep's probability between export and this machine.
Labels must be equal."""


def file_entry(data: bytes) -> dict[str, Any]:
    """The manifest's entry for one file: sha256 and size."""
    return {"sha256": digest(data), "bytes": len(data)}


def digest(data: bytes) -> str:
    """The sha256 of `data` in hexadecimal."""
    return str(sha256(data).hexdigest())


def identity(named_by: bytes) -> str:
    """A bundle's id: the first eight hexadecimal digits of the sha256 of its manifest, or of its
    enrolment.npz."""
    return digest(named_by)[:8]


def name(files: Mapping[str, bytes]) -> str:
    """A bundle's name in the store: the sha256, in hexadecimal, of its enrolment.npz or else of its
    manifest."""
    return digest(files.get(ENROLMENT, files[MANIFEST]))


def load(folder: Path) -> Bundle:
    """Read and check the bundle in `folder`. Raises BundleError if a file is missing, altered or
    has unexpected content."""
    return from_files(files(folder), str(folder))


def files(folder: Path) -> dict[str, bytes]:
    """The files of the bundle in `folder` by name: the manifest, the files that it lists, and the
    files of EXTRA_FILES that exist.

    Other files are ignored. Links are not followed, and no file is read beyond the size in the
    manifest. Raises BundleError if a file cannot be read or is larger, TemporaryError if
    it may be read at the next attempt.
    """
    try:
        found = {MANIFEST: _read(folder / MANIFEST, MOST_SMALL)}
    except OSError as e:
        _raise_if_passing(folder, e)
        raise BundleError(
            f"no bundle at {folder}: {MANIFEST}: {e.strerror}; name the folder of a bundle"
        ) from e
    for name, size in _named(found[MANIFEST]).items():
        try:
            found[name] = _read(folder / name, size)
        except OSError as e:
            if name in EXTRA_FILES and e.errno == errno.ENOENT:
                continue
            _raise_if_passing(folder, e)
            what = "was altered" if e.errno == errno.EFBIG else "cannot be read"
            raise BundleError(
                f"{folder}: {name} {what}: {e.strerror}; copy the bundle again"
            ) from e
    return found


def _named(manifest: bytes) -> dict[str, int]:
    """The other files to read, with the largest size of each."""
    return EXTRA_FILES | {
        name: entry["bytes"] for name, entry in Manifest.parse(manifest).files.items()
    }


def _raise_if_passing(folder: Path, e: OSError) -> None:
    """Raises TemporaryError if the error says nothing about the bundle."""
    if passes(e):
        raise TemporaryError(f"{folder} cannot be read now: {e.strerror}; try again") from e


def _read(path: Path, most: int) -> bytes:
    """Bytes of a regular file, at most `most` + 1. Links, devices and pipes, which could block, are
    refused."""
    with os.fdopen(
        os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC), "rb"
    ) as f:
        if not stat.S_ISREG(os.fstat(f.fileno()).st_mode):
            raise OSError(errno.EINVAL, "it is no plain file", str(path))
        data = f.read(most + 1)
    if len(data) > most:
        raise OSError(errno.EFBIG, f"it has more than {most} bytes", str(path))
    return data


def from_files(files: Mapping[str, bytes], where: str) -> Bundle:
    """The checked bundle of `files`, which are given by name. where: their origin, for messages.
    Raises BundleError as `load`."""
    manifest = Manifest.parse(files[MANIFEST])
    model, golden = (_checked(files, manifest, name, where) for name in (MODEL, GOLDEN))
    samples, logits, refusals = _golden(golden, manifest)
    classes = (
        _classes(_checked(files, manifest, MEANS, where), manifest) if manifest.known else None
    )
    f, kind = manifest.format, manifest.input
    numbers = None if kind == "raw" else len(features.compute(kind, samples[0], f.rate_hz))
    untrained, rank = (
        (int(np.count_nonzero(classes.sweeps)), classes.means.shape[1]) if classes else (0, None)
    )
    check.check(model, manifest, numbers, untrained, rank)
    text = files[MANIFEST]
    held = manifest, identity(text), model, samples, logits, classes
    made = Bundle(*held, base=digest(text), golden_refusals=refusals)
    return (
        enrolled.applied(made, files[ENROLMENT], identity(files[ENROLMENT]))
        if ENROLMENT in files
        else made
    )


def _checked(files: Mapping[str, bytes], manifest: Manifest, name: str, where: str) -> bytes:
    """The bytes of one file after comparing them with its entry in the manifest."""
    if name not in manifest.files or name not in files:
        raise BundleError(f"{where}: the manifest does not name {name}; export the bundle again")
    want, have = manifest.files[name], file_entry(files[name])
    if want != have:
        raise BundleError(
            f"{where}: {name} was altered: {have} instead of {want}; copy the bundle again"
        )
    return files[name]


def golden_file(
    samples: NDArray[Any], logits: NDArray[Any], refusals: Sequence[Status] = ()
) -> bytes:
    """The bytes of golden.npz for sweeps [G, T, R, C] or [G, T, R, C, A], packed by
    `arrays.changes`, and their logits [G, K]. refusals: as Bundle.golden_refusals."""
    refused = any(status is not Status.OK for status in refusals)
    more = {"refusals": np.array([*map(str, refusals)])} if refused else {}
    return arrays.packed(changes=arrays.changes(samples), logits=logits, **more)


def _golden(
    data: bytes, manifest: Manifest
) -> tuple[NDArray[Any], NDArray[np.float32], tuple[Status, ...]]:
    """Golden sweeps [G, T, R, C] or [G, T, R, C, A], their logits [G, K] and refusals."""
    held = arrays.read(data, GOLDEN, "logits", "changes")
    samples, logits = arrays.summed(held["changes"], manifest.format, GOLDEN), held["logits"]
    if not len(samples):
        raise BundleError(f"{GOLDEN} holds no sweeps; export the bundle again")
    if logits.shape != (len(samples), len(manifest.labels)):
        raise BundleError(
            f"{GOLDEN} holds logits {logits.shape} for {len(samples)} sweeps, "
            f"{len(manifest.labels)} labels; export the bundle again"
        )
    refusals = held.get("refusals", np.array([], str))
    known = refusals.dtype.kind == "U" and {*refusals.ravel().tolist()} <= {*map(str, Status)}
    if not known or refusals.ndim != 1 or len(refusals) > len(samples):
        raise BundleError(
            f"{GOLDEN} holds refusals {refusals.dtype} {list(refusals.shape)}, where each of "
            f"{len(samples)} sweeps has a status; export the bundle again"
        )
    return samples, logits.astype(np.float32), tuple(map(Status, refusals.tolist()))


def _classes(data: bytes, manifest: Manifest) -> Classes:
    """Content of means.npz: one row per label, trained labels first."""
    n = len(manifest.labels)
    displaced = (
        [f"displaced_{name}" for name in DisplacedClasses.__slots__]
        if manifest.displacement
        else []
    )
    steps = len(manifest.early.limits) if manifest.early else 0
    early = [f"early_{name}" for name in EarlyClasses.__slots__] if steps else []
    allowed = len(manifest.disturbances.allowances) if manifest.disturbances else 0
    changes = ["changes"] * bool(allowed)
    own = "means", "bias", "sweeps", "spread", "shapes"
    held = arrays.read(data, MEANS, *own, *displaced, *early, *changes)
    arrays.check_classes(held, n, steps, allowed)
    sweeps = held["sweeps"]
    if sweeps[0] or (sweeps[1:] < np.sign(sweeps[:-1])).any():
        raise BundleError(
            f"{MEANS} holds sweeps {sweeps.tolist()}; trained labels (0) come first, enrolled "
            "labels after"
        )
    if manifest.early and sweeps.any():
        raise BundleError(
            "manifest has `early`, whose heads do not know the enrolled labels; teach again from "
            "the original"
        )
    return Classes(
        held["means"],
        held["bias"],
        sweeps,
        held["spread"],
        held["shapes"],
        DisplacedClasses(*(held[name] for name in displaced)) if displaced else None,
        EarlyClasses(*(held[name] for name in early)) if early else None,
        **{name: held[name] for name in changes},
    )
