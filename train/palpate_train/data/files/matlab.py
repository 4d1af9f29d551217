"""Reads MAT files of all versions, and what Octave's `save` calls so.

Version 7.3 is HDF5; SciPy reads the others. It trusts the sizes in a damaged file: version 1.17.1
ended its process with a segmentation fault in three of three runs of 3,000 damaged files. So a
child process with limits reads the file and writes its arrays to an .npz.

Arrays are found in structures and cells too, by a path such as data.skin or runs{2}.skin. Texts,
dates, tables, other objects, sparse and complex arrays are passed over.
"""

from __future__ import annotations

import resource
import signal
import tempfile
import zipfile
from collections.abc import Iterator, Mapping
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from palpate.core.errors import FormatError
from palpate_train.data import mapped
from palpate_train.data.files import hdf5, numpy_files, octave
from palpate_train.data.files.table import Array, ReadPlan, Table, chosen

DEADLINE_S = 120.0
MOST_BYTES = 16 << 30
"""Address space of the child. An array of version 7 has 2 GB at most."""


def read(path: Path, wanted: ReadPlan) -> Table:
    """The wanted array of a MAT file. Raises FormatError."""
    if h5py.is_hdf5(path):
        with h5py.File(path, "r") as file:
            dotted = {name.replace("/", "."): e for name, e in hdf5.entries(file, True).items()}
            return chosen(dotted, wanted)
    with path.open("rb") as head:
        if head.read(len(octave.CREATED)) == octave.CREATED.encode():  # its usual format, not -v7
            return octave.read(path.read_text(errors="replace").splitlines(), wanted)
    with tempfile.TemporaryDirectory() as folder:
        converted = Path(folder, "arrays.npz")
        _convert(path, converted)
        return numpy_files.read_npz(converted, wanted)


def _convert(path: Path, target: Path) -> None:
    """Write the arrays of a MAT file to an .npz in a child process. Raises FormatError."""
    import scipy.io  # noqa: F401  # the forks then have it

    context = get_context("fork")
    receiver, sender = context.Pipe(duplex=False)
    child = context.Process(target=_child, args=(path, target, sender), daemon=True)
    child.start()
    sender.close()
    child.join(DEADLINE_S)
    if child.is_alive():
        child.kill()
        child.join()
        raise FormatError(f"cannot be read within {DEADLINE_S:g} s; save its arrays alone")
    if child.exitcode:
        name = signal.Signals(-child.exitcode).name if child.exitcode < 0 else child.exitcode
        raise FormatError(f"is damaged: it ended the process that read it ({name})")
    if why := receiver.recv():
        raise FormatError(why)


def _child(path: Path, target: Path, sender: Connection) -> None:
    """Convert with limits, and send what is wrong, "" if nothing."""
    resource.setrlimit(resource.RLIMIT_AS, (MOST_BYTES, MOST_BYTES))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    try:
        arrays = _arrays(path)
        with zipfile.ZipFile(target, "w") as archive:
            for name, values in arrays.items():
                with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
                    mapped.FORMAT.write_array(file, np.asarray(values), allow_pickle=False)
        sender.send("")
    except FormatError as e:
        sender.send(str(e))
    except Exception as e:  # SciPy raises errors of any type for damaged files
        sender.send(
            "is damaged, or not a MAT file of version 4 to 7.3; save it with -v7 "
            f"({type(e).__name__}: {' '.join(str(e).split())})"
        )


def _arrays(path: Path) -> dict[str, Array]:
    """The arrays of real numbers by their paths, in MATLAB's types."""
    import scipy.io

    stored, typed = (scipy.io.loadmat(path, mat_dtype=typed) for typed in (False, True))
    real = dict(_walk_all(stored))  # with its types SciPy drops the imaginary parts
    return {name: values for name, values in _walk_all(typed) if name in real}


def _walk_all(content: Mapping[str, Any]) -> Iterator[tuple[str, Array]]:
    for name, value in content.items():
        if not name.startswith("__"):
            yield from _walk(name, value)


def _walk(name: str, value: Any) -> Iterator[tuple[str, Array]]:
    from scipy.io.matlab import MatlabFunction, MatlabOpaque

    if not isinstance(value, np.ndarray) or isinstance(value, MatlabOpaque | MatlabFunction):
        return
    if value.dtype.names:
        for k, record in enumerate(value.ravel(order="F"), 1):
            for field in value.dtype.names:
                at = name if value.size == 1 else f"{name}({k})"
                yield from _walk(f"{at}.{field}", record[field])
    elif value.dtype.hasobject:
        for k, item in enumerate(value.ravel(order="F"), 1):
            yield from _walk(f"{name}{{{k}}}", item)
    elif value.dtype.kind in "biuf":
        yield name, value.astype(value.dtype.newbyteorder("="), copy=False)
