"""The command `palpate enrol`."""

from __future__ import annotations

import argparse
from contextlib import ExitStack
from dataclasses import replace
from typing import Any

from numpy.typing import NDArray

from appliance.bundle.bundle import Bundle
from appliance.cli.common import StopFlag, load_settings
from appliance.cli.devices import open_devices
from appliance.core.config import Config
from appliance.core.errors import BundleError, ConfigError
from appliance.core.log import log
from appliance.deployment.enrolment_key import EnrolmentKey
from appliance.inference import enrolment
from appliance.inference.enrolment import SweepCollector
from appliance.runtime import assembly


def run(args: argparse.Namespace) -> int:
    """Learn one more label from sweeps of it, and install the new bundle or write it to a
    folder."""
    settings = load_settings(args)
    start = assembly.running(settings, answers=not args.sim)
    key = _enrolment_key(args, settings)
    enrolment.admit(start.bundle, args.label)
    if args.out:
        enrolment.check_target(args.out, args.replace)
    new = enrolment.enrol(start.bundle, args.label, _good_sweeps(args, settings, start.bundle))
    if new.disagreement and not args.scattered:
        raise BundleError(
            f"{new.disagreement}, or give --scattered if all are of {args.label!r}; nothing was"
            " written"
        )
    for warning in filter(None, (new.disagreement, *new.warnings)):
        log.warning(f"warning: {warning}")
    files = enrolment.files(start.files, new, key.sign(new.file) if key else None)
    if args.out:
        enrolment.write(files, args.out, args.replace)
    else:
        assembly.store(settings).learn(files)
    m = new.bundle.manifest
    use = f"palpate bundles install {args.out}" if key else "classifier.bundle; it is not signed"
    how = (
        f"use it with {use}"
        if args.out
        else "it runs on trial from the next start on: systemctl restart palpate"
    )
    log.info(
        f"{args.out or 'installed'}: {m.name} {m.version}, {new.bundle.id}, {len(m.labels)}"
        f" labels; {how}"
    )
    return 0


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
    if not args.out and settings.classifier.early:
        raise ConfigError("early answers cannot name enrolled labels; set classifier.early = false")
    key = EnrolmentKey(settings.store.enrolment_key)
    key.check()
    return key


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
