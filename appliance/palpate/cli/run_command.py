"""The command `palpate run`."""

from __future__ import annotations

import argparse
import sys
from contextlib import ExitStack, nullcontext
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from palpate.bundle.bundle import DEFAULT, Bundle
from palpate.bundle.manifest import Manifest
from palpate.cli.common import load_bundle, load_settings
from palpate.cli.devices import open_devices
from palpate.core.clock import SystemClock
from palpate.core.config import Config
from palpate.core.devices import Devices
from palpate.core.disk_thread import DiskThread
from palpate.core.errors import ApplianceError
from palpate.core.interrupts import StopFlag
from palpate.core.log import in_journal, log
from palpate.core.observer import Facts, Observer
from palpate.deployment import release_trial, releases
from palpate.inference.classifier import Classifier
from palpate.io import skins
from palpate.io.usb_sensor import fits
from palpate.runtime import assembly
from palpate.service import last_failure
from palpate.service.systemd import Notifier, VerdictLog

if TYPE_CHECKING:
    from palpate.deployment.release_trial import ReleaseTrial
    from palpate.deployment.shadow import Shadow
    from palpate.deployment.store import Choice
    from palpate.sweeps.black_box import BlackBox


def run(args: argparse.Namespace) -> int:
    """Classify sweeps until SIGTERM, or with --sim until all sweeps of the script are answered."""
    settings = load_settings(args)
    folder = None if args.sim else settings.store.runtime_folder
    release = release_trial.observed()
    with last_failure.recorded(folder, SystemClock()), release or nullcontext():
        choice = None if settings.classifier.bundle else assembly.store(settings).choose()
        if choice and choice.folder == DEFAULT and untaught(args, settings, choice.bundle):
            from palpate.cli import teach_command  # here: a box in service does without it

            if release:
                release.serves()
            return teach_command.until_taught(args, settings)
        if release and choice and choice.trial:
            release.stopping()  # it must be clear which of both was the cause of a failure
            release = None
        return _classify(args, settings, choice, release)


def _classify(
    args: argparse.Namespace,
    settings: Config,
    choice: Choice | None,
    release: ReleaseTrial | None,
) -> int:
    stopped = StopFlag()
    with ExitStack() as stack:
        trial = stack.enter_context(choice.trial) if choice and choice.trial else None
        current = choice.bundle if choice else load_bundle(settings, answers=not args.sim)
        if unsigned := assembly.UNSIGNED if settings.classifier.allow_unsigned else "":
            log.warning(f"unsigned {unsigned}")
        devices = open_devices(args, lambda: current.format)
        port = assembly.port(settings, devices)
        disk = DiskThread()
        for one in filter(None, (trial, release)):
            one.disk = disk
        sent_back = releases.text()
        # not next to a trial: if the program dies, it must be clear which bundle was the cause
        shadow = None if trial else _shadow(args, settings, current, devices, disk)
        facts = {
            "trial": lambda: trial.text if trial else "",
            "release": lambda: release.text if release else sent_back,
            "shadow": lambda: shadow.agreement.text if shadow else "",
            "disk": lambda: disk.text,
            "unsigned": lambda: unsigned,
        }
        kept, compared = _kept(settings, current, release, stack, disk), None
        if kept and release and settings.store.runtime_folder:
            of = choice.folder if choice else Path(settings.classifier.bundle)
            compared = release_trial.comparison(release, kept, of)
        reports = _reports(settings, current, devices.source, facts)
        watching = Notifier(SystemClock()), trial, release, kept, compared, shadow, *reports
        observers = [disk, *filter(None, watching)]
        recorded = assembly.capture(args.capture, settings, current.format, stack)
        parts = settings, current, devices, port, stack
        box = assembly.box(*parts, capture=recorded, observers=observers)
        ended = assembly.done(args.sweeps, box, devices, stopped)
        box.run(lambda: ended() or bool(release and release.over))
    return stopped.exit_code


def _kept(
    settings: Config,
    current: Bundle,
    release: ReleaseTrial | None,
    stack: ExitStack,
    disk: DiskThread,
) -> BlackBox | None:
    """The black box, which also holds the sweeps that a release on trial is judged by: in memory if
    the settings have none."""
    most = settings.store.black_box
    compared = release_trial.KEPT if release and settings.store.runtime_folder else 0
    if not (most or compared):
        return None
    from palpate.sweeps.black_box import BlackBox

    folder = settings.kept("black-box") if most else Path(settings.store.runtime) / "trial"
    kept = BlackBox(folder, current.format, max(most, compared), disk)
    stack.callback(kept.close)
    return kept


def untaught(args: argparse.Namespace, settings: Config, packaged: Bundle) -> bool:
    """Whether the skin lacks a bundle: none was delivered or taught, and the packaged bundle is for
    another skin. A skin of PROTOCOL.md announces its format later, so it does not count."""
    profile = skins.profile(settings)
    teaches = settings.teach.allow and not args.sim and profile.codec != "palpate"
    return teaches and not fits(profile.format, packaged.format)


def _reports(settings: Config, current: Bundle, source: str, facts: Facts) -> list[Observer]:
    """The observers that the settings ask for, with `facts`. source: origin of the frames."""
    # without a serial port, a terminal shows the sentences
    shown = in_journal() or bool(settings.serial.port and sys.stderr.isatty())
    observers: list[Observer] = [VerdictLog()] if shown else []
    m, model = current.manifest, _named(current.manifest)
    facts = {"model": lambda: model, **facts}
    from palpate.alignment.live import Expected

    expected = Expected.by(current, settings.skin.fingertip, skins.profile(settings).unit)
    known = {"bundle": current.id, "labels": m.labels, "alignment": expected.json()}
    known |= {"displays": m.displays} if m.displays else {}
    return [*observers, *assembly.reports(settings, current.format, source, known, facts)]


def _named(m: Manifest) -> str:
    return f"{m.name} {m.version}, {len(m.labels)} labels{f', {m.taught}' if m.taught else ''}"


def _shadow(
    args: argparse.Namespace,
    settings: Config,
    current: Bundle,
    devices: Devices,
    disk: DiskThread,
) -> Shadow | None:
    """The candidate of `--shadow`, which classifies next to the current bundle. None without a
    candidate, and for a candidate that cannot run."""
    try:
        candidate = None
        if args.shadow:
            candidate = assembly.named(settings, Path(args.shadow), answers=not args.sim).bundle
        elif args.shadow is not None:
            candidate = assembly.store(settings).candidate()
        if candidate is None:
            return None
        from palpate.deployment.shadow import Shadow

        folder = Path(settings.store.folder) / "shadow"
        made = partial(Classifier, clock=devices.clock, settings=settings.classifier)
        return Shadow(candidate, current, folder, devices.clock, made, disk)
    except (ApplianceError, OSError) as e:  # the box serves the robot, this is for a person
        log.warning(f"no shadow: {e}")
        return None
