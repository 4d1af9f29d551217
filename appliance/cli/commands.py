"""The commands of `palpate` but those for bundles in the store: run, record, check, enrol, align,
replay, config, status.

In: arguments, and for the first five a way to the devices, which `main` chooses. Out: exit codes.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from appliance.bundle.bundle import Bundle
from appliance.core import config
from appliance.core.clock import SystemClock
from appliance.core.config import Config
from appliance.core.devices import Devices
from appliance.core.errors import ApplianceError, BundleError, ConfigError, FormatError, SensorError
from appliance.core.log import in_journal, log
from appliance.core.observer import Observer
from appliance.core.types import SweepFormat
from appliance.deployment.enrolment_key import EnrolmentKey
from appliance.io import skin_profile, skins
from appliance.io.robot_link import Command, Port
from appliance.io.usb_sensor import fits
from appliance.recording.capture import CaptureWriter
from appliance.runtime import assembly
from appliance.runtime.selftest import check
from appliance.service.status import StatusFile
from appliance.service.systemd import Notifier, VerdictLog

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from appliance.alignment.live import Expected
    from appliance.deployment.shadow import Shadow
    from appliance.recording.recording import RecordingSession
    from appliance.runtime.loop import Box
    from appliance.watch.record import RecordPage
    from appliance.watch.server import PageServer

Facts = Mapping[str, Callable[[], object]]
"""Further facts of the status and the feed, by their names; a text is shown to a person."""
OpenDevices = Callable[[Callable[[], SweepFormat] | None], Devices]
"""Opens the devices. Its argument gives the format that a simulated skin has to send; None for
whatever its script has."""


def load_settings(args: argparse.Namespace) -> Config:
    """The settings that a command's options ask for. --every and --sweep are settings of the
    trigger by the clock."""
    sets = list(args.set)
    for key, option in (("profile", "skin"), ("port", "skin_port")):
        if value := getattr(args, option, None):
            sets.append(f"skin.{key}={value}")
    every, sweep = getattr(args, "every", None), getattr(args, "sweep", None)
    mode = getattr(args, "trigger", None)
    if every is not None or sweep is not None:
        if mode not in (None, "timed"):
            raise ConfigError(
                f"--every and --sweep are for --trigger timed, not for {mode}; leave them out"
            )
        mode = "timed"
    sets += [f"trigger.mode={mode}"] if mode else []
    settings = config.load(args.board, sets, folder=args.config_dir)
    times = {name: s for name, s in (("every_s", every), ("sweep_s", sweep)) if s is not None}
    return replace(settings, trigger=replace(settings.trigger, **times)) if times else settings


def status_file(settings: Config) -> Path:
    """The file with the state of the service. Raises ConfigError if the settings name none."""
    if not settings.store.status:
        raise ConfigError(
            'store.runtime = "" turns the status file off; set it to a folder, and restart the service'
        )
    return settings.store.status


def load_bundle(settings: Config, *, answers: bool = True) -> Bundle:
    """The bundle that the settings ask for; see assembly.running."""
    return assembly.running(settings, answers=answers).bundle


def stop_flag() -> Callable[[], bool]:
    """True once SIGTERM or SIGINT has come: the loop then ends within one turn."""
    received: list[int] = []
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda n, frame: received.append(n))
    return lambda: bool(received)


def run(args: argparse.Namespace, open_devices: OpenDevices) -> int:
    """`palpate run`: until SIGTERM, or with --sim until the script has ended and everything was
    answered."""
    settings, stopped = load_settings(args), stop_flag()
    choice = None if settings.classifier.bundle else assembly.store(settings).choose()
    with ExitStack() as stack:
        trial = stack.enter_context(choice.trial) if choice and choice.trial else None
        current = choice.bundle if choice else load_bundle(settings, answers=not args.sim)
        if settings.classifier.allow_unsigned:
            log.warning(f"unsigned {assembly.UNSIGNED}")
        devices = open_devices(lambda: current.format)
        port = assembly.port(settings, devices)
        # not beside a trial: where the program dies, it must be clear which bundle it was
        shadow = None if trial else _shadow(args, settings, current, devices)
        facts = {
            "trial": lambda: trial.text if trial else "",
            "shadow": lambda: shadow.agreement.text if shadow else "",
            "unsigned": lambda: assembly.UNSIGNED if settings.classifier.allow_unsigned else "",
        }
        observers: list[Observer | None] = [
            Notifier(SystemClock()),
            trial,
            shadow,
            *_reports(settings, current, devices.source, facts, stack),
        ]
        box = assembly.box(
            settings,
            current,
            devices,
            port,
            stack,
            capture=_capture(args, settings, current.format, stack),
            observers=[o for o in observers if o],
        )
        box.run(_done(args, box, devices, stopped))
    return 0


def run_record(args: argparse.Namespace, open_devices: OpenDevices) -> int:
    """`palpate record`: each sweep is kept with its label. No bundle is needed: the skin says what
    it sends."""
    from appliance.recording.recording import Labels, RecordingSession

    labels = Labels(args.material, args.position, args.session)
    settings, stopped = load_settings(args), stop_flag()
    with ExitStack() as stack:
        asked = skins.described(args.format) if args.format else None
        devices = open_devices((lambda: asked) if asked else None)
        format = asked or devices.format or _announced(devices.wire(settings), devices)
        if args.window is not None:
            format = replace(format, window=round(args.window * format.rate_hz))
        _check_length(format, settings)
        # a person at a terminal reads the log; sentences are for a robot, or for a program that
        # reads the output
        port = (
            assembly.port(settings, devices)
            if settings.serial.port or not sys.stdout.isatty()
            else None
        )
        folder = args.out or Path(settings.store.folder) / "sweeps"
        recording = RecordingSession(
            folder, format, labels, devices.clock, _sentences(port), args.target
        )
        stack.callback(recording.close)
        page = _record_page(
            args, settings, format, devices, recording, lambda command: box.obey(command)
        )
        log.info(
            f"record: {format}, to {folder}; slide for longer than {format.window / format.rate_hz:.3g} s"
        )
        if slow := skin_profile.warning(format):
            log.warning(f"record: {slow}")
        facts: Facts = {
            "model": lambda: "none: sweeps are recorded",
            "recorded": lambda: recording.about()["missing"],
            "recording": recording.about,
        }
        feed = _feed(settings, format, devices.source, {"bundle": "", "labels": []}, facts)
        box = assembly.recorder(
            settings,
            format,
            devices,
            port,
            stack,
            capture=_capture(args, settings, format, stack),
            observers=[
                Notifier(SystemClock()),
                recording,
                *_printer(format, recording),
                *_status(settings, facts),
                *feed,
                *page,
            ],
            commands=recording.commands,
            ordered=bool(page),
        )
        for shown in page:
            stack.enter_context(shown)
        box.run(_done(args, box, devices, stopped))
    return 0


def _printer(format: SweepFormat, recording: RecordingSession) -> list[Observer]:
    """What shows each sweep to a person at a terminal."""
    if not sys.stdout.isatty():
        return []
    from appliance.watch.sweep_text import SweepPrinter

    return [SweepPrinter(sys.stdout, format.rate_hz, recording.about)]


def _record_page(
    args: argparse.Namespace,
    settings: Config,
    format: SweepFormat,
    devices: Devices,
    recording: RecordingSession,
    obey: Callable[[Command], list[object]],
) -> list[RecordPage]:
    """The page on which a person sees the recording and sets its labels, where one is asked for."""
    if args.web is None:
        return []
    from appliance.watch.access import Access
    from appliance.watch.record import RecordPage

    access = Access.configured(settings.watch, args.web)
    page = RecordPage(
        access,
        format,
        devices.source,
        devices.wire(settings).trigger,
        recording.about,
        obey,
        SystemClock(),
    )
    log.info(f"page: {page.server.address}")
    return [page]


def _announced(settings: Config, devices: Devices) -> SweepFormat:
    """The form that the skin announces. Raises SensorError, with what else would do."""
    try:
        return skins.announced(settings, devices)
    except SensorError as e:
        raise type(e)(
            f"{e}; or say what it sends, with --format 4x4:uint8:750, and it is waited for"
        ) from e


def _check_length(format: SweepFormat, settings: Config) -> None:
    """Raises ConfigError if no sweep could be as long as the window."""
    if format.window * format.period_ns > settings.sweep.max_duration_s * 1e9:
        raise ConfigError(
            f"a window of {format.window / format.rate_hz:g} s is longer than any sweep may last "
            f"({settings.sweep.max_duration_s:g} s); use a shorter --window, or raise sweep.max_duration_s"
        )


def _sentences(port: Port | None) -> Callable[[bytes], None]:
    return port.say if port else lambda line: None


def _capture(
    args: argparse.Namespace, settings: Config, format: SweepFormat, stack: ExitStack
) -> CaptureWriter | None:
    capture = CaptureWriter(args.capture, format, skins.profile(settings)) if args.capture else None
    if capture:
        stack.callback(capture.close)
    return capture


def _done(
    args: argparse.Namespace, box: Box, devices: Devices, stopped: Callable[[], bool]
) -> Callable[[], bool]:
    """True when the loop is to end: by a signal, after --sweeps answers, at the end of a script."""
    return lambda: (
        (args.sweeps is not None and box.answered >= args.sweeps)
        or stopped()
        or devices.finished(box.answered)
    )


def _reports(
    settings: Config, current: Bundle, source: str, facts: Facts, stack: ExitStack
) -> list[Observer]:
    """What reports to a person and keeps sweeps, as the settings say: the log, the black box,
    status and feed with `facts`. source: where the frames come from."""
    observers: list[Observer] = [VerdictLog()] if in_journal() else []
    if settings.store.black_box:
        from appliance.recording.black_box import BlackBox

        black_box = BlackBox(
            Path(settings.store.folder) / "black-box", current.format, settings.store.black_box
        )
        stack.callback(black_box.close)
        observers.append(black_box)
    m = current.manifest
    model = f"{m.name} {m.version}, {len(m.labels)} labels"
    facts = {"model": lambda: model, **facts}
    from appliance.alignment.live import Expected

    expected = Expected.by(current, settings.skin.fingertip)
    known = {"bundle": current.id, "labels": m.labels, "alignment": expected.json()}
    return [
        *observers,
        *_status(settings, facts),
        *_feed(settings, current.format, source, known, facts),
    ]


def _status(settings: Config, facts: Facts) -> list[Observer]:
    """The file that `palpate status` reads, where the settings name one that can be written."""
    path = settings.store.status
    if not path or not os.access(path.parent, os.W_OK):
        return []
    return [StatusFile(path, SystemClock(), lambda: {name: fact() for name, fact in facts.items()})]


def _feed(
    settings: Config, format: SweepFormat, source: str, model: Mapping[str, Any], facts: Facts
) -> list[Observer]:
    """What programs that watch the box read, where the settings name a socket; its default is for a
    service, whose folder is there. model: what the feed's first line says of it."""
    path = settings.store.feed
    default = settings.sources["store.runtime"] == "code"
    if not path or (default and not os.access(path.parent, os.W_OK)):
        return []
    from appliance.service.feed import FeedServer

    known = {"source": source, "skin": settings.skin.profile, **model}
    return [
        FeedServer(
            path,
            format,
            known,
            SystemClock(),
            lambda: {name: fact() for name, fact in facts.items()},
        )
    ]


def _shadow(
    args: argparse.Namespace, settings: Config, current: Bundle, devices: Devices
) -> Shadow | None:
    """A candidate that classifies beside the current bundle, where one is asked for and there is
    one."""
    try:
        candidate = None
        if args.shadow:
            candidate = assembly.named(settings, Path(args.shadow), answers=not args.sim).bundle
        elif args.shadow is not None:
            candidate = assembly.store(settings).candidate()
        if candidate is None:
            return None
        from appliance.deployment.shadow import Shadow

        return Shadow(
            candidate,
            current,
            Path(settings.store.folder) / "shadow",
            devices.clock,
            lambda judged: assembly.classifier(settings, judged, devices.clock),
        )
    except (
        ApplianceError,
        OSError,
    ) as e:  # the box serves the robot, the candidate is for a person
        log.warning(f"no shadow: {e}")
        return None


def _open_any(open_devices: OpenDevices, settings: Config) -> Devices:
    """The devices; a simulated skin sends what the bundle wants, where there is one and the skin
    can."""
    try:
        return open_devices(lambda: load_bundle(settings, answers=False).format)
    except (BundleError, FormatError):
        return open_devices(None)


def run_check(args: argparse.Namespace, open_devices: OpenDevices) -> int:
    """`palpate check`: each component by itself, one line each; 1 where any fails."""
    settings = load_settings(args)
    devices = _open_any(open_devices, settings)
    failed = 0
    for result in check(
        devices.wire(settings), lambda: load_bundle(settings, answers=not args.sim), devices
    ):
        print(
            f"{'ok  ' if result.ok else 'FAIL'}  {result.component:<14} {result.detail}", flush=True
        )
        failed += not result.ok
    return 1 if failed else 0


def run_enrol(args: argparse.Namespace, open_devices: OpenDevices) -> int:
    """`palpate enrol`: the box takes sweeps as always; of the good ones it learns one label
    more."""
    from appliance.inference import enrolment

    settings = load_settings(args)
    start = assembly.running(settings, answers=not args.sim)
    key = _enrolment_key(args, settings)
    enrolment.admit(start.bundle, args.label)
    if args.out:
        enrolment.check_target(args.out, args.replace)
    new = enrolment.enrol(
        start.bundle, args.label, _good_sweeps(args, settings, start.bundle, open_devices)
    )
    if new.disagreement and not args.scattered:
        raise BundleError(
            f"{new.disagreement}, or give --scattered if all are of {args.label!r}; nothing was written"
        )
    for warning in filter(None, (new.disagreement, *new.warnings)):
        log.warning(f"warning: {warning}")
    files = enrolment.files(start.files, new, key.sign(new.file) if key else None)
    if args.out:
        enrolment.write(files, args.out, args.replace)
    else:
        assembly.store(settings).enrol(files)
    m = new.bundle.manifest
    use = f"palpate install {args.out}" if key else "classifier.bundle; it is not signed"
    how = (
        f"use it with {use}"
        if args.out
        else "it runs on trial from the next start on: systemctl restart palpate"
    )
    log.info(
        f"{args.out or 'installed'}: {m.name} {m.version}, {new.bundle.id}, {len(m.labels)} labels; {how}"
    )
    return 0


def _enrolment_key(args: argparse.Namespace, settings: Config) -> EnrolmentKey | None:
    """The key that signs what is enrolled, checked before the robot sweeps. None where it is not
    signed: what a simulated skin taught, and on a bench that allows unsigned bundles. Raises
    ConfigError."""
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
                f"with {unsigned} what is enrolled is not signed, and a box takes none such; give --out DIR"
            )
        return None
    if not args.out and settings.classifier.early:
        raise ConfigError(
            "early answers end with an enrolment, whose labels they do not know; set classifier.early = false"
        )
    key = EnrolmentKey(settings.store.enrolment_key)
    key.check()
    return key


def _good_sweeps(
    args: argparse.Namespace, settings: Config, current: Bundle, open_devices: OpenDevices
) -> NDArray[Any]:
    """The windows of as many good sweeps as are asked for. Raises ApplianceError where there are
    too few."""
    from appliance.inference.enrolment import SweepCollector

    settings = replace(settings, classifier=replace(settings.classifier, early=False))
    devices = open_devices(lambda: current.format)
    stopped = stop_flag()
    taken = SweepCollector(args.good)
    with ExitStack() as stack:
        port = assembly.port(settings, devices)
        box = assembly.box(
            settings, current, devices, port, stack, observers=[taken], labels=(args.label,)
        )
        box.run(lambda: taken.enough or stopped() or devices.finished(box.answered))
    return taken.windows()


def local_page(name: str, port: int | None, stack: ExitStack) -> list[PageServer]:
    """The server of a page for browsers on this machine, where a port is given."""
    if port is None:
        return []
    from appliance.watch.access import Access
    from appliance.watch.server import PageServer

    return [stack.enter_context(PageServer(name, Access(port), SystemClock().now_ns))]


def run_align(args: argparse.Namespace, open_devices: OpenDevices) -> int:
    """`palpate align`: where the contact lies, until Ctrl-C."""
    from appliance.alignment import live
    from appliance.alignment.terminal import Screen
    from appliance.alignment.view import Display

    if args.sim == "skin":  # its sweeps lift the finger for a tenth of a second; for this it rests
        args.sim = "rest"
    settings = load_settings(args)
    devices = _open_any(open_devices, settings)
    expected = _expected(devices.wire(settings), devices)
    stopped = stop_flag()  # before anybody can read the page's address
    with ExitStack() as stack:
        pages = local_page("watch.html", args.web, stack)
        screen = stack.enter_context(
            Screen(sys.stdout, devices.clock, *(page.address for page in pages))
        )
        displays: list[Display] = [screen, *pages]
        live.run(devices.wire(settings), expected, devices, displays, stopped)
    return 0


def _expected(settings: Config, devices: Devices) -> Expected:
    """What is known of the skin: by the bundle, where there is one that fits it or no skin yet."""
    from appliance.alignment.live import Expected

    current, fingertip = None, settings.skin.fingertip
    try:
        current = load_bundle(settings, answers=False)
    except BundleError as e:
        log.warning(f"no bundle: {e}")
    try:
        format = devices.format or skins.announced(settings, devices)
    except SensorError:
        if not current:
            raise
        return Expected.by(current, fingertip)  # the skin is waited for
    if current and fits(format, current.format):
        return Expected.by(current, fingertip)
    return Expected(format, fingertip=fingertip)


def run_replay(args: argparse.Namespace) -> int:
    """`palpate replay`: the sentences of a capture, a kept sweep or a folder of them; 1 where a
    verdict differs."""
    from appliance.runtime.replay import replay

    settings = load_settings(args)
    bundle = load_bundle(settings, answers=False)
    return replay(args.file, settings, bundle, lambda text: print(text, end="", flush=True))


def run_config(args: argparse.Namespace) -> int:
    """`palpate config`: each value with its source."""
    print(config.describe(load_settings(args)))
    return 0


def run_status(args: argparse.Namespace) -> int:
    """`palpate status`: the state of the service; 69 where it waits for the skin, 1 where it does
    not run."""
    from appliance.service import status

    now_ns = SystemClock().now_ns()
    report = status.read(status_file(load_settings(args)), now_ns)
    print(json.dumps(report, indent=1) if args.json else "\n".join(status.lines(report, now_ns)))
    return status.exit_code(report)


WITH_DEVICES = {
    "run": run,
    "record": run_record,
    "check": run_check,
    "enrol": run_enrol,
    "align": run_align,
}
RUNS = {"replay": run_replay, "config": run_config, "status": run_status}
