"""The card of a bundle, card.md: its origin and its limits, for people and programs.

It repeats the manifest and the training sweeps. The box does not read it, and the signature does
not cover it.
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from palpate.bundle.manifest import Manifest
from palpate_train.answer import altered_sweeps, fit_early, fit_taxels, rules, stranger_limits
from palpate_train.data.sets import Dataset, digest

NAME = "card.md"
NOT_STATED = "not stated"
UNLIMITED = "unknown materials: not noticed, each gets the label of a known one"
Json = dict[str, Any]


def data(train: Dataset, licence: str) -> Json:
    """The entry `data` of a manifest's `made`: a description of the training sweeps."""
    counted = {
        name: len(np.unique(train.groups[name]))
        for name in ("session", "position", "object")
        if name in train.groups
    }
    return {
        "digest": digest(train),
        "sweeps": np.bincount(train.labels, minlength=len(train.materials)).tolist(),
        "groups": counted,
        "licence": licence or NOT_STATED,
    }


def text(manifest: Manifest, pitch_mm: float | None) -> str:
    """The card: a head in YAML, then sentences. JSON values are YAML, too."""
    about = manifest.made.get("data", {})
    protocol, figure = _held_out(manifest)
    head = {
        "name": manifest.name,
        "version": manifest.version,
        "license": about.get("licence", NOT_STATED),
        "sensor": str(manifest.format),
        "rate_hz": manifest.format.rate_hz,
        "pitch_mm": pitch_mm or (manifest.contact.pitch_mm if manifest.contact else None),
        "materials": dict(zip(manifest.labels, about.get("sweeps", []), strict=False)),
        "display_names": manifest.displays,
        "groups": about.get("groups", {}),
        "protocol": protocol or None,
        "accuracy": figure.get("accuracy"),
        "interval_95": [figure["low"], figure["high"]] if "low" in figure else None,
        "unknown_materials": _novelty(manifest),
        "training_set": manifest.made.get("set"),
        "training_digest": about.get("digest"),
    }
    lines = [f"{key}: {json.dumps(value, ensure_ascii=False)}" for key, value in head.items()]
    return "\n".join(["---", *lines, "---", "", *_sentences(manifest, protocol, figure), ""])


def _held_out(manifest: Manifest) -> tuple[str, Json]:
    """Protocol and figures of the box's answers to held-out sweeps; "" and {} without them."""
    for name, figure in manifest.figures.items():
        if name.startswith("held-out"):  # the hardest condition comes first
            return name, figure
    return "", {}


def _novelty(manifest: Manifest) -> Json | None:
    """The limit of known materials, and the share of known held-out sweeps that it calls
    unknown."""
    if manifest.known is None:
        return None
    _, figure = _held_out(manifest)
    share = figure["unknown"] / figure["n"] if figure.get("n") and "unknown" in figure else None
    return {"limit": manifest.known.balanced, "known_called_unknown": share}


def _sentences(manifest: Manifest, protocol: str, figure: Json) -> list[str]:
    """The text below the head."""
    lines = [f"# {manifest.name} {manifest.version}", ""]
    lines += [f"Names {len(manifest.labels)} materials from sweeps of {manifest.format}.", ""]
    if figure:
        lines += [
            f"On {figure['n']} sweeps ({protocol}) its accuracy is "
            f"{100 * figure['accuracy']:.1f} %, with a 95 % interval from "
            f"{100 * figure['low']:.1f} % to "
            f"{100 * figure['high']:.1f} %.",
            "They helped to choose the model, so expect slightly less of others.",
            "",
        ]
    lines += ["## What breaks it", "", fit_taxels.text(manifest), ""]
    if judged := rules.text(manifest):
        lines += [judged, ""]
    if early := fit_early.text(manifest):
        lines += [f"{early}.", ""]
    if manifest.known:
        for limit in stranger_limits.COSTS:
            if cost := stranger_limits.lines(manifest.figures, limit):
                lines += [f'- `classifier.strangers = "{limit}"`: {"; ".join(cost)}']
        lines += ["", altered_sweeps.text(manifest.figures), ""]
    else:
        lines += [UNLIMITED, ""]
    if manifest.format.dtype == "float32":
        lines += [
            "The box refuses a sweep with a count that is NaN or infinite. `model.onnx` alone, in "
            "the C API of onnxruntime for example, takes NaN for the lowest count: check counts "
            "before you call it.",
            "",
        ]
    if why := manifest.made.get("contact_unknown_because"):
        lines += [f"It cannot detect a missing contact: {why}.", ""]
    return lines
