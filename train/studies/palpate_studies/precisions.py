"""Every precision of a method as a packed model, and the method in its own library.

For some methods there is a peer: the same model in a library that the box does not have.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.core import storage
from palpate_studies import cost
from palpate_studies.peers import minirocket
from palpate_train.data import sets
from palpate_train.data.sets import Dataset
from palpate_train.evaluate.fold import fingerprint
from palpate_train.export import measure, pack
from palpate_train.models import methods
from palpate_train.models.method_fit import MethodFit
from palpate_train.models.methods import Method

Array = NDArray[Any]
INDEX = "dots.json"


@dataclass(frozen=True)
class Packed:
    """A model in `folder`, which measure.load reads. runtime: "onnx" for a bundle, else the library
    of a peer.

    form: "" for the method itself, else the name of another of its precisions. precision, weights,
    macs: as palpate_studies.cost counts them.
    """

    method: str
    form: str
    precision: str
    runtime: str
    folder: Path
    weights: int
    macs: int

    @property
    def name(self) -> str:
        """A name that no other model of a chart has."""
        return f"{self.method} {self.precision}" + (
            "" if self.runtime == "onnx" else f" in {self.runtime}"
        )


def kept_folder(method: Method, train: Dataset, seed: int, cache: Path) -> Path:
    """The folder in the cache for the bundles of a method that was trained on these sweeps."""
    about = [sets.digest(train), method.name, method.effort, seed]
    modules = (
        methods.module_of(method.name),
        "palpate_studies.precisions",
        "palpate_train.export.pack",
    )
    return cache / "dots" / fingerprint(about, *modules)


def packed(method: Method, sweeps: Dataset, seed: int, folder: Path) -> list[Packed]:
    """Train `method` on four fifths of `sweeps` and pack all its precisions; models in `folder` are
    not made again.

    Raises FormatError if the method cannot work with the set, and ExportRefused if the box could
    not use the model.
    """
    if not folder.exists():
        folder.parent.mkdir(parents=True, exist_ok=True)
        with storage.folder(folder) as work:
            entries = list(_packed_forms(method, sweeps, seed, work))
            (work / INDEX).write_text(json.dumps(entries))
    entries = json.loads((folder / INDEX).read_text())
    return [
        Packed(**entry | {"method": method.name, "folder": folder / entry["folder"]})
        for entry in entries
    ]


def _packed_forms(
    method: Method, sweeps: Dataset, seed: int, work: Path
) -> Iterator[dict[str, Any]]:
    """Each precision packed in a folder of its own; then the method in its own library, if it has
    one."""
    model, made = MethodFit.of(method, sweeps, seed)
    content = pack.content_of(made)
    counted: dict[str, dict[str, Any]] = {}
    for form, graphed in {"": model, **getattr(model, "precisions", {})}.items():
        graph = graphed.graph()
        precision = cost.precision(graph)
        if any(precision == entry["precision"] for entry in counted.values()):
            continue  # nothing in it is int8: both precisions are the same
        folder = work / precision
        about = content.about | ({"form": form} if form else {})
        pack.pack_to_measure(replace(content, model=graph, about=about), folder)
        counted[form] = {
            "form": form,
            "precision": precision,
            "weights": cost.weights(graph),
            "macs": cost.macs(graph) + cost.feature_macs(method.input, content.train.format),
        }
        yield counted[form] | {"runtime": "onnx", "folder": folder.name}
    if method.name in PEERS:
        runtime, save = PEERS[method.name]
        (work / runtime).mkdir()
        save(model, content.train, seed, work / runtime)
        yield counted[""] | {"runtime": runtime, "folder": runtime}


def _save_torch(model: Any, train: Dataset, seed: int, folder: Path) -> None:
    """The network as TorchScript, which can be read without our code."""
    import torch  # here: other models need no PyTorch

    with warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter("ignore", DeprecationWarning)
        traced: Any = torch.jit.trace(model.network.eval(), torch.from_numpy(train.samples[:1]))
        traced.save(folder / measure.TORCH)


def _save_aeon(model: Any, train: Dataset, seed: int, folder: Path) -> None:
    """aeon's parameters, fitted to the same sweeps once more, and the head that was trained on its
    features."""
    arrays: dict[str, Any] = {
        f"p{i}": p for i, p in enumerate(minirocket.fitted(train.samples, seed))
    }
    arrays["silence"] = np.zeros((1, train.format.channels, train.format.window), np.float32)
    np.savez_compressed(folder / measure.AEON, weight=model.weight, bias=model.bias, **arrays)


PEERS: Mapping[str, tuple[str, Callable[[Any, Dataset, int, Path], None]]] = {
    "paper-cnn-centred": ("torch", _save_torch),
    "minirocket": ("aeon", _save_aeon),
}
"""Methods that are also measured in their own library, which the box does not have."""
