"""Runs onnxruntime as the box does, on a model that onnx_check has accepted.

Errors of onnxruntime become BundleErrors. Only the outputs that are requested are computed.
"""

from __future__ import annotations

import ctypes
import os
import re
import time
from collections.abc import Sequence
from mmap import MADV_DONTNEED
from pathlib import Path
from typing import Any

import onnxruntime as ort
from numpy.typing import NDArray

from palpate.answer import features
from palpate.bundle.bundle import Bundle
from palpate.bundle.onnx_check import check
from palpate.bundle.pruning import prune
from palpate.core.errors import BundleError, ModelError
from palpate.core.types import native

MOST_S = 3.0
"""Longest processor time for a sweep. The service's watchdog waits 10 s for the loop."""
MAPS = Path("/proc/self/smaps")
MAPPED = re.compile(r"(?m)^(\w+)-(\w+) r-[x-]p .* (/.*)\n(?:\w+:.*\n)*?Anonymous: *(\d+)")
"""Start, end, file and written KiB of a part of a file in memory that is not writable."""


def session(model: bytes) -> ort.InferenceSession:
    """A session with one thread and without spinning, since the sensor shares its core. It logs
    errors only and sends no telemetry.

    Raises BundleError if onnxruntime refuses the model.
    """
    ort.disable_telemetry_events()
    options = ort.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.log_severity_level = 3
    options.enable_cpu_mem_arena = False
    try:
        return ort.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    except Exception as e:  # the classes of onnxruntime have no other base in common
        why = str(e).strip()[:200]
        if _lacks_memory(e):
            raise ModelError(f"no memory for the model: {why}; end other programs") from e
        raise BundleError(
            f"onnxruntime {ort.__version__} refuses the model: {why}; export it again"
        ) from e


def give_back(library: str = "", maps: Path = MAPS) -> int:
    """Release the pages of the file `library`, or of all files, until they are used again; returns
    the bytes, 0 if there are none or Linux refuses.

    Opening a model runs through most of onnxruntime's code once, to register its operators, and
    loading a library reads its names. These 20 MiB stay resident while memory is not short. Only
    pages that are not writable and never were written are released: they equal the file, so nothing
    can be lost.
    """
    madvise = ctypes.CDLL(None).madvise
    madvise.argtypes = ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int
    total, wanted = 0, os.path.realpath(library) if library else ""
    found = MAPPED.findall(maps.read_text()) if maps.is_file() else []
    for start, end, name, written in found:
        first, size = int(start, 16), int(end, 16) - int(start, 16)
        if wanted in ("", name) and written == "0" and not madvise(first, size, MADV_DONTNEED):
            total += size
    return total


def graph_input(kind: str, taxels: NDArray[Any], rate_hz: float) -> NDArray[Any]:
    """Input of a graph of input `kind` for raw counts: the counts if "raw", else these features."""
    return taxels if kind == "raw" else features.compute(kind, taxels, rate_hz)


class ModelRunner:
    """Runs one model, with a session for each group of outputs that are requested together. A
    session has only the nodes that its outputs need.

    outputs: the first group. Raises BundleError if onnxruntime refuses the model.
    """

    def __init__(self, model: bytes, *outputs: str) -> None:
        self._model = model
        self._sessions: dict[tuple[str, ...], ort.InferenceSession] = {}
        self._input: str = self.prepare(*outputs).get_inputs()[0].name

    def prepare(self, *outputs: str) -> ort.InferenceSession:
        """The session for `outputs`: an open session that has them, or a new session. Raises
        BundleError as the class."""
        able = (opened for group, opened in self._sessions.items() if set(group) >= set(outputs))
        opened = next(able, None)
        if opened is None:
            opened = session(prune(self._model, set(outputs)))
            give_back()
        self._sessions[outputs] = opened
        return opened

    def __call__(self, outputs: tuple[str, ...], given: NDArray[Any]) -> list[NDArray[Any]]:
        """The named outputs for one input `given`, without the leading axis of length 1. Raises
        ModelError as `run`."""
        opened = self._sessions.get(outputs) or self.prepare(*outputs)
        return [out[0] for out in run(opened, outputs, {self._input: given[None]})]


def run(
    opened: ort.InferenceSession, outputs: Sequence[str] | None, given: dict[str, Any]
) -> list[Any]:
    """The graph's `outputs`, all of them for None, for the input arrays `given` by name, in
    whatever byte order. Raises ModelError if they cannot be computed."""
    given = {name: native(values) for name, values in given.items()}
    try:
        values: list[Any] = opened.run(outputs, given)
    except Exception as e:  # as above
        why = str(e).strip()[:200]
        raise ModelError(
            f"onnxruntime {ort.__version__} cannot run the model: {why}; export the bundle again"
        ) from e
    return values


def try_all(bundle: Bundle) -> None:
    """Compute all outputs of the model for each golden sweep, in a process that may die. Raises
    BundleError for an output of another shape than was declared, and for a model that is slow."""
    opened, m = session(bundle.model), bundle.manifest
    names = [output.name for output in opened.get_outputs()]
    rank = None if bundle.classes is None else bundle.classes.means.shape[1]
    patterns = check.expected(m, len(bundle.enrolled), rank)
    for window in bundle.golden:
        numbers = graph_input(m.input, window, m.format.rate_hz)
        begun_s = time.process_time()
        values = run(opened, names, {opened.get_inputs()[0].name: numbers[None]})
        took_s = time.process_time() - begun_s
        for name, value in zip(names, values, strict=True):
            if not check.fits(value.shape, patterns[name]):
                raise BundleError(
                    f"the model gives {name} {list(value.shape)} instead of "
                    f"{list(patterns[name])}; export the bundle again"
                )
        if took_s > MOST_S:
            raise BundleError(
                f"the model takes {took_s:.1f} s for a sweep, {MOST_S:g} are allowed; export a "
                "smaller one"
            )


def _lacks_memory(e: Exception) -> bool:
    return isinstance(e, MemoryError) or "bad_alloc" in str(e) or "allocate memory" in str(e)
