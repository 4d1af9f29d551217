"""The room of the command `palpate-train`: arguments in, one line per result out. Each command is one room's work."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from appliance.bundle.bundle import Manifest
from appliance.core.errors import ApplianceError, FormatError
from appliance.core.provenance import commit
from appliance.core.storage import put
from train.cli import options, reports
from train.data import pull, summary
from train.evaluation import evaluate, sim_calibration, uncertainty_cases
from train.export import contact_positions, export, pack, sign
from train.metrics import score
from train.models import methods
from train.models.compact import fit
from train.models.compact.architectures import LADDER, USUAL
from train.reports import chart_report
from train.selection import choose

Add = Callable[[str, Callable[[argparse.Namespace], None], str], argparse.ArgumentParser]


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; its exit code. Troubles that have a name are one line on the error stream."""
    args = _parser().parse_args(argv)
    try:
        score.provenance()  # the code that runs is that of now
        args.run(args)
    except ApplianceError as e:
        print(f"palpate-train: {e}", file=sys.stderr)
        return e.exit_code
    except OSError as e:
        print(f"palpate-train: {e.filename}: {e.strerror}", file=sys.stderr)
        return ApplianceError.exit_code
    except KeyboardInterrupt:
        print("palpate-train: interrupted; the same command goes on where it was", file=sys.stderr)
        return 130
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="palpate-train", description="Trains, judges and exports Palpate's models.")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    def add(name: str, run: Callable[[argparse.Namespace], None], text: str) -> argparse.ArgumentParser:
        command = commands.add_parser(name, help=text, description=text.capitalize() + ".")
        command.set_defaults(run=run)
        return command

    add("methods", run_methods, "list the methods that evaluate knows")
    _add_evaluate(add)
    _add_fit(add)
    _add_bundles(add)
    for room in (
        summary,
        pull,
        export,
        sign,
        contact_positions,
        reports,
        chart_report,
        choose,
        uncertainty_cases,
        sim_calibration,
    ):
        room.register(add)
    return parser


def _add_evaluate(add: Add) -> None:
    one = add("evaluate", run_evaluate, "train and test methods under a protocol")
    options.add_set(one)
    one.add_argument("--protocol", action="append", required=True, metavar="PROTOCOL", dest="protocols",
                     help="random:10, leave:GROUP or split:GROUP=a,b->c; hard ones tell more")  # fmt: skip
    one.add_argument("--method", required=True, metavar="NAME[,NAME...]", help="or all; see palpate-train methods")
    one.add_argument("--remove-means", action="store_true", help="take each window's mean away, taxel by taxel")
    one.add_argument("--seeds", type=int, default=1, metavar="N", help="of training and random folds: 1 to N (1)")
    one.add_argument("--json", type=Path, metavar="FILE", help="write the results there")
    options.add_effort(one)
    options.add_where(one)


def _add_fit(add: Add) -> None:
    recipe = fit.Recipe()
    one = add("fit", run_fit, "train a network on sweep sets")
    options.add_set(one)
    one.add_argument("--seed", type=int, required=True, help="of the training, and of simulated sets that name none")
    one.add_argument("--out", type=Path, required=True, metavar="FIT", help="where the fit goes (.npz)")
    one.add_argument("--split", metavar="GROUP:SHARE", help="train on this share of a group, e.g. recording:0.7")
    one.add_argument("--rest", type=Path, metavar="FILE", help="write what --split left out as a sweep set")
    one.add_argument("--steps", type=int, default=recipe.steps, help=f"of training (default {recipe.steps})")
    one.add_argument("--row-shift", type=float, metavar="SHARE", dest="moved",
                     help="share of training sweeps whose skin is moved by up to a row (default 0.5)")  # fmt: skip
    one.add_argument("--stretch", type=float, metavar="SHARE",
                     help="change the speed of training sweeps by up to this share (default 0)")  # fmt: skip
    one.add_argument(
        "--size", choices=[*LADDER, "usual"], default="usual", help="rung of the ladder (default: as compact)"
    )
    one.add_argument("--keep-means", action="store_true", help="show the head each taxel's mean too, for comparison")


def _add_bundles(add: Add) -> None:
    """The commands that make what the box runs."""
    one = add("export", run_export, "quantize a fit and pack its bundle")
    one.add_argument("fit", type=Path, metavar="FIT", help="what palpate-train fit wrote")
    two = add("pack", run_pack, "train any method and pack its bundle")
    options.add_set(two)
    two.add_argument("--method", required=True, metavar="NAME", help="see palpate-train methods")
    two.add_argument("--seed", type=int, required=True, help="of the training, and of simulated sets that name none")
    options.add_effort(two)
    for command in (one, two):
        command.add_argument(
            "--out", type=Path, required=True, metavar="DIR", help="the bundle; replaced if it is there"
        )
        command.add_argument("--name", required=True)
        command.add_argument("--version", required=True)
        command.add_argument("--full-scale", type=float, help="the sensor's highest digit (default: its type's)")
        command.add_argument(
            "--pitch-mm",
            type=float,
            help="from taxel to taxel; without it `palpate place` knows no mm (a simulated skin's is known)",
        )
    three = add("yardsticks", run_yardsticks, "write the models that palpate bench times beside the bundle")
    three.add_argument("--out", type=Path, required=True, metavar="DIR")


def run_methods(args: argparse.Namespace) -> None:
    """One line for each method."""
    for method in methods.every().values():
        extra = f" (needs pip install 'palpate-train[{method.extra}]')" if method.extra else ""
        print(f"{method.name:<16} {method.about}{extra}")


def run_evaluate(args: argparse.Namespace) -> None:
    """Say each result as it comes, and write all of them."""
    sweeps = options.load(args)
    names = options.names(args)
    plan = evaluate.Plan(names, tuple(args.protocols), options.seeds(args), args.remove_means, options.effort(args))
    done: list[dict[str, Any]] = []
    refused: dict[str, str] = {}
    print(evaluate.HEADER)
    for result in evaluate.evaluate(sweeps, plan, options.where(args), options.Log()):
        if result.refused:
            refused[result.method] = result.refused
            continue
        done.append(result.json() | {"only": args.only})
        print(evaluate.line(done[-1]), flush=True)
        if args.json:
            done.sort(key=lambda r: (args.protocols.index(r["protocol"]), names.index(r["method"]), r["seed"]))
            _write(args.json, done)
    if refused:
        raise FormatError("; ".join(f"{name} cannot be used here: {why}" for name, why in refused.items()))


def run_fit(args: argparse.Namespace) -> None:
    """Train, save the fit and say how it does on what was held out."""
    if args.rest and not args.split:
        raise FormatError("--rest needs --split; without it nothing is left over")
    sweeps = options.load(args, args.seed)
    if args.split:
        by, share = _by_share(args.split)
        sweeps, rest = sweeps.split(by, share, args.seed)
        if args.rest:
            args.rest.parent.mkdir(parents=True, exist_ok=True)
            rest.save(args.rest)
            print(f"rest: {len(rest)} sweeps in {args.rest}")
    shape = LADDER.get(args.size, USUAL)
    asked = {name: share for name in ("moved", "stretch") if (share := getattr(args, name)) is not None}
    scene = replace(fit.usual(sweeps.format, shape), **asked)
    recipe = fit.Recipe(steps=args.steps, scene=scene, keep_means=args.keep_means)
    made = fit.fit(sweeps, args.seed, recipe, options.Log(), shape)
    made.save(args.out)
    print(f"fit: {len(made.train)} sweeps, {made.train.format}; held-out {made.about['held_out_by']}: "
          f"{_spoken(made.about['validation'])}; {args.out}")  # fmt: skip


def run_export(args: argparse.Namespace) -> None:
    """Pack the bundle and say how it does."""
    _told(export.export(fit.Fit.load(args.fit), *_packing(args)), args.out)


def run_pack(args: argparse.Namespace) -> None:
    """Train, pack the bundle and say how it does."""
    (method,) = methods.find([args.method], options.effort(args))
    content = pack.trained(method, options.load(args, args.seed), args.seed)
    _told(pack.pack(export.checked(content, content.reference), *_packing(args)), args.out)


def _packing(args: argparse.Namespace) -> tuple[Path, str, str, str, float | None, float | None]:
    return args.out, args.name, args.version, commit(), args.full_scale, args.pitch_mm


def _told(manifest: Manifest, out: Path) -> None:
    for protocol, figure in manifest.figures.items():
        if "accuracy" in figure:
            print(f"{protocol}: {_spoken(figure)}")
    size = sum(f.stat().st_size for f in out.iterdir())
    print(f"bundle: {manifest.name} {manifest.version}, {size} bytes in {out}")


def run_yardsticks(args: argparse.Namespace) -> None:
    """Write the yardsticks and name them."""
    for path in export.yardsticks(args.out):
        print(path)


def _by_share(text: str) -> tuple[str, float]:
    by, _, share = text.partition(":")
    try:
        return by, float(share)
    except ValueError:
        raise FormatError(f"split {text!r} cannot be read; write GROUP:SHARE, e.g. recording:0.7") from None


def _spoken(figure: dict[str, float]) -> str:
    return f"{figure['accuracy']:.3f} [{figure['low']:.3f}, {figure['high']:.3f}] of {figure['n']}"


def _write(path: Path, results: Iterable[dict[str, Any]]) -> None:
    """Write a JSON list, one line each, whole or not at all."""
    put(path, ("[\n" + ",\n".join(json.dumps(result) for result in results) + "\n]\n").encode(), parents=True)
