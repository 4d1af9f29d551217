"""The command `fit`: sweep sets to a fit, of the smallest size that suffices if there is a wish."""

from __future__ import annotations

import argparse
import json
import math
import shlex
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from palpate.core.errors import FormatError
from palpate.core.outputs import Row, add_rows
from palpate.core.storage import put
from palpate.core.sweep_set import Array
from palpate.core.text import say
from palpate_train.answer import stranger_limits
from palpate_train.arguments import numbers, options, scene_file
from palpate_train.arguments.options import EFFORT, FLAG, SEED, above_zero, path, text
from palpate_train.arguments.program import Add
from palpate_train.data import extras, labels
from palpate_train.data.group_values import text_of
from palpate_train.data.run import Run
from palpate_train.data.sets import Dataset, digest
from palpate_train.data.splitters import OF_THE_SET
from palpate_train.data.transforms import WHOLE, Change
from palpate_train.evaluate import trivial
from palpate_train.evaluate.evaluate import CACHE
from palpate_train.evaluate.fold import fingerprint
from palpate_train.export.measure import BundleCost
from palpate_train.metrics import score
from palpate_train.models import methods
from palpate_train.models.method_fit import MethodFit
from palpate_train.models.methods import SkinUse
from palpate_train.models.recipe import memory, recipe
from palpate_train.models.recipe.fitted import Fit
from palpate_train.models.recipe.sizes import SIZES, UNLIMITED
from palpate_train.reports import formatting
from palpate_train.selection import dial, reduction_curves
from palpate_train.selection.dial import Budget, SizeWish

Json = dict[str, Any]
MAINS = (50, 60)
"""Frequencies of the mains in Hz: public grids have no others."""
STEPS, MOST = recipe.STAGE_STEPS, memory.MOST_SWEEPS


# fmt: off
_OPTIONS: tuple[Row, ...] = (
    ("--scene", "options in a file, as docs/choose/tubes.toml", path()),
    SEED,
    ("--out", "where the fit goes (.npz)", path("FIT", required=True)),
    ("--split", "train on this share of a group, e.g. recording:0.7", text("GROUP:SHARE")),
    ("--rest", "write what --split left out as a sweep set", path()),
    ("--varies", "groups that will have other values in service, e.g. force,speed; each is held"
        " out for the limits and for the printed accuracy (default: all that can be)",
        text("GROUP,...", (), type=lambda text: tuple(text.split(",")))),
    ("--most-sweeps", "largest number of sweeps that the model is fitted to; of more, some of each"
        f" recording are drawn (default {MOST}); memory and time grow with it",
        text("N", MOST, type=numbers.whole("--most-sweeps", 1))),
    ("--method", "train this method instead of our recipe; see palpate-train evaluate --list",
        text("NAME")),
    EFFORT,
    ("--reattached", "the skin will be taken off and put back after the recordings: train all heads"
        " on augmented copies of that, too", FLAG),
    ("--mains", f"frequency of the mains where the skin is used, {MAINS[0]} or {MAINS[1]}; the"
        f" features ignore its hum (default {SkinUse().mains_hz:g})",
        text("HZ", int(SkinUse().mains_hz), type=int, choices=MAINS)),
    ("--stages", f"train stages, too ({STEPS} steps), and let them join where held-out sweeps show"
        " a gain; takes most of the time",
        text("STEPS", 0, type=numbers.whole("--stages", 1), nargs="?", const=STEPS, dest="steps")),
    ("--size", "; ".join(f"{name}: at most {size.about}" for name, size in SIZES.items())
        + " (default: no limit)", {"choices": SIZES}),
    above_zero("--budget-ms", "MS", "processor time of a sweep on the board: choose"
        " the smallest size that suffices within this"),
    above_zero("--budget-kb", "KB", "size of the bundle in 1000 bytes: choose the"
        " smallest size that suffices within this"),
    above_zero("--slower", "TIMES", "assumed time on the board as a multiple of the"
        " time here (1)"),
    ("--accuracy", "choose the smallest size that reaches this on held-out sweeps",
        text("SHARE", type=numbers.number("--accuracy", lambda x: 0 < x <= 1, "above 0, to 1"))),
    ("--reduce", f"show how much less suffices, of {', '.join(reduction_curves.REDUCTIONS)}; the"
        " fit has the shorter window, the others need another sensor",
        text("WHAT", nargs="+", choices=reduction_curves.REDUCTIONS)),
)
# fmt: on


def register(add: Add) -> None:
    """fit."""
    command = add("fit", run_fit)
    command.set_defaults(resumes=True, parser=command)
    options.add_set(command, required=False)
    add_rows(command, *_OPTIONS)


def run_fit(args: argparse.Namespace) -> None:
    """Train, save the fit and print its accuracy on the held-out sweeps."""
    if args.scene:
        words = [*scene_file.words(args.scene, args.parser), *args.words[1:]]
        args = argparse.Namespace(**vars(args.parser.parse_args(words)) | {"words": args.words})
    _check(args)
    sweeps, strangers = labels.check(options.load(args, args.seed)).taught()
    rest = None
    if args.split:
        sweeps, rest = sweeps.split(*options.group_share(args.split), args.seed)
    if args.method:
        _fit_method(args, sweeps)
        return
    memory.check(sweeps, min(len(sweeps), args.most_sweeps))
    made, change, unfinished = _fitted(args, sweeps, strangers)
    if args.rest and rest:
        change.of(rest).save(args.rest)
        made = replace(made, about=made.about | {"rest": str(args.rest)})
    made.save(args.out)
    if unfinished:
        shutil.rmtree(unfinished, ignore_errors=True)
    of = f", {len(made.train)} of them to train stages" if made.architecture.channels else ""
    say(f"fit: {made.sweeps} sweeps{of}, {made.train.format}; {args.out}")
    if len(sweeps) > args.most_sweeps:
        say(
            f"used: {args.most_sweeps} of {len(sweeps)} sweeps, some of each recording; "
            "--most-sweeps N uses more, with more memory and time"
        )
    _print_held_out(made)
    if beside := trivial.beside_a_fit(sweeps, args.varies):
        told = "; ".join(f"{name} {formatting.counted(figure)}" for name, figure in beside.items())
        say(f"trivial baselines on held-out parts: {told}")
    if args.rest and rest:
        say(f"rest: {len(rest)} sweeps in {args.rest}, which no part of the fit has seen")
    judges = ["--set", str(args.rest)] if args.rest and rest else _judges(args)
    say(*_next_commands(args.out, judges if args.rest or change == WHOLE else []))


def _fit_method(args: argparse.Namespace, sweeps: Dataset) -> None:
    """Train a method that is not our recipe, and save it for export."""
    (method,) = methods.find([args.method], options.effort(args))
    _, made = MethodFit.of(method, sweeps, args.seed)
    made.save(args.out)
    say(f"fit: {made.about['method']} to {len(made.train)} sweeps; {args.out}")
    say(*_next_commands(args.out, _judges(args)))


def _judges(args: argparse.Namespace) -> list[str]:
    """The options that name the sweeps of this fit to another command."""
    words = [word for one in args.sets for word in ("--set", one)]
    words += [word for pair in args.rename for word in ("--rename", pair)]
    return words + (["--only", *args.only] if args.only else [])


def _next_commands(out: Path, judges: Sequence[str]) -> list[str]:
    """The commands after a fit, as they can be pasted. judges: options that name the sweeps to
    judge the bundle on; none where no set has its window."""
    folder = out.with_suffix("") if out.suffix else out.with_name(f"{out.name}-bundle")
    version = ["--name", folder.name, "--version", "1"]
    commands = (
        ["export", str(out), "--out", str(folder), *version],
        ["score", str(folder), *judges],
        ["report", str(out), *judges, "--out", str(out.with_suffix(".html"))],
    )
    able = commands if judges else commands[:1]
    return ["next:", *(f"  palpate-train {shlex.join(words)}" for words in able)]


def _check(args: argparse.Namespace) -> None:
    """Refuse options that do not go together, before hours of work. Raises FormatError."""
    if not args.sets:
        raise FormatError("no sweeps; name a set with --set, or with set in the file of --scene")
    if args.method:
        methods.find([args.method])
        ours = ("rest", "split", "varies", "size", "budget_ms", "budget_kb", "accuracy", "reduce")
        if given := [name for name in ours if getattr(args, name)]:
            option = given[0].replace("_", "-")
            raise FormatError(f"--{option} is of our recipe; leave it out with --method")
    if args.rest and not args.split:
        raise FormatError("--rest needs --split; without it nothing is left over")
    if args.size == "stages" and not args.steps:
        raise FormatError("--size stages needs --stages; without them it is --size pairs")
    if args.steps and not extras.installed("torch"):
        raise FormatError(f"--stages needs torch; {extras.advice('torch')}, or leave it out")
    if args.slower and not args.budget_ms:
        raise FormatError("--slower needs --budget-ms; without a limit of time it changes nothing")
    for option, endings in (("out", (".npz",)), ("rest", options.SET_FILES)):
        if path := getattr(args, option):
            options.writable_file(path, f"--{option}", *endings)


def _fitted(
    args: argparse.Namespace, sweeps: Dataset, strangers: Array | None
) -> tuple[Fit, Change, Path | None]:
    """The fit for these options, the reduction of its sweeps, and the folder that keeps the
    training of stages until the fit is written."""
    use = SkinUse(args.reattached, float(args.mains))
    log, unfinished = options.Log(), _unfinished(args, sweeps, use) if args.steps else None
    run = Run(args.seed, log, unfinished)
    settings = recipe.Settings(
        args.steps,
        size=SIZES.get(args.size, UNLIMITED),
        use=use,
        varies=args.varies,
        most=args.most_sweeps,
        strangers=strangers,
    )
    wish = (args.budget_ms, args.budget_kb, args.accuracy, args.reduce)
    if any(wish):
        made, change = _chosen(args, sweeps, run, settings)
        log.end()
        return made, change, unfinished
    made = recipe.fit(sweeps, run, settings)
    log.end()
    held_out = formatting.counted(made.about["validation"])
    say(f"chosen: {made.about['chosen']}; {held_out} of held-out parts")
    return made, WHOLE, unfinished


def _chosen(
    args: argparse.Namespace, sweeps: Dataset, run: Run, settings: recipe.Settings
) -> tuple[Fit, Change]:
    """The fit of the smallest size that suffices, on reduced sweeps if they suffice; writes the
    page with the reasons."""
    with extras.needed_for("the page with the reasons for a size"):
        from palpate_train.reports import selection_report
    budget = Budget(args.budget_ms or math.inf, args.budget_kb or math.inf, args.slower or 1.0)
    sizes = (args.size,) if args.size else dial.sizes(stages=args.steps > 0)
    wish = SizeWish(budget, args.accuracy or 0.0, sizes)
    choice = dial.choose(sweeps, run, settings, wish)
    less, change = reduction_curves.curves(choice, args.reduce or ())
    made, cost, refused = choice.fit, choice.costs[choice.chosen], ""
    if change != WHOLE:
        try:
            made, cost = dial.reduced(choice, change)
        except FormatError as e:
            refused, change = str(e), WHOLE
    result = choice.json() | {"less": less, "applied": asdict(change)}
    result |= {"bundle": _described(made, cost, budget, refused)} | _origin(args, sweeps, budget)
    page = args.out.with_name(f"{args.out.stem}-why") / "index.html"
    put(page.with_name("choice.json"), (json.dumps(result, indent=1) + "\n").encode(), parents=True)
    put(page, selection_report.page(result).encode(), parents=True)
    say(*selection_report.text(result).split("\n"))
    say(f"why: {page}")
    return replace(made, about=made.about | {"size": choice.chosen}), change


def _described(made: Fit, cost: BundleCost, budget: Budget, refused: str) -> Json:
    used = {k: round(v, 3) for k, v in budget.used(cost).items()}
    about = {"content": made.about["chosen"], "format": made.train.format.json(), "used": used}
    return about | asdict(cost) | {"refused_with_less": refused}


def _origin(args: argparse.Namespace, sweeps: Dataset, budget: Budget) -> Json:
    """The origin of the result: command, set, commit."""
    return {
        "command": shlex.join(["palpate-train", *args.words]),
        "set": sweeps.source,
        "digest": digest(sweeps),
        "sweeps": len(sweeps),
        "format": sweeps.format.json(),
        "materials": list(sweeps.materials),
        "reattached": args.reattached,
        "steps": args.steps,
        "budget": {k: v for k, v in asdict(budget).items() if v != math.inf},
        "seeds": [args.seed],
    } | score.provenance()


def _unfinished(args: argparse.Namespace, sweeps: Dataset, use: SkinUse) -> Path:
    """The folder that keeps a training until the fit is written. Its name is a fingerprint of all
    that the training depends on."""
    about = [digest(sweeps), args.seed, args.size, args.steps, args.varies, asdict(use)]
    about += [args.most_sweeps] * (len(sweeps) > args.most_sweeps)
    modules = (f"palpate_train.models.recipe.{name}" for name in ("recipe", "stages"))
    return CACHE / fingerprint(about, *modules)


def _worst(made: Fit) -> Iterator[str]:
    """A line for each condition: the value with the worst accuracy. Beyond an outermost value no
    figure of these sweeps shows what to expect."""
    for name, (value, right, total, outermost) in made.worst_values().items():
        if right < total:
            unit = f" {made.train.units[name]}" if name in made.train.units else ""
            share = formatting.percent(right / total, 0)
            said = "; outermost: expect less beyond it" if outermost else ""
            yield f"worst {name}: {text_of(value)}{unit}, {share} of {total}{said}"


def _print_held_out(made: Fit) -> None:
    """Print the accuracy on the sweeps that judged the fit, and how they differ from the sweeps of
    --rest."""
    if made.about["held_out_by"] == "nothing":
        say(
            "nothing was held out that could judge the model, so export will refuse it: "
            f"{made.uncalibrated}"
        )
        return
    conditions = made.about["conditions"]
    if conditions == ["recording"]:
        say("recorded under one condition: expect less under another; these figures are optimistic")
    say(
        f"held-out {', '.join(conditions)}: sweeps of this set, by heads that did not see their "
        f"{' or '.join(conditions)}; slightly too high, since they also helped to choose the model"
    )
    for name in conditions:
        if name != "recording" and len(made.values(name)) == 2:
            say(
                f"there are two values of {name}: its figures are of heads that know only one, "
                "so expect more"
            )
    for name in sorted(set(made.train.groups) - {*OF_THE_SET, *conditions}):
        if len(made.values(name)) == 1:
            say(f"every sweep has the same {name}: expect less at another, no figure shows it")
    if made.calibration:
        say(*formatting.figure_lines(figures := made.held_out_figures()))
        say(*_worst(made))
        if cost := stranger_limits.lines(figures):
            say(*cost, "export prints these again, for limits that also know altered sweeps")
        if len(conditions) > 1:
            mean = sum(figures[f"held-out {name}"]["accuracy"] for name in conditions)
            share = formatting.percent(mean / len(conditions))
            say(f"to expect where one of these is new, as the box answers: {share} (their mean)")
    else:  # too few sweeps to judge by
        alone = formatting.counted(made.about["validation"])
        say(f"network alone: {alone}; nothing judges the box's answers: {made.uncalibrated}")
