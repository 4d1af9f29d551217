"""What the box does with its devices: run, check, enrol. In: arguments, a way to the devices. Out: exit codes.

`__main__` says which devices these are.
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from appliance.bundle import bundle
from appliance.bundle.bundle import Bundle
from appliance.core import config
from appliance.core.clock import SystemClock
from appliance.core.config import Config
from appliance.core.devices import Devices
from appliance.core.errors import ApplianceError
from appliance.core.health import HealthObserver
from appliance.core.types import SweepFormat
from appliance.io.robot_link import Port, ResultSink
from appliance.recording.capture import CaptureWriter
from appliance.runtime import assembly
from appliance.runtime.assembly import log
from appliance.runtime.loop import Box, SweepObserver
from appliance.runtime.selftest import check
from appliance.service import journal
from appliance.service.notify import Manager
from appliance.service.status import StatusFile

OpenDevices = Callable[[Callable[[], SweepFormat]], Devices]
"""Gives the world; asked with what tells the format that a simulated skin has to send."""


def settings(args: argparse.Namespace) -> Config:
    """The settings that a command's options ask for."""
    return config.load(args.board, args.set, folder=args.config_dir)


def model(settings: Config) -> Bundle:
    """The bundle that the settings ask for: the one named, the one deployed, or the packaged one."""
    if settings.classifier.bundle:
        return bundle.load(Path(settings.classifier.bundle))
    return assembly.store(settings).running()


def _whole(how: Config) -> Config:
    """The settings without early answers."""
    return replace(how, classifier=replace(how.classifier, early=False))


def stop_flag() -> Callable[[], bool]:
    """True once SIGTERM or SIGINT has come: the loop then ends within one turn."""
    got: list[int] = []
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda n, frame: got.append(n))
    return lambda: bool(got)


def run(args: argparse.Namespace, devices: OpenDevices) -> int:
    """`palpate run`: until SIGTERM, or with --sim until the script has ended and everything was answered."""
    return _serve(args, devices, lambda *_: None)


def run_record(args: argparse.Namespace, devices: OpenDevices) -> int:
    """`palpate record`: the same, and each sweep is kept with its label; whole windows are wanted, so nothing is early."""
    from appliance.recording.recording import Labels, RecordingSession

    labels = Labels(args.material, args.position, args.session)

    def add(crew: Crew, how: Config, fmt: SweepFormat, world: Devices, stack: ExitStack) -> None:
        folder = args.out or Path(how.store.folder) / "sweeps"
        recording = RecordingSession(
            folder, fmt, labels, world.clock, circumstances=crew.circumstances, say=crew.say, log=log
        )  # fmt: skip
        stack.callback(recording.close)
        crew.keepers.append(recording.keep)
        crew.obey |= recording.commands

    return _serve(args, devices, add, whole=True)


@dataclass
class Crew:
    """Who works beside the box: what `build.box` is to be given. box: there once it was built."""

    also: list[ResultSink] = field(default_factory=list)
    keepers: list[SweepObserver] = field(default_factory=list)
    pulses: list[HealthObserver] = field(default_factory=list)
    obey: dict[str, Callable[[str], list[object]]] = field(default_factory=dict)
    port: Port | None = None
    box: Box | None = None

    def circumstances(self) -> Mapping[str, Any]:
        """Those of the box."""
        return self.box.circumstances() if self.box else {}

    def say(self, line: bytes) -> None:
        """Send a sentence to the robot."""
        if self.port:
            self.port.say(line)


def _serve(
    args: argparse.Namespace, devices: OpenDevices, add: Callable[[Crew, Config, SweepFormat, Devices, ExitStack], None], *,
    whole: bool = False,
) -> int:  # fmt: skip
    """Run the box. add: puts further ones into its crew. whole: no early answers."""
    how, stopped = settings(args), stop_flag()
    how = _whole(how) if whole else how
    chosen = None if how.classifier.bundle else assembly.store(how).choose(log)
    with ExitStack() as stack:
        trial = stack.enter_context(chosen.trial) if chosen and chosen.trial else None
        held = chosen.bundle if chosen else model(how)
        world = devices(lambda: held.format)
        crew = Crew(pulses=[Manager(SystemClock())], port=assembly.port(how, world))
        if trial:
            crew.also.append(trial)
            crew.pulses.append(trial)
        add(crew, how, held.format, world, stack)
        # not beside a trial: a program that dies would be laid at the wrong door
        beside = str if trial else _shadow(crew, how, held, world, args.shadow)
        _watch(crew, how, held, stack, {"trial": lambda: trial.text if trial else "", "shadow": beside})
        capture = CaptureWriter(args.capture, held.format, log) if args.capture else None
        if capture:
            stack.callback(capture.close)
        crew.box = box = assembly.box(
            how, held, world, crew.port, stack, capture=capture, log=log, also=crew.also, keepers=crew.keepers,
            pulses=crew.pulses, obey=crew.obey,
        )  # fmt: skip

        def done() -> bool:
            enough = args.sweeps is not None and box.answered >= args.sweeps
            return enough or stopped() or world.finished(box.answered)

        box.run(done)
    return 0


def _watch(crew: Crew, how: Config, held: Bundle, stack: ExitStack, facts: Mapping[str, Callable[[], str]]) -> None:
    """Have the crew tell a person and keep what the settings want: journal, black box, status with these facts."""
    store = Path(how.store.folder)
    if journal.attached():
        crew.also.append(journal.Journal(log))
    if how.store.black_box:
        from appliance.recording.black_box import BlackBox

        box = BlackBox(
            store / "black-box", held.format, how.store.black_box, circumstances=crew.circumstances, log=log
        )  # fmt: skip
        stack.callback(box.close)
        crew.keepers.append(box.keep)
    status = Path(how.store.status)
    if how.store.status and os.access(status.parent, os.W_OK):
        m = held.manifest
        facts = {"model": lambda: f"{m.name} {m.version}, {len(m.labels)} labels", **facts}
        told = StatusFile(status, SystemClock(), more=lambda: {name: tell() for name, tell in facts.items()}, log=log)
        crew.also.append(told)
        crew.pulses.append(told)


def _shadow(crew: Crew, how: Config, held: Bundle, world: Devices, named: str | None) -> Callable[[], str]:
    """Have a candidate classify beside, where one is wanted and there is one; how it does, in words."""
    try:
        candidate = None
        if named is not None:
            candidate = bundle.load(Path(named)) if named else assembly.store(how).candidate()
        if candidate is None:
            return str
        from appliance.deployment.shadow import Shadow

        shadow = Shadow(
            candidate, held, Path(how.store.folder) / "shadow", world.clock,
            judge=lambda model: assembly.classifier(how, model, world.clock), circumstances=crew.circumstances, log=log,
        )  # fmt: skip
    except (ApplianceError, OSError) as e:  # the box is there for the robot, the candidate for a person
        log(f"{journal.WARNING}no shadow: {e}")
        return str
    crew.keepers.append(shadow)
    crew.pulses.append(shadow)
    return lambda: shadow.agreement.text


def run_check(args: argparse.Namespace, devices: OpenDevices) -> int:
    """`palpate check`: each part by itself, one line each; 1 where any fails."""
    how = settings(args)
    world = devices(lambda: model(how).format)
    failed = 0
    for f in check(world.wire(how), lambda: model(how), world):
        print(f"{'ok  ' if f.ok else 'FAIL'}  {f.part:<14} {f.detail}", flush=True)
        failed += not f.ok
    return 1 if failed else 0


def run_enrol(args: argparse.Namespace, devices: OpenDevices) -> int:
    """`palpate enrol`: the box takes sweeps as always; of the good ones it makes a bundle with one label more."""
    from appliance.inference import enrolment

    how = _whole(settings(args))
    held = model(how)
    enrolment.admit(held, args.label)
    enrolment.check_place(args.out, args.replace)
    world = devices(lambda: held.format)
    stopped = stop_flag()
    with ExitStack() as stack:
        taken = enrolment.Taken(args.good, log)
        port = assembly.port(how, world)
        box = assembly.box(how, held, world, port, stack, keepers=[taken.keep], log=log, labels=(args.label,))
        box.run(lambda: taken.enough or stopped() or world.finished(box.answered))
    new = enrolment.enrol(held, args.label, taken.windows())
    for warning in new.warnings:
        log(f"warning: {warning}")
    enrolment.write(new.files, args.out, args.replace)
    m = new.bundle.manifest
    log(f"{args.out}: {m.name} {m.version}, {new.bundle.id}, {len(m.labels)} labels; use it with classifier.bundle")
    return 0


def run_align(args: argparse.Namespace, devices: OpenDevices) -> int:
    """`palpate align`: where the contact lies, until Ctrl-C."""
    from appliance.alignment import live
    from appliance.alignment.terminal import Screen
    from appliance.alignment.view import Display
    from appliance.alignment.web import Page

    how = settings(args)
    held = model(how)
    world = devices(lambda: held.format)
    with ExitStack() as stack:
        pages = [stack.enter_context(Page(args.web, world.clock))] if args.web is not None else []
        screen = stack.enter_context(Screen(sys.stdout, world.clock, *(page.address for page in pages)))
        displays: list[Display] = [screen, *pages]
        live.run(world.wire(how).sensor, held, world, displays, stop_flag())
    return 0


RUNS = {"run": run, "record": run_record, "check": run_check, "enrol": run_enrol, "align": run_align}
