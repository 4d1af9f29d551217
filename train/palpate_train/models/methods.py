"""All methods that classify sweeps, behind one interface, by name.

A model classifies many sweeps at once on the desktop. Its ONNX graph gives the same answers on the
box.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
from importlib.util import find_spec
from types import ModuleType
from typing import Protocol

import numpy as np
import onnx

from palpate.answer import features
from palpate.core.errors import FormatError
from palpate.core.sweep_set import Array
from palpate_train.data.progress import spoken as spoken  # for trainings
from palpate_train.data.run import Log as Log
from palpate_train.data.run import no_log as no_log
from palpate_train.data.sets import Dataset

Cost = list[tuple[int, float]]
"""(iteration, cross entropy of its batch), eq. 11 of the paper and its Fig. 9."""
SHIPPED = "palpate"
"""The method of `palpate-train fit`."""
PACKAGED = "palpate-reattached"
"""The method of `fit --reattached`, which made the packaged bundle."""
OWN = "palpate_train.models.recipe.palpate"
"""The module of the methods that `fit` and `export` need. Each such module defines METHODS, or
methods(effort) if it trains networks."""
GROUP = "palpate_train.methods"
"""Entry points of packages with further methods. Each has MODULES, the names of its modules."""
STUDIES = "palpate_studies.peers"
"""The methods of the paper and of the field. They are found without an entry point, too, so that a
checkout on the path is enough."""


@dataclass(frozen=True)
class SkinUse:
    """The use of the skin, as the user of `palpate-train fit` states it; our family trains for it.

    reattached: the skin will be taken off and put back after the recordings; all heads then see
    augmented copies. mains_hz: frequency of the mains, to whose hum features do not respond.
    """

    reattached: bool = False
    mains_hz: float = 50.0


AS_RECORDED = SkinUse()


@dataclass(frozen=True)
class Effort:
    """The length of trainings, and the use of the skin.

    share: of each network's default iterations. use: of the skin, for our family.
    """

    share: float = 1.0
    use: SkinUse = AS_RECORDED


FULL_EFFORT = Effort()


class Model(Protocol):
    """A trained method. K: number of materials of the training set, including materials that did
    not occur in training.

    It may have further attributes, which evaluate.fold reads: `ran` (a description of the
    computation), `cost` (of the training) and `precisions` (the same model in other precisions, as
    Models by name).
    """

    def logits(self, inputs: Array) -> Array:
        """Inputs of n sweeps -> float32 [n, K]; their softmax is a calibrated probability.

        inputs: raw counts [n, T, R, C] if the method's `input` is "raw", else features float32 [n,
        F].
        """
        ...

    def graph(self) -> onnx.ModelProto:
        """The graph for the box: `sweep` [1, T, R, C] or `features` float32 [1, F] -> `logits`
        float32 [1, K]. Raises FormatError if the method runs in its `library` alone."""
        ...


@dataclass(frozen=True)
class Method:
    """One way to classify sweeps.

    about: one line with its source. input: "raw" or a key of palpate.answer.features.KINDS. train:
    (training sweeps, their model_inputs, seed) -> Model; the same arguments give the same model.
    extra: the optional dependency that it needs, named as in train/pyproject.toml. effort: the part
    of an Effort that changes it. library: the library that runs its models if they have no graph;
    they are timed there and cannot be packed.
    """

    name: str
    about: str
    input: str
    train: Callable[[Dataset, Array, int], Model]
    extra: str = ""
    effort: str = ""
    library: str = ""


def model_inputs(kind: str, sweeps: Dataset) -> Array:
    """The inputs of a method with the input `kind` for `sweeps`: raw counts [N, T, R, C], or
    features float32 [N, F]."""
    if kind == "raw":
        return sweeps.samples
    return np.stack([features.compute(kind, counts, sweeps.rate_hz) for counts in sweeps.samples])


@cache
def modules() -> tuple[str, ...]:
    """The modules of all methods that are installed: OWN, and what packages of GROUP add."""
    named = [point.value for point in entry_points(group=GROUP)]
    packages = dict.fromkeys(named + [STUDIES] * _is_there(STUDIES))
    return (OWN, *(name for package in packages for name in import_module(package).MODULES))


def _is_there(package: str) -> bool:
    return find_spec(package.partition(".")[0]) is not None and find_spec(package) is not None


def every(effort: Effort = FULL_EFFORT) -> dict[str, Method]:
    """All methods by name."""
    return {
        method.name: method for name in modules() for method in _of(import_module(name), effort)
    }


def module_of(name: str) -> str:
    """The full name of the module that defines the method `name`, "" if none does."""
    for module in (OWN, *modules()):
        if name in {method.name for method in _of(import_module(module), FULL_EFFORT)}:
            return module
    return ""


def find(names: Sequence[str], effort: Effort = FULL_EFFORT) -> list[Method]:
    """The methods of these names; other packages are imported only for other methods than ours.
    Raises FormatError with a name that is unknown."""
    known = {method.name: method for method in _of(import_module(OWN), effort)}
    if not known.keys() >= set(names):
        known = every(effort)
    for name in names:
        if name not in known:
            more = "" if _is_there(STUDIES) else "; pip install palpate-studies brings more"
            raise FormatError(f"method {name!r} is unknown; use some of {', '.join(known)}{more}")
    return [known[name] for name in names]


def _of(module: ModuleType, effort: Effort) -> Iterable[Method]:
    found: Iterable[Method] = (
        module.methods(effort) if hasattr(module, "methods") else module.METHODS
    )
    return found
