"""One fold: a method is trained on some sweeps and tested on others.

A fold is kept under a fingerprint of all that its result depends on, including the code and the
versions of libraries.
"""

from __future__ import annotations

import ast
import hashlib
import io
import json
import time
import zipfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.core.errors import BundleError, FormatError
from palpate.core.storage import put
from palpate.inference.session import graph_input, session
from palpate_train.data.sets import Dataset
from palpate_train.models import methods

Array = NDArray[Any]
Answer = Callable[[Array], Array]
"""Raw counts [T, R, C] -> logits [K]."""
BOX = ("palpate.inference.classifier", "palpate.answer.unknown")
"""Modules of the box that its answers depend on, besides the code of COUNTED."""
TIMED_SWEEPS = 24
"""Number of test sweeps that are classified one by one, to measure their time and to compare their
labels. They run in an inference session of the box, or in the method's library if the method has no
graph."""
NOT_COUNTED = (
    "palpate_train.data.readers",
    "palpate_train.data.sets",
    "palpate_train.evaluate.evaluate",
    "palpate_train.evaluate.parallel",
    "palpate_train.metrics.score",
    "palpate_train.models.methods",
)
"""Modules that methods use and that do not change the result of a fold: it stays valid when their
code changes. Sets are fingerprinted by their data."""
COUNTED = ("palpate_train", "palpate_studies", "palpate.answer", "palpate.inference")
"""Packages whose code may change the result of a fold. `agreement` compares the box's other code
with the desktop's."""
LIBRARIES = (
    "aeon",
    "numba",
    "numpy",
    "onnx",
    "onnxruntime",
    "scikit-learn",
    "scipy",
    "skl2onnx",
    "torch",
)
"""Distributions whose version may change the result of a fold."""


AsTheBox = Callable[[methods.Model, Dataset], tuple[Array, Array] | None]
"""The box's answers to n sweeps by a trained model: labels int [n], or REFUSED or UNKNOWN of
palpate_train.metrics.score, and bool [n], whether it is certain of them. None if the model is of
a method that export does not pack."""


@dataclass(frozen=True, eq=False)
class FoldTask:
    """One fold. train, test: numbers of sweeps. as_the_box: a function of a module, or None to
    leave the box's answers out."""

    method: str
    effort: methods.Effort
    seed: int
    train: Array
    test: Array
    as_the_box: AsTheBox | None = None


@dataclass(frozen=True, eq=False)
class Fold:
    """The result of one fold.

    logits: float32 [n, K] of its test sweeps. ms: median time of one sweep, for features and graph.
    agreement: share of the timed sweeps that get the same label one by one from the exported graph,
    or from the library if the method has no graph. ran: name of the trained model, if the method's
    name does not state it. cost: the training's cross entropy [iterations, 2], if it has one.
    forms: logits float32 [n, K] of the same sweeps by the same model in other precisions. box,
    sure: the box's answers as AsTheBox gives them, empty if there are none; not_packed: why export
    refuses the model. refused: why the method cannot work with this set; all else is empty then.
    """

    test: Array
    logits: Array
    fit_s: float
    ms: float
    agreement: float
    ran: str = ""
    cost: Array = field(default_factory=lambda: np.empty((0, 2)))
    refused: str = ""
    forms: dict[str, Array] = field(default_factory=dict)
    box: Array = field(default_factory=lambda: np.empty(0, int))
    sure: Array = field(default_factory=lambda: np.empty(0, bool))
    not_packed: str = ""

    @classmethod
    def refusal(cls, task: FoldTask, why: str) -> Fold:
        """The fold of a method that cannot work with this set."""
        return cls(task.test, np.empty((0, 0), np.float32), 0.0, 0.0, 0.0, refused=why)

    def save(self, path: Path) -> None:
        """Write the fold, whole or not at all."""
        forms = {FORM + name: logits for name, logits in self.forms.items()}
        keep(path, {name: getattr(self, name) for name in PLAIN} | forms)

    @classmethod
    def load(cls, path: Path) -> Fold | None:
        """Read a fold that `save` wrote; None if the file is missing or cannot be read."""
        if (found := kept(path, PLAIN)) is None:
            return None
        forms = {k.removeprefix(FORM): v for k, v in found.items() if k.startswith(FORM)}
        return cls(**{name: found[name] for name in PLAIN}, forms=forms)


FORM = "form "
PLAIN = tuple(name for name in Fold.__dataclass_fields__ if name != "forms")


def keep(path: Path, arrays: Mapping[str, Any]) -> None:
    """Write arrays, numbers and texts as one .npz, whole or not at all."""
    packed, plain = io.BytesIO(), {name: np.asarray(value) for name, value in arrays.items()}
    np.savez(packed, **plain)  # type: ignore[arg-type]
    put(path, packed.getvalue(), parents=True)


def kept(path: Path, names: Iterable[str]) -> dict[str, Any] | None:
    """What `keep` wrote, with all `names`; None if the file is missing or cannot be read."""
    try:
        with np.load(path, allow_pickle=False) as z:
            found = {name: v.item() if v.ndim == 0 else v for name, v in z.items()}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile):
        return None
    return found if found.keys() >= set(names) else None


def run(task: FoldTask, sweeps: Dataset, inputs: Array) -> Fold:
    """Train on one side and classify the other; a refusal if the method raises FormatError.

    inputs: the method's input of all `sweeps`.
    """
    (method,) = methods.find([task.method], task.effort)
    try:
        return _completed(task, method, sweeps, inputs)
    except FormatError as e:
        return Fold.refusal(task, str(e))


def _completed(task: FoldTask, method: methods.Method, sweeps: Dataset, inputs: Array) -> Fold:
    start = time.perf_counter()
    model = method.train(sweeps.take(task.train), inputs[task.train], task.seed)
    fit_s = time.perf_counter() - start
    models = {"": model} | dict(getattr(model, "precisions", {}))
    answers = {
        name: np.asarray(one.logits(inputs[task.test]), np.float32) for name, one in models.items()
    }
    if not all(np.isfinite(logits).all() for logits in answers.values()):
        raise FormatError(
            f"{task.method} gave a logit that is not finite; please report it with the set"
        )
    logits = answers.pop("")
    some = task.test[
        np.linspace(0, len(task.test) - 1, min(TIMED_SWEEPS, len(task.test))).astype(int)
    ]
    ms, labels = _timed_labels(_alone(method, model, sweeps.rate_hz), sweeps.samples[some])
    agreement = float(np.mean(labels == logits[np.searchsorted(task.test, some)].argmax(1)))
    cost = np.asarray(getattr(model, "cost", []), float).reshape(-1, 2)
    fold = Fold(
        task.test, logits, fit_s, ms, agreement, getattr(model, "ran", ""), cost, forms=answers
    )
    if not task.as_the_box:
        return fold
    try:
        box = task.as_the_box(model, sweeps.take(task.test))
    except (FormatError, BundleError) as e:
        return replace(fold, not_packed=str(e))
    return replace(fold, box=box[0], sure=box[1]) if box else fold


def _timed_labels(answer: Answer, samples: Array) -> tuple[float, Array]:
    """Median time in ms of one sweep of `samples`, raw counts [n, T, R, C], and the labels [n]."""
    times, labels = [], []
    for counts in samples:
        start = time.perf_counter()
        labels.append(int(answer(counts).argmax()))
        times.append(time.perf_counter() - start)
    return 1e3 * float(np.median(times)), np.array(labels)


def _alone(method: methods.Method, model: methods.Model, rate_hz: float) -> Answer:
    """The function that classifies one sweep: features and the graph in a session like the box's,
    or the library of a method without a graph."""

    def given(counts: Array) -> Array:
        return graph_input(method.input, counts, rate_hz)[None]

    if method.library:
        return lambda counts: model.logits(given(counts))[0]
    graph = session(model.graph().SerializeToString())
    name = graph.get_inputs()[0].name
    return lambda counts: graph.run(None, {name: given(counts)})[0][0]


def key(task: FoldTask, data: str) -> str:
    """The fingerprint of all that the fold depends on. data: the set's digest."""
    (method,) = methods.find([task.method], task.effort)
    about = [data, method.name, method.effort, task.seed, task.train.tolist(), task.test.tolist()]
    box = (task.as_the_box.__module__, *BOX) if task.as_the_box else ()
    return fingerprint(about, methods.module_of(method.name), "palpate_train.evaluate.fold", *box)


def fingerprint(about: Any, *modules: str) -> str:
    """32 hex digits of a hash over `about` (for JSON), the code of `modules`, the code that they
    import from this project, and the versions of LIBRARIES."""
    text = json.dumps([about, versions()]).encode()
    return hashlib.sha256(text + _code(modules)).hexdigest()[:32]


def versions() -> dict[str, str]:
    """The versions of the installed LIBRARIES."""
    found = {}
    for name in LIBRARIES:
        with suppress(PackageNotFoundError):
            found[name] = version(name)
    return found


@cache
def _code(modules: tuple[str, ...]) -> bytes:
    """SHA-256 of the code. It is read once, since a process continues with the code that it
    loaded."""
    code = hashlib.sha256()
    for module in sorted(reached(modules)):
        code.update(_file(module).read_bytes())
    return code.digest()


def reached(modules: Sequence[str]) -> set[str]:
    """`modules` and all modules of the packages COUNTED that they import, directly or indirectly,
    without NOT_COUNTED."""
    found, left = set(NOT_COUNTED), list(modules)
    while left:
        if (module := left.pop()) not in found:
            found.add(module)
            left += _imported(module)
    return found - set(NOT_COUNTED)


def _file(module: str) -> Path:
    """The file that a module has, if it is one. An import would load PyTorch for its name alone."""
    package, *names = module.split(".")
    spec = find_spec(package)
    if spec is None or spec.origin is None:
        raise ModuleNotFoundError(f"{package} has no file")
    return Path(spec.origin).parent.joinpath(*names).with_suffix(".py")


@cache
def _imported(module: str) -> tuple[str, ...]:
    """The modules of COUNTED that the import statements of a module and of its functions name:
    `a.b` and `a.b.c` for `from a.b import c`, where these are modules."""
    names: list[str] = []
    for node in ast.walk(ast.parse(_file(module).read_bytes())):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names += [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
    ours = tuple(f"{package}." for package in COUNTED)
    return tuple(name for name in names if name.startswith(ours) and _file(name).is_file())
