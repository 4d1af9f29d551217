"""The commands that make and judge bundles: fit, export, pack, score, parity, bridge, widen."""

from __future__ import annotations

import argparse
import json
import os
import shlex
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from appliance.bundle import bundle
from appliance.bundle.manifest import Manifest
from appliance.core import config
from appliance.core.clock import SystemClock
from appliance.core.errors import FormatError
from appliance.core.provenance import commit
from appliance.core.storage import put
from appliance.inference.classifier import Classifier
from train.arguments import numbers, options
from train.arguments.types import Add
from train.data import labels, sets
from train.data.sets import Dataset, digest
from train.evaluation.evaluate import CACHE
from train.evaluation.fold import fingerprint
from train.export import (
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
from train.models import methods
from train.models.recipe import recipe
from train.models.recipe.architectures import MAINS_HZ
from train.models.recipe.augment import Augmentation, default_augmentation
from train.models.recipe.fitted import Fit
from train.models.recipe.sizes import SIZES, UNLIMITED

MAINS = (50, 60)
"""Frequencies of the mains in Hz: public grids have no others."""
STEPS = recipe.Settings().steps


def register(add: Add) -> None:
    """fit, export, pack, score, parity, bridge, widen."""
    _add_fit(add)
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
    parity = add(
        "parity",
        lambda args: print(quantized_bundle.compared(args.model, options.load(args), args.json)),
    )
    parity.add_argument(
        "model", type=Path, metavar="FIT|DIR", help="a fit, or a bundle, which holds no float model"
    )
    options.add_set(parity)
    parity.add_argument("--json", type=Path, metavar="FILE", help="write the figures there")


def _add_fit(add: Add) -> None:
    command = add("fit", run_fit)
    command.set_defaults(resumes=True)
    options.add_set(command)
    command.add_argument(
        "--seed",
        type=numbers.whole("--seed", 0),
        required=True,
        help="seed of the training, and of simulated sets without one",
    )
    command.add_argument(
        "--out", type=Path, required=True, metavar="FIT", help="where the fit goes (.npz)"
    )
    command.add_argument(
        "--split", metavar="GROUP:SHARE", help="train on this share of a group, e.g. recording:0.7"
    )
    command.add_argument(
        "--rest", type=Path, metavar="FILE", help="write what --split left out as a sweep set"
    )
    _add_augmentation(command)
    _add_model(command)


def _add_model(command: argparse.ArgumentParser) -> None:
    """Options for the kind of model and its training."""
    command.add_argument(
        "--steps",
        type=numbers.whole("--steps", 0),
        default=STEPS,
        help=f"training steps of the stages (default {STEPS}; 0 for none)",
    )
    command.add_argument(
        "--mains",
        type=int,
        choices=MAINS,
        default=int(MAINS_HZ),
        metavar="HZ",
        help=(
            f"frequency of the mains where the skin is used, {MAINS[0]} or {MAINS[1]}; the "
            f"features ignore its hum (default {MAINS_HZ:g})"
        ),
    )
    command.add_argument(
        "--size",
        choices=SIZES,
        help="; ".join(f"{name}: at most {size.about}" for name, size in SIZES.items())
        + " (default: no limit)",
    )


def _add_augmentation(command: argparse.ArgumentParser) -> None:
    """Options for augmented copies of the training sweeps."""
    command.add_argument(
        "--row-shift",
        type=numbers.number("--row-shift", lambda x: 0 <= x <= 1, "from 0 to 1"),
        metavar="SHARE",
        dest="displaced",
        help="share of training sweeps with a displacement of up to a row (default 0.5)",
    )
    command.add_argument(
        "--stretch",
        type=numbers.number("--stretch", lambda x: 0 <= x < 1, "from 0 to less than 1"),
        metavar="SHARE",
        help="change the speed of training sweeps by up to this share (default 0)",
    )
    command.add_argument(
        "--reattached",
        action="store_true",
        help=(
            "the skin will be taken off and put back after the recordings: train all heads on "
            "augmented copies of that, too"
        ),
    )


def _add_bundles(add: Add) -> None:
    """export and pack: the commands that write models."""
    export = add("export", run_export)
    export.add_argument("fit", type=Path, metavar="FIT", help="what palpate-train fit wrote")
    pack_command = add("pack", run_pack)
    options.add_set(pack_command)
    pack_command.add_argument(
        "--method", required=True, metavar="NAME", help="see palpate-train evaluate --list"
    )
    pack_command.add_argument(
        "--seed",
        type=numbers.whole("--seed", 0),
        required=True,
        help="seed of the training, and of simulated sets without one",
    )
    options.add_effort(pack_command)
    for command in (export, pack_command):
        command.add_argument(
            "--out",
            type=Path,
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


def run_fit(args: argparse.Namespace) -> None:
    """Train, save the fit and print its accuracy on the held-out sweeps."""
    if args.rest and not args.split:
        raise FormatError("--rest needs --split; without it nothing is left over")
    for option in ("out", "rest"):
        if path := getattr(args, option):
            options.writable_file(path, f"--{option}")
    sweeps, rest = labels.check(options.load(args, args.seed)), None
    if args.split:
        by, share = _by_share(args.split)
        sweeps, rest = sweeps.split(by, share, args.seed)
    if args.rest and rest:
        rest.save(args.rest)
    made, unfinished = _fitted(args, sweeps)
    made = replace(made, about=made.about | ({"rest": str(args.rest)} if args.rest else {}))
    made.save(args.out)
    unfinished.unlink(missing_ok=True)
    print(f"fit: {len(made.train)} sweeps, {made.train.format}; {args.out}")
    _print_held_out(made)
    if args.rest and rest:
        command = f"palpate-train score BUNDLE --set {shlex.quote(str(args.rest))}"
        print(
            f"rest: {len(rest)} sweeps in {args.rest}, which no part of the fit has seen; "
            f"after export: {command}"
        )
    print(options.report_line(args.out, str(args.rest or "")))


def _fitted(args: argparse.Namespace, sweeps: Dataset) -> tuple[Fit, Path]:
    """The fit for these options, and the file that keeps its training until the fit is written."""
    changes = {
        name: share
        for name in ("displaced", "stretch")
        if (share := getattr(args, name)) is not None
    }
    zero_sum = recipe.FIXED.zero_sum(sweeps.format.window)
    augmentation = replace(default_augmentation(zero_sum), **changes)
    unfinished = _unfinished(args, sweeps, augmentation)
    settings = recipe.Settings(
        args.steps,
        augmentation,
        unfinished=unfinished,
        size=SIZES.get(args.size, UNLIMITED),
        reattached=args.reattached,
        mains_hz=float(args.mains),
    )
    made = recipe.fit(sweeps, args.seed, settings, options.Log())
    print(f"chosen: {made.about['chosen']}; {_text(made.about['validation'])} of held-out parts")
    return made, unfinished


def _unfinished(args: argparse.Namespace, sweeps: Dataset, augmentation: Augmentation) -> Path:
    """The file that keeps a training until the fit is written. Its name is a fingerprint of all
    that the training depends on."""
    about = [digest(sweeps), args.seed, args.size, args.steps, asdict(augmentation), args.mains]
    return (
        CACHE
        / f"{fingerprint(about, 'train.models.recipe.recipe', 'train.models.recipe.stages')}.pt"
    )


def _print_held_out(made: Fit) -> None:
    """Print the accuracy on the sweeps that judged the fit, and how they differ from those of
    --rest."""
    if made.about["held_out_by"] == "nothing":
        print(
            "nothing was held out that could judge the model, so export will refuse it: "
            f"{made.uncalibrated}"
        )
        return
    by = f"held-out {made.about['held_out_by']}"
    print(
        f"{by}: sweeps of this set, by heads that did not see them; slightly too high, since "
        "they also helped to choose the model"
    )
    if made.calibration:
        _print_figures(made.held_out_figures(by))
    else:  # too few sweeps to judge by
        print(
            f"{by}, network alone: {_text(made.about['validation'])}; nothing judges the box's "
            f"answers: {made.uncalibrated}"
        )


def run_export(args: argparse.Namespace) -> None:
    """Pack the bundle, print its figures and how to score it."""
    pack.check_target(args.out)
    made = Fit.load(args.fit)
    _print(quantized_bundle.export(made, *_packing(args)), args.out)
    rest = made.about.get("rest")
    what = "the sweeps that fit --split left out" if rest else "sweeps that the fit has not seen"
    command = shlex.join(["palpate-train", "score", str(args.out), "--set", rest or "SET"])
    print(f"to score it on {what}: {command}")
    print(options.report_line(args.out, rest or ""))


def run_pack(args: argparse.Namespace) -> None:
    """Train, pack the bundle and print its figures."""
    pack.check_target(args.out)
    (method,) = methods.find([args.method], options.effort(args))
    content = pack.trained(method, labels.check(options.load(args, args.seed)), args.seed)
    try:
        content = quantized_bundle.checked(content, content.reference)
    except pack.ExportRefused as e:
        raise pack.ExportRefused(
            f"{e}; or make the bundle with palpate-train fit and export, which keep the "
            "float form where int8 differs"
        ) from e
    _print(pack.pack(content, *_packing(args)), args.out)


def run_score(args: argparse.Namespace) -> None:
    """Run the set through the box's classifier; print the figures, and write them."""
    if args.json:
        options.writable_file(args.json, "--json")
    loaded, sweeps = bundle.load(args.bundle), options.load(args)
    found = bundle_score.score(Classifier(loaded, SystemClock()), sweeps)
    if args.json:
        put(args.json, (json.dumps(found.json(), indent=1) + "\n").encode())
    print(found.text())
    if loaded.manifest.made.get("set") == sweeps.source:
        print(
            f"the bundle was fitted to a set of this name, {sweeps.source}: sweeps that it "
            "has seen say nothing of new ones"
        )


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
    displacement_limit.write(args.bundle, given[1])
    manifest = sliding.write(args.bundle, given[1])
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
    _print_figures(manifest.figures)
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


def _print_figures(figures: Mapping[str, dict[str, Any]]) -> None:
    """Print each accuracy on a line: the answers of the box with all other outcomes, and the
    network alone."""
    for protocol, figure in figures.items():
        if "wrong" in figure:
            others = ", ".join(
                f"{figure[name]} {name}" for name in ("wrong", "unsure", "unknown", "refused")
            )
            print(f"{protocol}, as the box answers: {_text(figure)}; {others}")
        elif "accuracy" in figure:
            print(f"{protocol}: {_text(figure)}")


def _by_share(text: str) -> tuple[str, float]:
    by, _, share = text.partition(":")
    try:
        return by, float(share)
    except ValueError:
        raise FormatError(
            f"split {text!r} cannot be read; write GROUP:SHARE, e.g. recording:0.7"
        ) from None


def _text(figure: dict[str, float]) -> str:
    share, low, high = (100 * figure[name] for name in ("accuracy", "low", "high"))
    return f"{share:.1f} % [{low:.1f}, {high:.1f}] of {figure['n']}"
