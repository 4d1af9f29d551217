"""The command choose. In: scene.toml. Out: a bundle, choice.json, and the page that says why."""

from __future__ import annotations

import argparse
import json
import shlex
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from appliance.bundle.manifest import Manifest
from appliance.core.provenance import commit
from appliance.core.storage import put
from train.cli import options
from train.data.sets import Dataset, digest
from train.data.transforms import WHOLE, Change
from train.export import measure, pack
from train.metrics import score
from train.models import methods
from train.reports import selection_report
from train.selection import reduction_curves, scene, select
from train.selection.select import BundleCost

Json = dict[str, Any]


def register(add: Callable[..., argparse.ArgumentParser]) -> None:
    """The command, with its options."""
    command = add("choose", run, "pick the smallest model that a scene needs, and pack its bundle")
    command.add_argument("--scene", type=Path, required=True, metavar="FILE", help="as docs/choose/tubes.toml")
    command.add_argument("--out", type=Path, required=True, metavar="DIR", help="the bundle; replaced if it is there")
    command.add_argument(
        "--page", type=Path, metavar="DIR", help="for index.html and choice.json (DIR of --out + -why)"
    )
    options.add_effort(command)
    options.add_where(command)


def run(args: argparse.Namespace) -> None:
    """Choose, pack, write why, and say it. Raises FormatError for a broken scene, NothingFits where no model fits it."""
    asked = scene.read(args.scene)
    sweeps, log = asked.sweeps(), options.Log()
    choice = select.choose(sweeps, asked, options.effort(args), options.where(args), log)
    less, change, accuracy = reduction_curves.curves(choice, asked, log)
    told = choice.json(asked) | {"less": less, "applied": asdict(change), "left": accuracy}
    told["bundle"] = _packed(args, asked, sweeps, told, change)
    told |= _origin(args, asked, sweeps)
    page = args.page or args.out.with_name(f"{args.out.name}-why")
    put(page / "choice.json", (json.dumps(told, indent=1) + "\n").encode(), parents=True)
    put(page / "index.html", selection_report.page(told).encode(), parents=True)
    print(selection_report.text(told))
    print(f"bundle: {args.out}; why: {page / 'index.html'}")


def _packed(args: argparse.Namespace, asked: scene.Scene, sweeps: Dataset, told: Json, change: Change) -> Json:
    """Pack what was chosen, with less where the box can run it and will; what is in the bundle, and what it costs."""
    (method,) = methods.find([told["chosen"]], options.effort(args))
    refused = ""
    if change != WHOLE:
        try:
            return _pack(args, asked, method, change.of(sweeps), told)
        except pack.ExportRefused as e:
            refused = str(e)
    return _pack(args, asked, method, sweeps, told) | {"refused_with_less": refused}


def _pack(args: argparse.Namespace, asked: scene.Scene, method: methods.Method, sweeps: Dataset, told: Json) -> Json:
    content = pack.trained(method, sweeps, 1)
    nested = told["honest"]
    figure = {"accuracy": nested["mean"], "n": len(sweeps), "low": nested["low"], "high": nested["high"]}
    content = replace(content, about=content.about | {"scene": asked.path.name},
                      figures={"the choice, made without each part and tested on it": figure})  # fmt: skip
    manifest = pack.pack(content, args.out, asked.name, asked.version, commit(), asked.full_scale or None)
    (measurement,) = measure.measure_all([args.out], sweeps.samples)
    return _described(manifest, BundleCost.of(measurement), asked)


def _described(manifest: Manifest, cost: BundleCost, asked: scene.Scene) -> Json:
    used = {k: round(v, 3) for k, v in cost.used(asked.budget).items()}
    return {"name": manifest.name, "version": manifest.version, "format": asdict(manifest.format), "ms": cost.ms,
            "kb": cost.kb, "mb": cost.mb, "used": used, "figures": manifest.figures}  # fmt: skip


def _origin(args: argparse.Namespace, asked: scene.Scene, sweeps: Dataset) -> Json:
    """Where it all comes from."""
    effort = options.effort(args)
    words = ["palpate-train", "choose", "--scene", str(args.scene), "--out", str(args.out)]
    words += ["--page", str(args.page)] if args.page else []
    words += ["--effort", f"{effort.share:g}"] if effort.share != 1 else []
    budget = {k: v for k, v in vars(asked.budget).items() if v != float("inf")}
    return {
        "scene": asked.name, "command": shlex.join(words), "set": sweeps.source, "digest": digest(sweeps), "sweeps": len(sweeps),
        "format": asdict(sweeps.format), "materials": list(sweeps.materials), "merge": dict(asked.merge),
        "varies": list(asked.varies), "stress": dict(asked.stress), "budget": budget, "effort": effort.share,
        "seeds": list(range(1, asked.seeds + 1)),
    } | score.provenance()  # fmt: skip
