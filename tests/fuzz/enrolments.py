"""The promises about enrolment.npz, read beside a small bundle; also seeds, and mutations that
leave the archive readable.

The target raises an error if a promise is broken, as in `targets`.
"""

import io
import zipfile
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory

import numpy as np

from palpate.bundle import arrays as packing
from palpate.bundle import bundle, enrolled
from palpate.bundle.bundle import Bundle
from palpate.core.errors import BundleError
from palpate.learn import enrolment
from tests.factories import toy_bundle
from tests.fuzz.files import one_line
from tests.fuzz.mutated_enrolments import changed

LABELS = ("cork", "felt", "silk")
MOST_SWEEPS = 1_000_000
"""Largest number of sweeps that a label may claim; nobody records more."""


@cache
def small() -> Bundle:
    """The bundle to which an input adds labels."""
    with TemporaryDirectory() as folder:
        return toy_bundle.load(Path(folder) / "small")


def read(data: bytes, folder: Path) -> Bundle:
    """The small bundle with the labels of an input. Raises BundleError."""
    return enrolled.applied(small(), data, bundle.identity(data))


def _check_classes(old: Bundle, got: Bundle) -> None:
    """Check that the statistics of trained labels are unchanged, and that all are finite."""
    assert old.classes
    assert got.classes
    n, trained = len(old.manifest.labels), old.classes.arrays()
    for name, values in got.classes.arrays().items():
        assert np.isfinite(values).all(), f"{name} is not finite"
        if not name.startswith("displaced_turn"):
            assert len(values) == len(got.manifest.labels)
            assert values[:n].tobytes() == trained[name].tobytes(), (
                f"{name} of a trained label changed"
            )


def target(data: bytes, folder: Path) -> None:
    """enrolled.applied adds only labels that can be sent to the signed bundle, or refuses."""
    old = small()
    try:
        got = read(data, folder)
    except BundleError as e:
        one_line(e)
        return
    n, labels = len(old.manifest.labels), got.manifest.labels
    assert labels[:n] == old.manifest.labels
    assert n < len(labels) == len(set(labels))
    assert all(bundle.LABEL.fullmatch(label) for label in labels)
    assert (got.model, got.format, got.manifest.thresholds) == (
        old.model,
        old.format,
        old.manifest.thresholds,
    )
    assert got.added
    assert old.manifest.known
    assert got.manifest.known == replace(old.manifest.known, enrolled=got.added.least)
    assert got.manifest.early is None, "early heads do not know the label"
    _check_classes(old, got)
    assert set(got.enrolled) == set(labels[n:])
    assert all(1 <= sweeps <= MOST_SWEEPS for sweeps in got.enrolled.values())
    assert got.golden.shape == (
        len(old.golden) + len(labels) - n,
        old.format.window,
        *old.format.shape,
    )
    assert got.golden[: len(old.golden)].tobytes() == old.golden.tobytes()
    assert got.golden_logits.shape == (len(got.golden), len(labels))
    assert np.isfinite(got.golden_logits).all()
    again = read(enrolled.file(got.added), folder)
    assert again.manifest == got.manifest, "what an enrolment writes reads as something else"
    assert again.golden.tobytes() == got.golden.tobytes()


@cache
def _right(labels: int) -> bytes:
    old, made = small(), b""
    for label in LABELS[:labels]:
        new = enrolment.enrol(old, label, old.golden[:1])
        old, made = new.bundle, new.file
    return made


def seeds() -> list[bytes]:
    """One to three labels, arrays with another value, another bundle's, a known label, none."""
    right = [_right(1), _right(2), _right(3)]
    with np.load(io.BytesIO(right[0])) as z:
        arrays = dict(z.items())
    wrong = [
        ("means", np.full((1, 2), np.nan, np.float32)),
        ("means", np.zeros((1, 3), np.float32)),
        ("means", np.full((1, 2), 3e38, np.float32)),
        ("spread", np.float32([0.5])),
        ("sweeps", np.int64([0])),
        ("sweeps", np.int64([1 << 60])),
        ("changes", arrays["changes"][:1]),
        ("logits", arrays["logits"][1:]),
        ("least", np.array(0.4)),
        ("least", np.array([0.7])),
        ("base", np.array("0" * 64)),
        ("labels", np.array(["a"])),
        ("labels", np.array(["a,b"])),
        ("labels", np.array([], "<U4")),
        ("labels", np.array(["cork", "cork"])),
    ]
    return [
        *right,
        *(packing.packed(**arrays | {name: value}) for name, value in wrong),
        right[0][:200],
        b"PK",
    ]


def words() -> list[bytes]:
    """Names of arrays and words of numpy's header."""
    return [
        *(f"{name}.npy".encode() for name in (*enrolled.ARRAYS, "logits")),
        b"'<f4'",
        b"'<U4'",
        b"'shape': (1,)",
        b"PK\x03\x04",
    ]


def mutated(data: bytes, random: Random, plain: Callable[[bytes], bytes]) -> bytes:
    """One or two arrays changed, removed or written twice, in a valid archive; or bytes changed."""
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as z:
            # numpy returns bytes for a member that is not an array
            arrays = {name: values for name, values in z.items() if isinstance(values, np.ndarray)}
    except Exception:  # numpy raises many kinds of errors for invalid archives
        return plain(data)
    if not arrays or random.random() < 0.2:
        return plain(data)
    for _ in range(1 + random.randrange(2)):
        name = random.choice(list(arrays))
        values = arrays[name]
        if values.dtype.kind in "iuf" and values.size and random.random() < 0.7:
            # numbers that a valid enrolment may hold
            values.ravel()[random.randrange(values.size)] = random.choice((1, 2, 7, 100))
        else:
            arrays[name] = changed(values, random)
        if len(arrays) > 1 and random.random() < 0.05:
            del arrays[name]
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, values in arrays.items():
            held = io.BytesIO()
            np.save(held, values, allow_pickle=False)
            archive.writestr(zipfile.ZipInfo(f"{name}.npy"), held.getvalue(), zipfile.ZIP_DEFLATED)
    return file.getvalue()
