"""The command `palpate enrol`."""

from __future__ import annotations

import argparse
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.bundle.bundle import Bundle
from palpate.cli.common import StopFlag, load_settings
from palpate.cli.devices import open_devices
from palpate.cli.parser import MOST_SWEEPS
from palpate.core.config import Config
from palpate.core.errors import ApplianceError, BundleError, ConfigError, FormatError
from palpate.core.log import log
from palpate.core.types import load
from palpate.deployment.enrolment_key import EnrolmentKey
from palpate.deployment.signed import SignedBundle
from palpate.inference import enrolment
from palpate.inference.enrolment import Enrolment, SweepCollector
from palpate.learn import materials
from palpate.runtime import assembly
from palpate.sweeps import unknown_sweeps

FEWEST = 2
"""Fewest kept sweeps of an unknown material: one does not come again."""


def run(args: argparse.Namespace) -> int:
    """Learn one more label from sweeps of it, and install the new bundle or write it to a
    folder."""
    settings = load_settings(args)
    if args.label is not None and not args.out:
        _check_store(settings)
    start = assembly.running(settings, answers=not args.sim)
    kept = settings.kept("black-box")
    if args.label is None:
        found = unknown_sweeps.groups(kept, start.bundle.id)
        print("\n".join(map(str, found)) or "no unknown material was seen twice")
        return 0
    key = _enrolment_key(args, settings)
    enrolment.admit(start.bundle, args.label)
    if args.out:
        enrolment.check_target(args.out, args.replace)
    if args.unknown is None:
        sweeps = _good_sweeps(args, settings, start.bundle)
    else:
        sweeps = _unknown_sweeps(args.unknown, kept, start.bundle)
    new = _taught(args, start, sweeps)
    files = enrolment.files(start.files, new, key.sign(new.file) if key else None)
    if args.out:
        enrolment.write(files, args.out, args.replace)
    else:
        assembly.store(settings).learn(files)
    _report(args, new, signed=key is not None)
    return 0


def _report(args: argparse.Namespace, new: Enrolment, *, signed: bool) -> None:
    """Log where the new bundle is, and how to use it."""
    m = new.bundle.manifest
    use = f"palpate bundles install {args.out}" if signed else "classifier.bundle; it is not signed"
    how = (
        f"use it with {use}"
        if args.out
        else "it runs on trial from the next start on: systemctl restart palpate"
    )
    log.info(
        f"{args.out or 'installed'}: {m.name} {m.version}, {new.bundle.id}, {len(m.labels)}"
        f" labels; {how}"
    )


def _check_store(settings: Config) -> None:
    """Raises ConfigError if the bundle of the store does not run."""
    if name := settings.bundle_setting:
        raise ConfigError(
            f"{name} names the bundle that runs, so a new one in the store would not; remove this "
            "setting, or give --out DIR"
        )


def _taught(args: argparse.Namespace, start: SignedBundle, sweeps: NDArray[Any]) -> Enrolment:
    """The enrolment of these sweeps, with its warnings and its accuracy in the log. Raises
    BundleError if they disagree."""
    new = materials.taught(start, {args.label: sweeps})
    if new.disagreement and not args.scattered:
        raise BundleError(
            f"{new.disagreement}, or give --scattered if all are of {args.label!r}; nothing was"
            " written"
        )
    for warning in filter(None, (new.disagreement, *new.warnings)):
        log.warning(f"warning: {warning}")
    if len(sweeps) > 1:
        files = [*map(str, range(len(sweeps)))]
        alone = materials.NewSweeps({args.label: sweeps}, {args.label: files})
        log.info(materials.assessed(start, alone).text())
    return new


def _enrolment_key(args: argparse.Namespace, settings: Config) -> EnrolmentKey | None:
    """The key of this box that signs the enrolment, checked before the robot sweeps.

    None if the enrolment stays unsigned: sweeps of a simulated skin, and a bench that allows
    unsigned bundles. Raises ConfigError if the box would refuse the new bundle.
    """
    unsigned = (
        "--sim"
        if args.sim
        else "classifier.allow_unsigned"
        if settings.classifier.allow_unsigned
        else ""
    )
    if unsigned:
        if not args.out:
            raise ConfigError(
                f"with {unsigned} the enrolment is not signed, and a box refuses it; give --out DIR"
            )
        return None
    if not args.out:
        materials.check_settings(settings)
    key = EnrolmentKey(settings.store.enrolment_key)
    key.check()
    return key


def _unknown_sweeps(number: int, folder: Path, current: Bundle) -> NDArray[Any]:
    """The windows of kept sweeps of one unknown material, the last MOST_SWEEPS. Raises
    ApplianceError if fewer than two can be used."""
    group = unknown_sweeps.chosen(unknown_sweeps.groups(folder, current.id), number, folder)
    log.info(f"taken: {group}")
    check, windows = enrolment.slide_check(current), []
    for kept, path in group.paths.items():
        try:
            sweep, format = load(path)
        except FormatError as e:
            log.warning(f"sweep {kept} not taken: {e}")
            continue
        taxels, wanted = sweep.frames.taxels, (current.format.window, *current.format.shape)
        why = "" if taxels.shape == wanted and format == current.format else "of another format"
        if why := why or check(taxels):
            log.warning(f"sweep {kept} not taken: {why}")
        else:
            windows.append(taxels)
    if len(windows) < FEWEST:
        raise ApplianceError(
            f"{len(windows)} of these sweeps can be used, and {FEWEST} are needed; make others"
        )
    return np.stack(windows[-MOST_SWEEPS:])


def _good_sweeps(args: argparse.Namespace, settings: Config, current: Bundle) -> NDArray[Any]:
    """The windows of `--sweeps` good sweeps. Raises ApplianceError if there are too few."""
    settings = replace(settings, classifier=replace(settings.classifier, early=False))
    devices = open_devices(args, lambda: current.format)
    stopped = StopFlag()
    taken = SweepCollector(args.good, enrolment.slide_check(current))
    with ExitStack() as stack:
        port = assembly.port(settings, devices)
        box = assembly.box(
            settings, current, devices, port, stack, observers=[taken], labels=(args.label,)
        )
        box.run(lambda: taken.enough or stopped() or devices.finished(box.answered))
    return taken.windows()
