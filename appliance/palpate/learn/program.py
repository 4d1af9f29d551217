"""The program that teaches a box: it records and assesses sweeps until a bundle is made of them,
and with a page then tries the bundle, until it is taught again or the person is done."""

from __future__ import annotations

import getpass
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from palpate.answer.slide_check import SlideFinding
from palpate.core import storage
from palpate.core.clock import Clock, SystemClock
from palpate.core.config import Config
from palpate.core.devices import Devices
from palpate.core.disk_thread import DiskThread
from palpate.core.errors import ApplianceError
from palpate.core.interrupts import StopFlag
from palpate.core.log import log
from palpate.core.names import TypedNames
from palpate.core.observer import Facts, Health, Observer
from palpate.core.sentences import CommandHandler, Reply
from palpate.core.types import Sweep, SweepFormat
from palpate.inference.classifier import class_distances
from palpate.io.robot_link import Command, check_bits
from palpate.learn import install, materials
from palpate.learn.enrolment import slide_check
from palpate.learn.session import Teacher, TeachingSession, refuse_trained
from palpate.runtime import assembly
from palpate.service.systemd import Notifier
from palpate.sweeps.recording import Labels, RecordingSession
from palpate.sweeps.sweep_check import SlidesBefore, SweepCheck
from palpate.sweeps.sweep_folder import NOT_THIS

NOTHING, GOOD = "nothing taught yet", 8
"""The model of a box that is being taught, in status and feed; and its wanted number of sweeps."""


@dataclass(frozen=True, slots=True)
class TaughtLesson:
    """The lesson that a person asks for.

    labels: materials to record one after another; without them the page or the robot chooses.
    position, session: of the first sweeps. good: wanted number of sweeps of each material. by: who
    teaches. options: of the settings, for the process that makes a bundle. waits: the address of
    the page to which the service hands over, or the reason why there is none; the service runs even
    if nothing can start a sweep. "" outside of the service. capture: file of all input, or None.
    """

    labels: Sequence[str] = ()
    position: str = "1"
    session: str = ""
    good: int = GOOD
    by: str = ""
    options: Sequence[str] = ()
    waits: str = ""
    capture: Path | None = None


class TeachingProgram:
    """Records until a bundle is made, or all sweeps of the lesson are there; with a page then tries
    the bundle, and so on until DONE. again: the material that follows a trial, "" for none. base:
    the delivered bundle into which materials are taught. Raises ConfigError."""

    def __init__(
        self, settings: Config, devices: Devices, format: SweepFormat, lesson: TaughtLesson
    ) -> None:
        self.settings, self.devices, self.lesson = settings, devices, lesson
        self.base = install.base(assembly.store(settings), format)
        if self.base:  # sweeps as long as the sweeps of its materials
            format = self.base.bundle.format
            materials.check_settings(settings)
        self.format, self.names, self.again = format, TypedNames(), ""
        if self.base:  # its labels are taken, whatever script a name is typed in
            m = self.base.bundle.manifest
            for label in m.labels:
                self.names.add(label, m.displays.get(label))
        self._done, self._stopped = False, StopFlag()
        self.codes = 1 << len(bits) if (bits := settings.output.class_bits) else 0

    @property
    def ended(self) -> bool:
        return self._done or self._stopped()

    @property
    def trained(self) -> tuple[str, ...]:
        """The labels that the delivered bundle was trained on."""
        return materials.trained(self.base.bundle) if self.base else ()

    def about(self) -> dict[str, Any]:
        return self._phase.about() | {"good": self.lesson.good}

    def obey(self, command: Command) -> Reply:
        """Carry out an order of the page, in the loop's thread."""
        own = self._phase.orders.get(command.name)
        return own(command.text) if own else self._phase.box.obey(command)

    def run(self, pages: Sequence[Observer], address: str) -> None:
        """Run until all sweeps are recorded; with pages, at `address`, until DONE."""
        self.pages, self.address = pages, address
        while self._ran(RecordingPhase) and pages and not self.ended:
            if not self._ran(TryingPhase):
                return

    def _ran(self, phase: type[RecordingPhase | TryingPhase]) -> bool:
        with ExitStack() as stack:
            self._phase: RecordingPhase | TryingPhase = phase(self, stack)
            return self._phase.run()

    def finish(self, _: str) -> list[object]:
        self._done = True
        return []

    def by_robot(self, commands: Mapping[str, CommandHandler]) -> dict[str, CommandHandler]:
        """The commands that the serial line carries, if the settings allow them to a robot."""
        allowed = self.settings.teach.serial
        return {name: act if allowed else _forbidden for name, act in commands.items()}


class RecordingPhase:
    """Records and assesses. `stack` closes it. orders: of the page, tried before commands of the
    box."""

    def __init__(self, program: TeachingProgram, stack: ExitStack) -> None:
        self._program, lesson, devices = program, program.lesson, program.devices
        settings, again, pages = program.settings, program.again, program.pages
        port = assembly.port(settings, devices, terminal=False)
        disk = DiskThread()
        say = port.say if port else lambda line: None
        labels = Labels(again, lesson.position, lesson.session)
        to = settings.kept("sweeps"), program.format, labels
        self._recording = RecordingSession(
            *to, devices.clock, say, lesson.good, disk, program.names
        )
        stack.callback(self._recording.close)
        self._session = session = self._lesson(say)
        stack.callback(session.close)
        taught = () if again else lesson.labels
        self._teacher = Teacher(session, self._recording, taught, lesson.good)
        check = SweepCheck(program.format, devices.clock, self._slides(), teaching=True)
        self.box = assembly.assembled(
            *(settings, check, devices, port, stack),
            capture=assembly.capture(lesson.capture, settings, program.format, stack),
            observers=[disk, *self._observers(), self._teacher, *pages],
            commands=program.by_robot({**session.recording_commands, **session.commands}),
            ordered=bool(pages or lesson.waits),
            serving=False,
        )
        self.orders = {**session.recording_commands, **session.commands, "DONE": program.finish}
        session.by = "the page" if pages else lesson.by or getpass.getuser()

    def about(self) -> dict[str, Any]:
        return self._recording.about() | {"teach": self._session.about()}

    def run(self) -> bool:
        """Run; returns whether a bundle was made."""
        program, session = self._program, self._session
        teacher, finished = self._teacher, program.devices.finished
        self.box.run(
            lambda: (
                program.ended or bool(session.taught) or teacher.done or finished(self.box.answered)
            )
        )
        return bool(session.taught)

    def _slides(self) -> Callable[[Sweep], SlideFinding]:
        if not self._program.base:
            return SlidesBefore(self._program.format, self._recording)
        known = slide_check(self._program.base.bundle)
        return lambda sweep: SlideFinding(known(sweep.frames.taxels))

    def _lesson(self, say: Callable[[bytes], None]) -> TeachingSession:
        """The teaching session of a recording. Raises ConfigError for a label that it refuses."""
        program = self._program
        if program.base:  # it has the materials of an earlier session by now
            program.base = install.base(assembly.store(program.settings), program.format)
        session = TeachingSession(
            self._recording,
            program.settings.teach,
            lambda by: install.command(program.lesson.options, by),
            say,
            codes=program.codes,
            base=program.base.bundle.manifest.labels if program.base else (),
            trained=program.trained,
        )
        if program.lesson.labels:
            session.admit(*program.lesson.labels)
        return session

    def _observers(self) -> list[Observer]:
        program, waits = self._program, self._program.lesson.waits
        settings, nothing = program.settings, {"bundle": "", "labels": []}
        facts: Facts = {
            "model": lambda: NOTHING,
            "recorded": lambda: self._recording.about()["missing"],
            "teach": self._session.about,
            "page": lambda: program.address,
        }
        runtime = settings.store.runtime_folder if waits.startswith("http") else None
        return [
            Notifier(SystemClock(), note=f"; {NOTHING}: {waits}" if waits else ""),
            *([HandOver(runtime, SystemClock())] if runtime else []),
            self._recording,
            self._session,
            *assembly.reports(settings, program.format, program.devices.source, nothing, facts),
        ]


class TryingPhase:
    """Classifies with the new bundle, on trial as in the service. `stack` closes it."""

    def __init__(self, program: TeachingProgram, stack: ExitStack) -> None:
        program.again = ""
        self._program, settings = program, program.settings
        choice = assembly.store(settings).choose()
        trial, disk = [stack.enter_context(choice.trial)] if choice.trial else [], DiskThread()
        for one in trial:
            one.disk = disk
        self._bundle, m = choice.bundle, choice.bundle.manifest
        means = class_distances(choice.bundle, settings.classifier.strangers)
        self._alike = means.closest_pair()[1:] if means else ()
        port = assembly.port(settings, program.devices, terminal=False)
        facts: Facts = {"model": lambda: f"{m.name} {m.version}, {m.taught}"}
        again = {"TEACH": self._teach_again}
        self.orders = {**again, "DONE": program.finish}
        known = {"bundle": choice.bundle.id, "labels": m.labels, "displays": m.displays}
        shown = assembly.reports(settings, m.format, program.devices.source, known, facts)
        self.box = assembly.box(
            *(settings, choice.bundle, program.devices, port, stack),
            observers=[disk, Notifier(SystemClock()), *trial, *shown, *program.pages],
            commands=program.by_robot(again),
            ordered=bool(program.pages),
        )

    def about(self) -> dict[str, Any]:
        m = self._bundle.manifest
        taught = m.taught or f"taught into it: {', '.join(self._bundle.enrolled)}"
        shown = {"model": f"{m.name} {m.version}", "labels": m.labels, "displays": m.displays}
        return {"trying": shown | {"taught": taught, "alike": self._alike}}

    def run(self) -> bool:
        """Run; returns whether more is to be taught."""
        program, box = self._program, self.box
        finished = program.devices.finished
        box.run(lambda: program.ended or bool(program.again) or finished(box.answered))
        return bool(program.again) and not program.ended

    def _teach_again(self, label: str) -> list[object]:
        label = label.strip()
        Labels(material=label)
        refuse_trained(self._program.trained, [label])
        if self._program.codes:
            labels = dict.fromkeys((*self._bundle.manifest.labels, label))
            labels.pop(NOT_THIS, None)
            check_bits(self._program.codes, [*labels])
        self._program.again = label
        return [label]


def _forbidden(_: str) -> list[object]:
    raise ApplianceError("the robot may not teach this box; set teach.serial = true to allow it")


FILE = "untaught"
"""In the folder of the status file; palpate-teach.path watches it."""
AFTER_NS = 20_000_000_000
"""Time until then. An installation or a delivery waits up to 10 s to see the service run; its end
for the sake of the page would look like a failure."""


class HandOver(Observer):
    """Writes the file in `folder` once, between two sweeps. clock: the real clock."""

    def __init__(self, folder: Path, clock: Clock) -> None:
        self._path, self._clock = folder / FILE, clock
        self._at_ns: int | None = clock.now_ns() + AFTER_NS

    def turn(self, health: Health) -> None:
        """Write it if it is time. A failure is logged: the robot can teach the box all the same."""
        if self._at_ns is None or health.sweeping or self._clock.now_ns() < self._at_ns:
            return
        self._at_ns = None
        try:
            storage.put(self._path, b"")
        except OSError as e:
            log.warning(f"teach: no page by itself: {self._path}: {e.strerror}")
