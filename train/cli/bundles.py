"""The commands that make bundles: fit, export, pack, parity, sign, references."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from appliance.bundle import bundle
from appliance.bundle.manifest import Manifest
from appliance.core.errors import FormatError
from appliance.core.provenance import commit
from train.calibration.posthoc import calibrate
from train.cli import options
from train.cli.options import Add
from train.export import measure, pack, quantized_bundle, sign
from train.models import methods
from train.models.compact import recipe
from train.models.compact.architectures import ARCHITECTURES
from train.models.compact.augment import default_augmentation
from train.models.compact.fitted import Fit

STEPS = recipe.Settings().steps


def register(add: Add) -> None:
    """fit, export, pack, parity, sign, references."""
    _add_fit(add)
    _add_bundles(add)
    parity = add(
        "parity",
        lambda args: print(quantized_bundle.compared(args.model, options.load(args), args.json)),
        "show what int8 changes in a model's answers, and in each tensor",
    )
    parity.add_argument("model", type=Path, metavar="FIT|DIR", help="a fit, or a bundle, which has no float form")
    options.add_set(parity)
    parity.add_argument("--json", type=Path, metavar="FILE", help="write the figures there")
    sign_command = add("sign", run_sign, "sign a bundle, so that boxes take it")
    sign_command.add_argument("bundle", type=Path, metavar="BUNDLE", help="its folder")
    sign_command.add_argument(
        "--key", type=Path, required=True, metavar="KEY", help="your private key: ssh-keygen -t ed25519 makes one"
    )
    sign_command.add_argument(
        "--counter", type=int, metavar="N", help="above that of every bundle delivered before (1 for the first)"
    )


def _add_fit(add: Add) -> None:
    command = add("fit", run_fit, "choose a model and fit it to sweep sets")
    options.add_set(command)
    command.add_argument(
        "--seed", type=int, required=True, help="of the training, and of simulated sets that name none"
    )
    command.add_argument("--out", type=Path, required=True, metavar="FIT", help="where the fit goes (.npz)")
    command.add_argument("--split", metavar="GROUP:SHARE", help="train on this share of a group, e.g. recording:0.7")
    command.add_argument("--rest", type=Path, metavar="FILE", help="write what --split left out as a sweep set")
    command.add_argument(
        "--steps", type=int, default=STEPS, help=f"of training of stages (default {STEPS}; 0 for none)"
    )
    command.add_argument("--row-shift", type=float, metavar="SHARE", dest="moved",
                     help="share of training sweeps whose skin is moved by up to a row (default 0.5)")  # fmt: skip
    command.add_argument("--stretch", type=float, metavar="SHARE",
                     help="change the speed of training sweeps by up to this share (default 0)")  # fmt: skip
    command.add_argument(
        "--size",
        choices=[*ARCHITECTURES, "chosen"],
        default="chosen",
        help="train a network of this size (default: filters, spectrum and stages as held-out groups ask for)",
    )
    command.add_argument(
        "--keep-means", action="store_true", help="give the head each taxel's mean too, for comparison"
    )


def _add_bundles(add: Add) -> None:
    """export, pack and references: the commands that write models."""
    export = add("export", run_export, "quantize a fit and pack its bundle")
    export.add_argument("fit", type=Path, metavar="FIT", help="what palpate-train fit wrote")
    pack_command = add("pack", run_pack, "train any method and pack its bundle")
    options.add_set(pack_command)
    pack_command.add_argument("--method", required=True, metavar="NAME", help="see palpate-train methods")
    pack_command.add_argument(
        "--seed", type=int, required=True, help="of the training, and of simulated sets that name none"
    )
    options.add_effort(pack_command)
    for command in (export, pack_command):
        command.add_argument(
            "--out", type=Path, required=True, metavar="DIR", help="the bundle; replaced if it is there"
        )
        command.add_argument("--name", required=True)
        command.add_argument("--version", required=True)
        command.add_argument(
            "--full-scale", type=float, help="the sensor's highest raw count (default: the maximum of its type)"
        )
        command.add_argument(
            "--pitch-mm",
            type=float,
            help="from taxel to taxel; without it `palpate align` cannot show mm (known for the simulated skin)",
        )
    references = add("references", run_references, "write the models that palpate bench times beside the bundle")
    references.add_argument("--out", type=Path, required=True, metavar="DIR")


def run_fit(args: argparse.Namespace) -> None:
    """Train, save the fit and print its accuracy on the held-out sweeps."""
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
    changes = {name: share for name in ("moved", "stretch") if (share := getattr(args, name)) is not None}
    architecture = ARCHITECTURES.get(args.size, recipe.FIXED)
    augmentation = replace(default_augmentation(architecture.zero_sum(sweeps.format.window)), **changes)
    if args.size in ARCHITECTURES:
        from train.models.compact import fit  # here: the default recipe needs no PyTorch

        trained = fit.FitRecipe(steps=args.steps, augmentation=augmentation, keep_means=args.keep_means)
        made = fit.fit(sweeps, args.seed, trained, options.Log(), architecture)
    elif args.keep_means:
        raise FormatError(
            f"--keep-means needs --size, one of {', '.join(ARCHITECTURES)}; the default recipe removes means"
        )
    else:
        made = recipe.fit(sweeps, args.seed, recipe.Settings(args.steps, augmentation), options.Log())
        print(f"chosen: {made.about['chosen']}; {_text(made.about['validation'])} of held-out parts")
    made.save(args.out)
    print(f"fit: {len(made.train)} sweeps, {made.train.format}; {args.out}")
    by = f"held-out {made.about['held_out_by']}"
    try:
        _print_figures(pack.held_out_figures(calibrate(made).held, made, by))
    except FormatError as e:  # too few sweeps to judge by
        print(f"{by}, network alone: {_text(made.about['validation'])}; nothing judges the box's answers: {e}")


def run_export(args: argparse.Namespace) -> None:
    """Pack the bundle and print its figures."""
    _print(quantized_bundle.export(Fit.load(args.fit), *_packing(args)), args.out)


def run_pack(args: argparse.Namespace) -> None:
    """Train, pack the bundle and print its figures."""
    (method,) = methods.find([args.method], options.effort(args))
    content = pack.trained(method, options.load(args, args.seed), args.seed)
    _print(pack.pack(quantized_bundle.checked(content, content.reference), *_packing(args)), args.out)


def run_sign(args: argparse.Namespace) -> None:
    """Sign the bundle, and print what was signed."""
    signed = sign.sign(args.bundle, args.key, args.counter)
    print(
        f"signed: {signed.name} {signed.version}, counter {signed.counter}, {bundle.identity(signed.json())} in {args.bundle}"
    )


def _packing(args: argparse.Namespace) -> tuple[Path, str, str, str, float | None, float | None]:
    return args.out, args.name, args.version, commit(), args.full_scale, args.pitch_mm


def _print(manifest: Manifest, out: Path) -> None:
    """The figures of a bundle, and its size; why it is not in int8, where it might be."""
    if why := manifest.made.get("float_because"):
        print(f"in float, not int8, which takes more time: {why}")
    _print_figures(manifest.figures)
    size = measure.sizes(out)[1]
    print(f"bundle: {manifest.name} {manifest.version}, {size} bytes in {out}")


def _print_figures(figures: Mapping[str, dict[str, Any]]) -> None:
    """Each accuracy on a line: as the box answers, with what it does not name, and of the network alone."""
    for protocol, figure in figures.items():
        if "wrong" in figure:
            others = ", ".join(f"{figure[name]} {name}" for name in ("wrong", "unsure", "unknown", "refused"))
            print(f"{protocol}, as the box answers: {_text(figure)}; {others}")
        elif "accuracy" in figure:
            print(f"{protocol}: {_text(figure)}")


def run_references(args: argparse.Namespace) -> None:
    """Write the references and print their paths."""
    for path in quantized_bundle.references(args.out):
        print(path)


def _by_share(text: str) -> tuple[str, float]:
    by, _, share = text.partition(":")
    try:
        return by, float(share)
    except ValueError:
        raise FormatError(f"split {text!r} cannot be read; write GROUP:SHARE, e.g. recording:0.7") from None


def _text(figure: dict[str, float]) -> str:
    return f"{figure['accuracy']:.3f} [{figure['low']:.3f}, {figure['high']:.3f}] of {figure['n']}"
