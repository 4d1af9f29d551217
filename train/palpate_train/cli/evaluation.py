"""The command `evaluate`, which compares methods."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from palpate.core.errors import FormatError
from palpate.core.outputs import Row, add_rows
from palpate.core.storage import put
from palpate.core.text import say
from palpate_train.arguments import options
from palpate_train.arguments.options import EFFORT, FLAG, WHERE, path
from palpate_train.arguments.program import Add
from palpate_train.data.sets import Dataset
from palpate_train.evaluate import evaluate, set_warnings, trivial
from palpate_train.export import quantized_bundle
from palpate_train.models import methods


class ListMethods(argparse.Action):
    """Prints a line for each method and ends the process (--list)."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        say(*method_lines())
        parser.exit()


# fmt: off
_OPTIONS: tuple[Row, ...] = (
    ("--protocol", "random:10, leave:GROUP or split:GROUP=a,b->c; prefer those that leave groups"
        " out", options.text("PROTOCOL", action="append", required=True, dest="protocols")),
    ("--method", "or all; see --list", options.text("NAME[,NAME...]", required=True)),
    ("--remove-means", "subtract the mean of each taxel in each window", FLAG),
    ("--label-alone", "leave out the answers of the box, which take most of the time", FLAG),
    ("--seeds", "seeds of training and random folds: 1 to N (1)", options.text("N", 1, type=int)),
    ("--each", "train on N sweeps of each material, drawn by the seed: a point of a learning curve"
        " (all)", options.text("N", 0, type=int)),
    ("--json", "write the results there", path()),
    EFFORT,
    *WHERE,
)
# fmt: on


def register(add: Add) -> None:
    """evaluate."""
    command = add("evaluate", run_evaluate)
    listed = "the methods that --method takes, and nothing else"
    add_rows(command, ("--list", listed, {"action": ListMethods, "nargs": 0}))
    options.add_set(command)
    add_rows(command, *_OPTIONS)


def method_lines() -> Iterator[str]:
    """A line for each method that `evaluate` and `fit` take."""
    for method in methods.every().values():
        extra = f" (needs pip install 'palpate-train[{method.extra}]')" if method.extra else ""
        yield f"{method.name:<20} {method.about}{extra}"


def run_evaluate(args: argparse.Namespace) -> None:
    """Print each result as it is finished, and write all of them. A method that cannot be used is
    named and left out.

    Raises FormatError at the end if a method was left out.
    """
    if args.json:
        options.writable_file(args.json, "--json", ".json")
    names, effort = options.names(args), options.effort(args)
    sweeps = options.load(args)
    if args.each < 0:
        raise FormatError(
            f"--each {args.each} is out of range; use 1 or more, or leave it out for all"
        )
    seeds = options.seeds(args)
    # the box sees raw counts
    box = None if args.remove_means or args.label_alone else quantized_bundle.box_answers
    protocols, log = tuple(args.protocols), options.Log()
    plan = evaluate.Plan(names, protocols, seeds, args.remove_means, effort, args.each, box)
    results: list[dict[str, Any]] = []
    refused: dict[str, str] = {}
    trivially = _beside(sweeps, plan, log)
    for result in evaluate.evaluate(sweeps, plan, options.where(args), log):
        if result.refused:
            if result.method not in refused:
                log.keep(f"{result.method} cannot be used here: {result.refused}; left out")
            refused.setdefault(result.method, result.refused)
            continue
        about = {"only": args.only, "each": args.each, "baselines": trivially[result.protocol]}
        results.append(result.json() | about)
        say(evaluate.line(results[-1]))
        if warning := trivial.above(results[-1]):
            log.keep(f"palpate-train: {warning}")
        if args.json:
            results[-1] |= {"each_fold": result.each_fold()}
            test, method = args.protocols.index, names.index
            results.sort(key=lambda r: (test(r["protocol"]), method(r["method"]), r["seed"]))
            _write(args.json, results)
    if refused:
        raise FormatError(
            f"{', '.join(refused)} left out of {', '.join(names)}; the lines above say why"
        )


def _beside(sweeps: Dataset, plan: evaluate.Plan, log: options.Log) -> dict[str, Any]:
    """The figures of trivial baselines by protocol, with the first seed. Prints them under the
    header, after warnings about the protocols' folds."""
    known = sweeps.without_means() if plan.means_removed else sweeps
    folds = {text: plan.folds(sweeps, text, plan.seeds[0]) for text in plan.protocols}
    for text in plan.protocols:
        for line in set_warnings.of_protocol(sweeps, text, folds[text]):
            log.keep(f"palpate-train: {line}")
    found = {text: trivial.figures(known, folds[text]) for text in plan.protocols}
    say(*evaluate.HEADER.split("\n"))
    for text in plan.protocols:
        say(*trivial.lines(text, plan.means_removed, found[text]))
    return found


def _write(path: Path, results: Iterable[dict[str, Any]]) -> None:
    """Write a JSON list with a line for each result, whole or not at all."""
    put(
        path,
        ("[\n" + ",\n".join(json.dumps(result) for result in results) + "\n]\n").encode(),
        parents=True,
    )
