"""The commands of `palpate` but those for bundles in the store: run, record, check, enrol, align, replay, config, status.

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
from typing import TYPE_CHECKING

from appliance.bundle import bundle
from appliance.bundle.bundle import Bundle
from appliance.core import config
from appliance.core.clock import SystemClock
from appliance.core.config import Config
from appliance.core.devices import Devices
from appliance.core.errors import ApplianceError
from appliance.core.log import in_journal, log
from appliance.core.observer import Observer
from appliance.core.types import SweepFormat
from appliance.io.robot_link import Port
from appliance.recording.capture import CaptureWriter
from appliance.runtime import assembly
from appliance.runtime.selftest import check
from appliance.service.status import StatusFile
from appliance.service.systemd import Notifier, VerdictLog

if TYPE_CHECKING:
    from appliance.deployment.shadow import Shadow
    from appliance.recording.recording import Labels, RecordingSession

OpenDevices = Callable[[Callable[[], SweepFormat]], Devices]
"""Opens the devices. Its argument gives the format that a simulated skin has to send."""


def load_settings(args: argparse.Namespace) -> Config:
    """The settings that a command's options ask for."""
    return config.load(args.board, args.set, folder=args.config_dir)


def load_bundle(settings: Config) -> Bundle:
    """The bundle that the settings ask for: the one named, the one deployed, or the packaged one."""
    if settings.classifier.bundle:
        return bundle.load(Path(settings.classifier.bundle))
    return assembly.store(settings).running()


def stop_flag() -> Callable[[], bool]:
    """True once SIGTERM or SIGINT has come: the loop then ends within one turn."""
    received: list[int] = []
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda n, frame: received.append(n))
    return lambda: bool(received)


def run(args: argparse.Namespace, open_devices: OpenDevices) -> int:
    """`palpate run`: until SIGTERM, or with --sim until the script has ended and everything was answered."""
    return _serve(args, load_settings(args), open_devices)


def run_record(args: argparse.Namespace, open_devices: OpenDevices) -> int:
    """`palpate record`: as `run`, and each sweep is kept with its label; only whole windows, so no early answers."""
    from appliance.recording.recording import Labels

    labels = Labels(args.material, args.position, args.session)
    return _serve(args, _without_early_answers(load_settings(args)), open_devices, labels)


def _serve(args: argparse.Namespace, settings: Config, open_devices: OpenDevices, labels: Labels | None = None) -> int:
    """Run the box. labels: those with which a recording begins; None where nothing is recorded."""
    stopped = stop_flag()
    choice = None if settings.classifier.bundle else assembly.store(settings).choose()
    with ExitStack() as stack:
        trial = stack.enter_context(choice.trial) if choice and choice.trial else None
        current = choice.bundle if choice else load_bundle(settings)
        devices = open_devices(lambda: current.format)
        port = assembly.port(settings, devices)
        recording = _recording(args, settings, current, devices, port, labels, stack) if labels else None
        # not beside a trial: where the program dies, it must be clear which bundle it was
        shadow = None if trial else _shadow(settings, current, devices, args.shadow)
        facts = {
            "trial": lambda: trial.text if trial else "",
            "shadow": lambda: shadow.agreement.text if shadow else "",
        }
        observers: list[Observer | None] = [
            Notifier(SystemClock()), trial, recording, shadow, *_reports(settings, current, facts, stack),
        ]  # fmt: skip
        capture = CaptureWriter(args.capture, current.format) if args.capture else None
        if capture:
            stack.callback(capture.close)
        box = assembly.box(
            settings, current, devices, port, stack, capture=capture, observers=[o for o in observers if o],
            commands=recording.commands if recording else {},
        )  # fmt: skip

        def done() -> bool:
            enough = args.sweeps is not None and box.answered >= args.sweeps
            return enough or stopped() or devices.finished(box.answered)

        box.run(done)
    return 0


def _without_early_answers(settings: Config) -> Config:
    return replace(settings, classifier=replace(settings.classifier, early=False))


def _recording(
    args: argparse.Namespace, settings: Config, current: Bundle, devices: Devices, port: Port | None, labels: Labels,
    stack: ExitStack,
) -> RecordingSession:  # fmt: skip
    from appliance.recording.recording import RecordingSession

    folder = args.out or Path(settings.store.folder) / "sweeps"
    send = port.say if port else lambda line: None
    recording = RecordingSession(folder, current.format, labels, devices.clock, send)
    stack.callback(recording.close)
    return recording


def _reports(
    settings: Config, current: Bundle, facts: Mapping[str, Callable[[], str]], stack: ExitStack
) -> list[Observer]:
    """What reports to a person and keeps sweeps, as the settings say: the log, the black box, the status with `facts`."""
    observers: list[Observer] = [VerdictLog()] if in_journal() else []
    if settings.store.black_box:
        from appliance.recording.black_box import BlackBox

        black_box = BlackBox(Path(settings.store.folder) / "black-box", current.format, settings.store.black_box)
        stack.callback(black_box.close)
        observers.append(black_box)
    status = Path(settings.store.status)
    if settings.store.status and os.access(status.parent, os.W_OK):
        m = current.manifest
        model = f"{m.name} {m.version}, {len(m.labels)} labels"
        observers.append(
            StatusFile(status, SystemClock(), lambda: {"model": model} | {name: text() for name, text in facts.items()})
        )
    return observers


def _shadow(settings: Config, current: Bundle, devices: Devices, named: str | None) -> Shadow | None:
    """A candidate that classifies beside the current bundle, where one is asked for and there is one."""
    try:
        candidate = None
        if named is not None:
            candidate = bundle.load(Path(named)) if named else assembly.store(settings).candidate()
        if candidate is None:
            return None
        from appliance.deployment.shadow import Shadow

        return Shadow(
            candidate, current, Path(settings.store.folder) / "shadow", devices.clock,
            lambda judged: assembly.classifier(settings, judged, devices.clock),
        )  # fmt: skip
    except (ApplianceError, OSError) as e:  # the box serves the robot, the candidate is for a person
        log.warning(f"no shadow: {e}")
        return None


def run_check(args: argparse.Namespace, open_devices: OpenDevices) -> int:
    """`palpate check`: each component by itself, one line each; 1 where any fails."""
    settings = load_settings(args)
    devices = open_devices(lambda: load_bundle(settings).format)
    failed = 0
    for result in check(devices.wire(settings), lambda: load_bundle(settings), devices):
        print(f"{'ok  ' if result.ok else 'FAIL'}  {result.component:<14} {result.detail}", flush=True)
        failed += not result.ok
    return 1 if failed else 0


def run_enrol(args: argparse.Namespace, open_devices: OpenDevices) -> int:
    """`palpate enrol`: the box takes sweeps as always; of the good ones it makes a bundle with one label more."""
    from appliance.inference import enrolment

    settings = _without_early_answers(load_settings(args))
    current = load_bundle(settings)
    enrolment.admit(current, args.label)
    enrolment.check_target(args.out, args.replace)
    devices = open_devices(lambda: current.format)
    stopped = stop_flag()
    with ExitStack() as stack:
        taken = enrolment.SweepCollector(args.good)
        port = assembly.port(settings, devices)
        box = assembly.box(settings, current, devices, port, stack, observers=[taken], labels=(args.label,))
        box.run(lambda: taken.enough or stopped() or devices.finished(box.answered))
    new = enrolment.enrol(current, args.label, taken.windows())
    for warning in new.warnings:
        log.warning(f"warning: {warning}")
    enrolment.write(new.files, args.out, args.replace)
    m = new.bundle.manifest
    log.info(
        f"{args.out}: {m.name} {m.version}, {new.bundle.id}, {len(m.labels)} labels; use it with classifier.bundle"
    )
    return 0


def run_align(args: argparse.Namespace, open_devices: OpenDevices) -> int:
    """`palpate align`: where the contact lies, until Ctrl-C."""
    from appliance.alignment import live
    from appliance.alignment.terminal import Screen
    from appliance.alignment.view import Display
    from appliance.alignment.web import Page

    settings = load_settings(args)
    current = load_bundle(settings)
    devices, stopped = open_devices(lambda: current.format), stop_flag()  # before anybody can read the page's address
    with ExitStack() as stack:
        pages = [stack.enter_context(Page(args.web, devices.clock))] if args.web is not None else []
        screen = stack.enter_context(Screen(sys.stdout, devices.clock, *(page.address for page in pages)))
        displays: list[Display] = [screen, *pages]
        live.run(devices.wire(settings).sensor, current, devices, displays, stopped)
    return 0


def run_replay(args: argparse.Namespace) -> int:
    """`palpate replay`: the sentences of a capture, a kept sweep or a folder of them; 1 where a verdict differs."""
    from appliance.runtime.replay import replay

    settings = load_settings(args)
    return replay(args.file, settings, load_bundle(settings), lambda text: print(text, end="", flush=True))


def run_config(args: argparse.Namespace) -> int:
    """`palpate config`: each value with its source."""
    print(config.describe(load_settings(args)))
    return 0


def run_status(args: argparse.Namespace) -> int:
    """`palpate status`: the state of the service; 69 where it waits for the skin, 1 where it does not run."""
    from appliance.service import status

    now_ns = SystemClock().now_ns()
    report = status.read(Path(load_settings(args).store.status), now_ns)
    print(json.dumps(report, indent=1) if args.json else "\n".join(status.lines(report, now_ns)))
    return status.exit_code(report)


WITH_DEVICES = {"run": run, "record": run_record, "check": run_check, "enrol": run_enrol, "align": run_align}
RUNS = {"replay": run_replay, "config": run_config, "status": run_status}
