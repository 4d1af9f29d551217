"""The command `choose`: reads a scene.toml; writes a bundle, choice.json and a page with the
reasons."""

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
from train.arguments import options
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
    command = add("choose", run)
    command.add_argument(
        "--scene", type=Path, required=True, metavar="FILE", help="as docs/choose/tubes.toml"
    )
    command.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="the bundle; replaced if it is there"
    )
    command.add_argument(
        "--page",
        type=Path,
        metavar="DIR",
        help="for index.html and choice.json (DIR of --out + -why)",
    )
    options.add_effort(command)
    options.add_where(command)


def run(args: argparse.Namespace) -> None:
    """Choose, pack, write and print the reasons. Raises FormatError for an invalid scene, and
    NothingFits if no model fits."""
    pack.check_target(args.out)
    page = args.page or args.out.with_name(f"{args.out.name}-why")
    options.writable(page / "choice.json", "--page")
    requested = scene.read(args.scene)
    sweeps = requested.sweeps()
    choice = select.choose(
        sweeps,
        requested,
        options.effort(args),
        options.where(args),
        options.Log(),
        lambda trials: reduction_curves.most(trials, requested.reduce),
    )
    curves, change, accuracy = reduction_curves.curves(choice, requested)
    result = choice.json(requested) | {"less": curves, "applied": asdict(change), "left": accuracy}
    result["bundle"] = _packed(args, requested, sweeps, result, change)
    result |= _origin(args, requested, sweeps)
    put(page / "choice.json", (json.dumps(result, indent=1) + "\n").encode(), parents=True)
    put(page / "index.html", selection_report.page(result).encode(), parents=True)
    print(selection_report.text(result))
    print(f"bundle: {args.out}; why: {page / 'index.html'}")
    print(options.report_line(args.out))


def _packed(
    args: argparse.Namespace, requested: scene.Scene, sweeps: Dataset, result: Json, change: Change
) -> Json:
    """Pack the chosen method, on reduced sweeps if their bundle passes the checks; the bundle's
    content and cost."""
    (method,) = methods.find([result["chosen"]], options.effort(args))
    refused = ""
    if change != WHOLE:
        try:
            return _pack(args, requested, method, change.of(sweeps), result)
        except pack.ExportRefused as e:
            refused = str(e)
    return _pack(args, requested, method, sweeps, result) | {"refused_with_less": refused}


def _pack(
    args: argparse.Namespace,
    requested: scene.Scene,
    method: methods.Method,
    sweeps: Dataset,
    result: Json,
) -> Json:
    content = pack.trained(method, sweeps, 1)
    nested = result["honest"]
    figure = {
        "accuracy": nested["mean"],
        "n": len(sweeps),
        "low": nested["low"],
        "high": nested["high"],
    }
    content = replace(
        content,
        about=content.about | {"scene": requested.path.name},
        figures={"the choice, made without each part and tested on it": figure},
    )
    manifest = pack.pack(
        content, args.out, requested.name, requested.version, commit(), requested.full_scale or None
    )
    (measurement,) = measure.measure_all([args.out], sweeps.samples)
    return _described(manifest, BundleCost.of(measurement), requested)


def _described(manifest: Manifest, cost: BundleCost, requested: scene.Scene) -> Json:
    used = {k: round(v, 3) for k, v in cost.used(requested.budget).items()}
    return {
        "name": manifest.name,
        "version": manifest.version,
        "format": manifest.format.json(),
        "ms": cost.ms,
        "kb": cost.kb,
        "mb": cost.mb,
        "used": used,
        "figures": manifest.figures,
    }


def _origin(args: argparse.Namespace, requested: scene.Scene, sweeps: Dataset) -> Json:
    """The origin of the result: command, sets, scene, commit."""
    effort = options.effort(args)
    words = ["palpate-train", "choose", "--scene", str(args.scene), "--out", str(args.out)]
    words += ["--page", str(args.page)] if args.page else []
    words += ["--effort", f"{effort.share:g}"] if effort.share != 1 else []
    budget = {k: v for k, v in vars(requested.budget).items() if v != float("inf")}
    return {
        "scene": requested.name,
        "command": shlex.join(words),
        "set": sweeps.source,
        "digest": digest(sweeps),
        "sweeps": len(sweeps),
        "format": sweeps.format.json(),
        "materials": list(sweeps.materials),
        "merge": dict(requested.merge),
        "varies": list(requested.varies),
        "stress": dict(requested.stress),
        "budget": budget,
        "effort": effort.share,
        "seeds": list(range(1, requested.seeds + 1)),
    } | score.provenance()
