"""Harmful files enrolment.npz: random changes of enrolments of the default bundle.

An attacker with the key of a box might sign them. There are two kinds of change: changes of bytes
mostly break the file, changes of arrays leave a readable file.
"""

import io
import warnings
from functools import cache
from random import Random

import numpy as np

from palpate.bundle import bundle
from palpate.bundle.enrolled import ARRAYS
from tests.factories import deliveries
from tests.fuzz.mutated_models import FLOATS, NUMBERS, flip

LABELS = ("cork", "felt", "silk")


@cache
def packaged() -> dict[str, bytes]:
    """The files of the bundle that the enrolments extend."""
    return bundle.files(bundle.DEFAULT)


@cache
def own(labels: int) -> bytes:
    """A valid enrolment of this many labels."""
    files = packaged()
    for label in LABELS[:labels]:
        files = deliveries.enrolled(files, None, label)
    return files[bundle.ENROLMENT]


def mutated(rng: Random) -> bytes:
    """An enrolment with one to four changes."""
    data = own(rng.randint(1, 3))
    if rng.random() < 0.2:
        return flip(data, rng, data)
    with np.load(io.BytesIO(data)) as z:
        arrays = dict(z.items())
    for _ in range(rng.randint(1, 4)):
        name = rng.choice(ARRAYS)
        arrays[name] = changed(arrays.get(name, np.zeros(1)), rng)
        if rng.random() < 0.05:
            del arrays[name]
    file = io.BytesIO()
    (np.savez_compressed if rng.random() < 0.5 else np.savez)(file, **arrays)
    return file.getvalue()


def changed(values: np.ndarray, rng: Random) -> np.ndarray:
    """The array with another number, other sizes or another type, or with an invalid label."""
    if values.dtype.kind == "U":
        text = rng.choice(("", "wood", "a,b", "x" * 25, "\0", "cork", "é", "$PPLP"))
        alone = not values.ndim or rng.random() < 0.2
        return np.array(text if alone else [text] * len(values))
    how = rng.random()
    if how < 0.5 and values.size:
        changed = values.copy()
        at = rng.sample(range(values.size), min(values.size, rng.choice((1, 1, 5, 10**6))))
        limits = np.iinfo(values.dtype) if values.dtype.kind in "iu" else None
        number = rng.choice(NUMBERS if limits else FLOATS)
        changed.ravel()[at] = min(max(number, limits.min), limits.max) if limits else number
        return changed
    if how < 0.75:
        shape = tuple(rng.choice((0, 1, n, n + 1)) for n in values.shape)
        return np.resize(values, shape) if values.size else np.zeros(shape, values.dtype)
    kinds = "float64", "float32", "float16", "int64", "int8", "uint8", "complex64", "bool"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the new type may not hold these numbers
        return values.astype(rng.choice(kinds))
