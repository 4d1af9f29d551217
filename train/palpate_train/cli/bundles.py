"""The commands that make and judge bundles: export, pack, score, parity, bridge, widen."""

from __future__ import annotations

import argparse
import json
import os
import shlex
from pathlib import Path

from palpate.bundle import bundle
from palpate.bundle.manifest import Manifest
from palpate.core import config, outputs
from palpate.core.clock import SystemClock
from palpate.core.errors import FormatError
from palpate.core.provenance import commit
from palpate.core.storage import put
from palpate.inference.classifier import Classifier
from palpate_train.arguments import numbers, options
from palpate_train.arguments.types import Add
from palpate_train.data import labels, repeats, sets
from palpate_train.export import (
    bridging,
    bundle_score,
    displacement_limit,
    early_checks,
    measure,
    nuisances,
    pack,
    quantized_bundle,
    sliding,
)
from palpate_train.models import methods
from palpate_train.models.recipe.fitted import Fit
from palpate_train.reports import formatting


def register(add: Add) -> None:
    """export, pack, score, parity, bridge, widen."""
    _add_bundles(add)
    score = add("score", run_score)
    score.add_argument("bundle", type=Path, metavar="BUNDLE", help="its folder")
    options.add_set(score)
    score.add_argument("--json", type=Path, metavar="FILE", help="write the figures there")
    bridge = add("bridge", run_bridge)
    bridge.add_argument("bundle", type=Path, metavar="BUNDLE", help="its folder")
    options.add_set(bridge)
    widen = add("widen", run_widen)
    widen.add_argument("bundle", type=Path, metavar="BUNDLE", help="its folder")
    widen.add_argument(
        "--trained-on", required=True, metavar="SET", help="its training sweeps, which are altered"
    )
    options.add_set(widen)
    parity = add("parity", run_parity)
    parity.add_argument(
        "model", type=Path, metavar="FIT|DIR", help="a fit, or a bundle, which holds no float model"
    )
    options.add_set(parity)
    parity.add_argument("--json", type=Path, metavar="FILE", help="write the figures there")


def _add_bundles(add: Add) -> None:
    """export and pack: the commands that write models."""
    export = add("export", run_export)
    export.add_argument("fit", type=Path, metavar="FIT", help="what palpate-train fit wrote")
    pack_command = add("pack", run_pack)
    options.add_set(pack_command)
    pack_command.add_argument(
        "--method", required=True, metavar="NAME", help="see palpate-train evaluate --list"
    )
    options.add_seed(pack_command)
    options.add_effort(pack_command)
    for command in (export, pack_command):
        command.add_argument(
            "--out",
            type=outputs.folder,
            required=True,
            metavar="DIR",
            help="the bundle; replaced if it is there",
        )
        command.add_argument("--name", required=True)
        command.add_argument("--version", required=True)
        command.add_argument(
            "--full-scale",
            type=numbers.above_zero("--full-scale"),
            help="the skin's highest raw count (default: the maximum of its type)",
        )
        command.add_argument(
            "--pitch-mm",
            type=numbers.above_zero("--pitch-mm"),
            help=(
                "distance between taxels; without it `palpate align` cannot show mm (known for the "
                "simulated skin)"
            ),
        )
        command.add_argument(
            "--licence",
            default="",
            metavar="NAME",
            help="of the recordings, for card.md: CC-BY-4.0",
        )


def run_export(args: argparse.Namespace) -> None:
    """Pack the bundle, print its figures and how to score it."""
    pack.check_target(args.out)
    made = Fit.load(args.fit)
    if args.licence:
        made.about[pack.LICENCE] = args.licence
    _print(quantized_bundle.export(made, *_packing(args)), args.out)
    rest = made.about.get("rest")
    what = "the sweeps that fit --split left out" if rest else "sweeps that the fit has not seen"
    command = shlex.join(["palpate-train", "score", str(args.out), "--set", rest or "SET"])
    print(f"to score it on {what}: {command}")
    print(options.report_line(args.out, rest or ""))


def run_pack(args: argparse.Namespace) -> None:
    """Train, pack the bundle and print its figures."""
    (method,) = methods.find([args.method], options.effort(args))
    pack.check_target(args.out)
    content = pack.trained(method, labels.check(options.load(args, args.seed)), args.seed)
    content.about[pack.LICENCE] = args.licence
    try:
        content = quantized_bundle.checked(content, content.reference)
    except pack.ExportRefused as e:
        raise pack.ExportRefused(
            f"{e}; or make the bundle with palpate-train fit and export, which keep the "
            "float form where int8 differs"
        ) from e
    _print(pack.pack(content, *_packing(args)), args.out)


def run_parity(args: argparse.Namespace) -> None:
    """Compare the graphs of a model."""
    if args.json:
        options.writable_file(args.json, "--json", ".json")
    print(quantized_bundle.compared(args.model, options.load(args), args.json))


def run_score(args: argparse.Namespace) -> None:
    """Run the set through the box's classifier; print the figures, and write them."""
    if args.json:
        options.writable_file(args.json, "--json", ".json")
    loaded, sweeps = bundle.load(args.bundle), options.load(args)
    found = bundle_score.score(Classifier(loaded, SystemClock()), sweeps)
    seen = _seen(loaded.manifest, sweeps)
    if args.json:
        put(args.json, (json.dumps(found.json() | {"trained_on": seen}, indent=1) + "\n").encode())
    print(found.text())
    if seen and seen["sweeps"]:
        print(
            f"warning: {seen['sweeps']} of {seen['of']} sweeps are the very ones that the bundle "
            "was fitted to; they say nothing of new ones: score sweeps that it has not seen"
        )
    elif not seen and loaded.manifest.made.get("set") == sweeps.source:
        print(
            f"the bundle was fitted to a set of this name, {sweeps.source}: sweeps that it "
            "has seen say nothing of new ones"
        )


def _seen(manifest: Manifest, sweeps: sets.Dataset) -> dict[str, int] | None:
    """The number of `sweeps` that the bundle was fitted to, of those that could be compared; None
    for a bundle of an older version, which keeps no digests."""
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


def run_bridge(args: argparse.Namespace) -> None:
    """Measure the broken taxels that the bundle tolerates, and write them into its manifest."""
    manifest = bridging.write(args.bundle, options.load(args))
    print(bridging.text(manifest))
    print(f"bundle: {manifest.name} {manifest.version}, {bundle.load(args.bundle).id}")


def run_widen(args: argparse.Namespace) -> None:
    """Measure how altered and unfinished sweeps differ from known ones, and write it into the
    bundle."""
    given = args.bundle, sets.load(args.trained_on), options.load(args)
    manifest = nuisances.write(*given)
    if manifest.early:
        manifest = early_checks.write(*given)
    train = given[1]
    manifest = bridging.rewritten(args.bundle, train, lambda held: pack.limited(held, train))
    _print_checks(manifest)
    print(f"bundle: {manifest.name} {manifest.version}, {bundle.load(args.bundle).id}")


def _print_checks(manifest: Manifest) -> None:
    """Print how the bundle tells altered, unfinished and displaced sweeps from unknown
    materials."""
    if manifest.known:
        print(nuisances.text(manifest.figures))
    for part in (early_checks, displacement_limit, sliding):
        if text := part.text(manifest):
            print(text)


def _packing(args: argparse.Namespace) -> tuple[Path, str, str, str, float | None, float | None]:
    return args.out, args.name, args.version, commit(), args.full_scale, args.pitch_mm


def _print(manifest: Manifest, out: Path) -> None:
    """Print the figures of a bundle and its size; also why it is not in int8 or cannot detect
    contact, if so."""
    if why := manifest.made.get("float_because"):
        print(f"the model is in float, which takes more time than int8: {why}")
    if why := manifest.made.get("contact_unknown_because"):
        print(f"no-contact cannot be detected: {why}")
    for line in formatting.figure_lines(manifest.figures):
        print(line)
    print(bridging.text(manifest))
    _print_checks(manifest)
    if few := [
        f"{board} wires {bits}"
        for board, bits in _class_bits().items()
        if 1 << bits <= len(manifest.labels)
    ]:
        needed = len(manifest.labels).bit_length()
        print(
            f"answers on GPIO lines: {len(manifest.labels)} labels need {needed} of "
            f"output.class_bits; {', '.join(few)}"
        )
    size = measure.sizes(out)[1]
    print(f"bundle: {manifest.name} {manifest.version}, {size} bytes in {out}")


def _class_bits() -> dict[str, int]:
    """The number of GPIO lines for the class code in each delivered board file."""
    return {
        name: len(config.load(name, site=Path(os.devnull)).output.class_bits)
        for name in config.boards()
    }
