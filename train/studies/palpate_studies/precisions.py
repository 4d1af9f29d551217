"""Every precision of a method as a packed model."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from palpate.core import provenance, storage
from palpate_studies import cost
from palpate_train.data import sets
from palpate_train.data.sets import Dataset
from palpate_train.evaluate.fold import fingerprint
from palpate_train.export import contents, pack, quantized_bundle
from palpate_train.models import methods
from palpate_train.models.method_fit import MethodFit
from palpate_train.models.methods import Method
from palpate_train.models.recipe.fitted import FittedModel

INDEX, WHOLE = "dots.json", "whole"


@dataclass(frozen=True)
class Packed:
    """A bundle in `folder`.

    form: "" for the method itself, else the name of another of its precisions. precision, weights,
    macs: as palpate_studies.cost counts them. whole: the bundle as it ships, with all its rules;
    None for another precision and for a peer, which have none.
    """

    method: str
    form: str
    precision: str
    folder: Path
    weights: int
    macs: int
    whole: Path | None = None


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
    whole = folder / WHOLE
    return [
        Packed(
            method.name,
            folder=folder / entry.pop("folder"),
            whole=whole if whole.exists() and not entry["form"] else None,
            **entry,
        )
        for entry in entries
    ]


def _packed_forms(
    method: Method, sweeps: Dataset, seed: int, work: Path
) -> Iterator[dict[str, Any]]:
    """Each precision packed in a folder of its own, and a model of ours as it ships."""
    model, made = MethodFit.of(method, sweeps, seed)
    if isinstance(model, FittedModel):
        quantized_bundle.pack_fold(model.fit, work / WHOLE)
    content = contents.content_of(made)
    counted: dict[str, dict[str, Any]] = {}
    for form, graphed in {"": model, **getattr(model, "precisions", {})}.items():
        graph = graphed.graph()
        precision = cost.precision(graph)
        if any(precision == entry["precision"] for entry in counted.values()):
            continue  # nothing in it is int8: both precisions are the same
        folder = work / precision
        about = content.about | ({"form": form} if form else {})
        measured = replace(content, model=graph, about=about)
        pack.pack(measured, folder, about["method"], "1", provenance.commit(), proven=False)
        counted[form] = {
            "form": form,
            "precision": precision,
            "weights": cost.weights(graph),
            "macs": cost.macs(graph) + cost.feature_macs(method.input, content.train.format),
        }
        yield counted[form] | {"folder": folder.name}
