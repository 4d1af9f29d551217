"""The commands that make and judge bundles: export and score."""

from __future__ import annotations

import argparse
import json
import os
import shlex
from pathlib import Path

from palpate.bundle import bundle
from palpate.bundle.manifest import Manifest
from palpate.core import config, settings_files
from palpate.core.clock import SystemClock
from palpate.core.errors import FormatError
from palpate.core.outputs import Row, add_rows
from palpate.core.provenance import commit
from palpate.core.storage import put
from palpate.core.sweep_set import read
from palpate.core.text import say
from palpate.inference.classifier import Classifier
from palpate_train.answer import (
    altered_sweeps,
    fit_contact,
    fit_early,
    fit_slide,
    fit_taxels,
    rules,
    stranger_limits,
)
from palpate_train.arguments import numbers, options
from palpate_train.arguments.options import above_zero, path, text
from palpate_train.arguments.program import Add
from palpate_train.data import repeats, sets
from palpate_train.export import card, measure, pack, quantized_bundle
from palpate_train.metrics import bundle_score
from palpate_train.models.method_fit import MethodFit
from palpate_train.models.recipe.fitted import WHAT, Fit
from palpate_train.reports import formatting


def _rules(option: str, into: str, what: str) -> Row:
    names = {"nargs": "+", "action": "extend", "choices": tuple(rules.RULES)}
    return option, f"{what}: {', '.join(rules.RULES)}", text("NAME", [], dest=into, **names)


# fmt: off
_EXPORT: tuple[Row, ...] = (
    ("fit", "what palpate-train fit wrote", path("FIT")),
    options.folder("the bundle; replaced if it is there"),
    ("--name", None, {"required": True}),
    ("--version", None, {"required": True}),
    ("--full-scale", "the skin's highest raw count (default: the maximum of its type)",
        {"type": numbers.above_zero("--full-scale")}),
    ("--pitch-mm", "distance between taxels; without it `palpate skin align` cannot show mm (known"
        " for the simulated skin)", {"type": numbers.above_zero("--pitch-mm")}),
    _rules("--with", "kept", "keep these rules even if they do not pay"),
    _rules("--without", "left_out", "leave these rules out"),
    ("--licence", "of the recordings, for card.md: CC-BY-4.0", text("NAME", "")),
    above_zero("--stranger-cost", "N", "cost of an unknown material that gets a"
        " label, as a multiple of the cost of a known one without a label (1)"),
)
# fmt: on


def register(add: Add) -> None:
    """export and score."""
    add_rows(add("export", run_export), *_EXPORT)
    score = add("score", run_score)
    add_rows(score, ("bundle", "its folder", path("BUNDLE")))
    options.add_set(score)
    less = _rules("--without", "left_out", "score the bundle without these rules, too")
    add_rows(score, less, options.JSON)


def run_export(args: argparse.Namespace) -> None:
    """Pack the bundle, print its figures and how to score it."""
    asked = rules.Asked(tuple(args.kept), tuple(args.left_out))
    pack.check_target(args.out)
    arrays = read(args.fit, WHAT)
    kind: type[Fit] | type[MethodFit] = MethodFit if "model" in arrays else Fit
    made = kind.read(args.fit.name, arrays)
    made.about[pack.LICENCE] = args.licence
    if isinstance(made, Fit):
        made.about[stranger_limits.COST] = args.stranger_cost or 1.0
    elif args.stranger_cost:
        raise FormatError(
            f"--stranger-cost {args.stranger_cost:g}: {args.fit} is of another method, which gives "
            "each unknown material a label; leave it out, or fit without --method"
        )
    manifest = quantized_bundle.export(
        made,
        args.out,
        args.name,
        args.version,
        commit(),
        full_scale=args.full_scale,
        pitch_mm=args.pitch_mm,
        asked=asked,
    )
    _print(manifest, args.out)
    rest = made.about.get("rest")
    what = "the sweeps that fit --split left out" if rest else "sweeps that the fit has not seen"
    command = shlex.join(["palpate-train", "score", str(args.out), "--set", rest or "SET"])
    say(f"to score it on {what}: {command}")
    say(options.report_line(args.out, rest or ""))


def run_score(args: argparse.Namespace) -> None:
    """Run the set through the box's classifier; print the figures, and write them."""
    if args.json:
        options.writable_file(args.json, "--json", ".json")
    loaded, sweeps = bundle.load(args.bundle), options.load(args, learned=False)
    less = rules.without(loaded, args.left_out)
    found = bundle_score.score(Classifier(loaded, SystemClock()), sweeps)
    seen = _seen(loaded.manifest, sweeps)
    if args.json:
        put(args.json, (json.dumps(found.json() | {"trained_on": seen}, indent=1) + "\n").encode())
    say(*found.text().split("\n"))
    if args.left_out:
        without = bundle_score.score(Classifier(less, SystemClock()), sweeps)
        say(f"without {', '.join(args.left_out)}: {without.short()}; with: {found.short()}")
    if seen and seen["sweeps"]:
        say(
            f"warning: {seen['sweeps']} of {seen['of']} sweeps are the very ones that the bundle "
            "was fitted to; they say nothing of new ones: score sweeps that it has not seen"
        )
    elif not seen and loaded.manifest.made.get("set") == sweeps.source:
        say(
            f"the bundle was fitted to a set of this name, {sweeps.source}: sweeps that it "
            "has seen say nothing of new ones"
        )


def _seen(manifest: Manifest, sweeps: sets.Dataset) -> dict[str, int] | None:
    """The number of `sweeps` that the bundle was fitted to, of all that could be compared; None
    for a bundle without digests."""
    kept = manifest.made.get("sweeps")
    if not isinstance(kept, str):
        return None
    try:
        found, of = repeats.seen(sweeps, kept)
    except ValueError as e:
        raise FormatError(
            f"the digests of training sweeps in the manifest of {manifest.name} cannot be read "
            f"({e}); export it again"
        ) from e
    return {"sweeps": found, "of": of}


def _print(manifest: Manifest, out: Path) -> None:
    """Print the figures of a bundle and its size; also why it is not in int8 or cannot detect
    contact, if so."""
    if why := manifest.made.get("float_because"):
        say(f"the model is in float, which takes more time than int8: {why}")
    if why := manifest.made.get("contact_unknown_because"):
        say(f"no-contact cannot be detected: {why}")
    for line in formatting.figure_lines(manifest.figures):
        say(line)
    say(*fit_taxels.text(manifest).split("\n"))
    say(*stranger_limits.lines(manifest.figures))
    if manifest.known:
        say(*altered_sweeps.text(manifest.figures).split("\n"))
    else:
        say(card.UNLIMITED)
    for part in (quantized_bundle, fit_early, fit_contact, fit_slide, rules):
        if text := part.text(manifest):
            say(*text.split("\n"))
    if few := [
        f"{board} wires {bits}"
        for board, bits in _class_bits().items()
        if 1 << bits <= len(manifest.labels)
    ]:
        needed = len(manifest.labels).bit_length()
        say(
            f"answers on GPIO lines: {len(manifest.labels)} labels need {needed} of "
            f"output.class_bits; {', '.join(few)}"
        )
    size = measure.sizes(out)[1]
    say(f"bundle: {manifest.name} {manifest.version}, {size} bytes in {out}")


def _class_bits() -> dict[str, int]:
    """The number of GPIO lines for the class code in each delivered board file."""
    return {
        name: len(config.load(name, site=Path(os.devnull)).output.class_bits)
        for name in settings_files.boards()
    }
