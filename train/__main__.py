"""The room of the command `palpate-train`: arguments in, one line per result out. Each command is one room's work."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from appliance.errors import ApplianceError, FormatError
from appliance.sim.bench import commit

from . import export, fit, sets


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; its exit code. Troubles that have a name are one line on the error stream."""
    args = _parser().parse_args(argv)
    try:
        args.run(args)
    except ApplianceError as e:
        print(f"palpate-train: {e}", file=sys.stderr)
        return e.exit_code
    except OSError as e:
        print(f"palpate-train: {e.filename}: {e.strerror}", file=sys.stderr)
        return ApplianceError.exit_code
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="palpate-train", description="Trains, judges and exports Palpate's models.")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    def add(name: str, run: Callable[[argparse.Namespace], None], text: str) -> argparse.ArgumentParser:
        command = commands.add_parser(name, help=text, description=text.capitalize() + ".")
        command.set_defaults(run=run)
        return command

    recipe = fit.Recipe()
    one = add("fit", run_fit, "train a network on sweep sets")
    one.add_argument("--set", action="append", required=True, metavar="SET", dest="sets",
                     help="FILE.npz or sim:NAME[:SEED[-LAST][:SWEEPS]]; several are joined")  # fmt: skip
    one.add_argument("--seed", type=int, required=True, help="of the training, and of simulated sets that name none")
    one.add_argument("--out", type=Path, required=True, metavar="FIT", help="where the fit goes (.npz)")
    one.add_argument("--only", action="append", default=[], metavar="GROUP<=N", help="keep sweeps with =, <= or >=")
    one.add_argument("--split", metavar="GROUP:SHARE", help="train on this share of a group, e.g. recording:0.7")
    one.add_argument("--rest", type=Path, metavar="FILE", help="write what --split left out as a sweep set")
    one.add_argument("--steps", type=int, default=recipe.steps, help=f"of training (default {recipe.steps})")
    one.add_argument("--row-shift", type=float, default=recipe.row_shift, metavar="SHARE",
                     help="share of training sweeps moved by a row of taxels (default 0)")  # fmt: skip
    one.add_argument("--stretch", type=float, default=recipe.stretch, metavar="SHARE",
                     help="change the speed of training sweeps by up to this share (default 0)")  # fmt: skip
    one.add_argument("--keep-means", action="store_true", help="show the head each taxel's mean too, for comparison")
    two = add("export", run_export, "quantize a fit and pack its bundle")
    two.add_argument("fit", type=Path, metavar="FIT", help="what palpate-train fit wrote")
    two.add_argument("--out", type=Path, required=True, metavar="DIR", help="the bundle; one that is there is replaced")
    two.add_argument("--name", required=True)
    two.add_argument("--version", required=True)
    two.add_argument("--full-scale", type=float, help="the sensor's highest digit (default: its type's)")
    three = add("yardsticks", run_yardsticks, "write the models that palpate bench times beside the bundle")
    three.add_argument("--out", type=Path, required=True, metavar="DIR")
    return parser


def run_fit(args: argparse.Namespace) -> None:
    """Train, save the fit and say how it does on what was held out."""
    if args.rest and not args.split:
        raise FormatError("--rest needs --split; without it nothing is left over")
    sweeps = sets.join([sets.load(spec, args.seed) for spec in args.sets]).select(args.only)
    if args.split:
        by, share = _by_share(args.split)
        sweeps, rest = sweeps.split(by, share, args.seed)
        if args.rest:
            args.rest.parent.mkdir(parents=True, exist_ok=True)
            rest.save(args.rest)
            print(f"rest: {len(rest)} sweeps in {args.rest}")
    recipe = fit.Recipe(steps=args.steps, row_shift=args.row_shift, stretch=args.stretch, keep_means=args.keep_means)
    made = fit.fit(sweeps, args.seed, recipe, _progress)
    made.save(args.out)
    print(f"fit: {len(made.train)} sweeps, {made.train.format}; held-out {made.about['held_out_by']}: "
          f"{_spoken(made.about['validation'])}; {args.out}")  # fmt: skip


def run_export(args: argparse.Namespace) -> None:
    """Pack the bundle and say how it does."""
    manifest = export.export(fit.Fit.load(args.fit), args.out, args.name, args.version, commit(), args.full_scale)
    for protocol, figure in manifest.figures.items():
        if "accuracy" in figure:
            print(f"{protocol}: {_spoken(figure)}")
    size = sum(f.stat().st_size for f in args.out.iterdir())
    print(f"bundle: {manifest.name} {manifest.version}, {size} bytes in {args.out}")


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


def _progress(line: str) -> None:
    """One line that is written over, for eyes only."""
    if sys.stderr.isatty():
        print(f"\r{line}\033[K", end="", file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())
