"""The box itself: one thread, one loop. In: sensor, trigger, recorder, classifier, sinks. Out: answers to all triggers.

Which parts these are is decided elsewhere (`__main__`); nothing here knows whether they are real.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from .classifier import Classifier
from .clock import Clock
from .config import Config
from .early import Decider
from .errors import ApplianceError
from .recorder import Recorder
from .sensor import Sensor, Tally
from .sink import Command, Port, ResultSink, sentence
from .sweep import Status, Sweep, SweepFormat, Verdict
from .trigger import Edge, Trigger

TARE_S = 0.5
"""How much of the latest signal a tare averages."""


class Panel(Protocol):
    """The lines that tell the robot how the box is."""

    def show(self, *, ready: bool, busy: bool, fault: bool, decided: bool = False) -> None:
        """Drive READY, BUSY, FAULT and DECIDED."""
        ...


class Tap(Protocol):
    """Takes note of what comes in beside frames, for captures."""

    def edges(self, t_ns: int, edges: list[Edge]) -> None:
        """Edges have settled."""
        ...

    def command(self, t_ns: int, name: str) -> None:
        """A command is about to be carried out."""
        ...


class Pulse(Protocol):
    """Whoever watches over the program: a turn that does not end is noticed by its silence."""

    def turn(self, ready: bool, status: str) -> None:
        """A turn of the loop is over. ready: the skin streams. status: how the box is, in words."""
        ...

    def stopping(self) -> None:
        """The loop has ended; what is open is being answered."""
        ...


@dataclass(frozen=True, slots=True)
class World:
    """What the drivers stand on. These are the real devices; the rig's world says otherwise.

    gpio: the module gpiod or its double. backend: a pyusb backend, None for libusb. source: as sentences name it.
    """

    clock: Clock
    gpio: Any
    backend: Any = None
    source: str = "usb"

    def wire(self, settings: Config) -> Config:
        """The configuration as it fits this world."""
        return settings

    def finished(self, answered: int) -> bool:
        """True when nothing more will happen; a robot never says so."""
        return False


class Box:
    """Turns triggers into verdicts. `step` is one turn of the loop: read, cut, classify, answer, listen.

    early: answers sweeps that still go on, or None. panel: READY, BUSY, FAULT, DECIDED, or None.
    port: where commands come from and state sentences go, or None.
    tap: takes note of edges and commands, for captures. keep: called with each sweep, for recordings.
    pulse: told at the end of each turn, or None.
    """

    def __init__(
        self, sensor: Sensor, trigger: Trigger, recorder: Recorder, classifier: Classifier, clock: Clock, *,
        early: Decider | None = None,
        sinks: Sequence[ResultSink] = (), port: Port | None = None, panel: Panel | None = None,
        state_s: float = 1.0, source: str = "usb", log: Callable[[str], None] = lambda line: None,
        tap: Tap | None = None, keep: Callable[[Sweep], None] | None = None, pulse: Pulse | None = None,
    ) -> None:  # fmt: skip
        self.answered = 0
        self._sensor, self._trigger, self._recorder, self._classifier = sensor, trigger, recorder, classifier
        self._early, self._clock, self._sinks, self._port, self._panel = early, clock, sinks, port, panel
        self._decided = False
        self._state_ns, self._source, self._log = round(state_s * 1e9), source, log
        self._tap, self._keep, self._pulse = tap, keep or (lambda sweep: None), pulse
        self._next_state_ns = clock.now_ns()
        self._troubles: dict[str, str] = {}

    @property
    def tally(self) -> Tally:
        """What the sensor has counted since the start."""
        return self._sensor.tally

    @property
    def format(self) -> SweepFormat:
        """The form of the sweeps that it takes."""
        return self._classifier.bundle.format

    def newest_frame(self) -> NDArray[Any] | None:
        """The newest frame [R, C] of digits, None before the first."""
        frames = self._recorder.latest(1)
        return None if frames is None else frames[0]

    def run(self, stopped: Callable[[], bool]) -> None:
        """Take turns until `stopped()`; what is open then is answered `aborted`."""
        while not stopped():
            self.step()
        if self._pulse:
            self._pulse.stopping()
        self._recorder.interrupt(Status.ABORTED, self._clock.now_ns())
        self._answer(self._recorder.finished(self._clock.now_ns()))

    def step(self) -> list[Verdict]:
        """One turn; takes at most the sensor's timeout. The verdicts that were sent."""
        frames = self._sensor.read()
        now = self._clock.now_ns()
        self._recorder.put(frames, now)
        # before the edges of this turn: a capture gives frames and edges in turns of their own
        verdicts = self._decide(now)
        edges = self._trigger.edges(now)
        if self._tap and edges:
            self._tap.edges(now, edges)
        self._recorder.trigger(edges, self._able, now)
        if self._sensor.state != "streaming":
            self._recorder.interrupt(Status.SENSOR_LOST, now)
        self._show()
        verdicts += self._answer(self._recorder.finished(now))
        self._report(now)
        self._beat()
        return verdicts

    @property
    def _able(self) -> bool:
        """True while a sweep could be taken."""
        return self._sensor.state == "streaming" and not self._trigger.blind

    def _show(self) -> None:
        sweeping, able = self._recorder.sweeping, self._able
        self._decided = self._decided and not sweeping
        if self._panel:
            self._panel.show(ready=able and not sweeping, busy=sweeping, fault=not able, decided=self._decided)

    def _decide(self, now_ns: int) -> list[Verdict]:
        """Answer the open sweep early, where that is wanted and possible."""
        if not self._early:
            return []
        for sweep in self._recorder.so_far(self._early.steps, now_ns):
            if verdict := self._early(sweep):
                self._recorder.settle()
                self._send(verdict)
                self._decided = True
                self._show()
                self._keep(sweep)
                return [verdict]
        return []

    def _answer(self, sweeps: list[Sweep]) -> list[Verdict]:
        verdicts = [self._classifier(sweep) for sweep in sweeps]
        for verdict in verdicts:
            self._send(verdict)
        for sweep in sweeps:  # a disk takes its time, so after all answers
            self._keep(sweep)
        return verdicts

    def _send(self, verdict: Verdict) -> None:
        for sink in self._sinks:
            sink.send(verdict)
        self.answered += 1

    def _report(self, now_ns: int) -> None:
        """Log what has changed, answer commands, say the state once in a while."""
        self._note("skin", str(self._sensor.trouble or ""), "streaming")
        if not self._port:
            return
        for command in self._port.commands():
            if self._tap and not command.error:
                self._tap.command(now_ns, command.name)
            self._port.say(self._obey(command))
        self._note("serial", self._port.trouble, "open")
        if now_ns >= self._next_state_ns:
            self._next_state_ns = now_ns + self._state_ns
            self._port.say(sentence("STA", *self._state()))

    def _beat(self) -> None:
        """The turn is over: frames came in or the skin's absence was told, edges were polled, answers are out."""
        if self._pulse:
            sensor = self._sensor
            skin = f"skin {sensor.state}: {sensor.trouble}" if sensor.trouble else f"skin {sensor.state}"
            streams = sensor.state == "streaming" and sensor.tally.frames > 0
            self._pulse.turn(streams, f"{skin}. Sweeps answered: {self.answered}")

    def _note(self, what: str, trouble: str, fine: str) -> None:
        if self._troubles.get(what) != trouble:
            self._troubles[what] = trouble
            self._log(f"{what}: {trouble or fine}")

    def _state(self) -> list[object]:
        """Fields of the STA sentence (PROTOCOL.md, part 2)."""
        tally = self._sensor.tally
        return [
            f"{self._clock.now_ns() / 1e9:.3f}", self._sensor.state, int(self._recorder.sweeping), self.answered,
            tally.frames, tally.lost_frames, tally.garbage_bytes, tally.enumerations,
            self._port.dropped if self._port else 0, self._classifier.bundle.id, self._source,
        ]  # fmt: skip

    def _obey(self, command: Command) -> bytes:
        """Carry out a command; its ANS sentence."""
        if command.error:
            return sentence("ANS", command.name, "error", command.error)
        try:
            return sentence("ANS", command.name, "ok", *_OBEY[command.name](self))
        except ApplianceError as e:
            return sentence("ANS", command.name, "error", e)

    def _identity(self) -> list[object]:
        m, who = self._classifier.bundle.manifest, self._sensor.identity
        skin = f"{who.board} {who.serial} {'.'.join(map(str, who.firmware))}" if who else "none"
        return [m.name, m.version, self._classifier.bundle.id, m.format, skin]

    def _self_test(self) -> list[object]:
        return [f"{len(self._classifier.bundle.golden)} golden sweeps differ by {self._classifier.self_test():.2g}"]

    def _tare(self) -> list[object]:
        """Take the mean of the latest signal as the unloaded skin."""
        frames = self._recorder.latest(max(1, round(TARE_S * self._classifier.bundle.format.rate_hz)))
        if frames is None or self._recorder.sweeping or self._sensor.state != "streaming":
            raise ApplianceError(f"tare needs {TARE_S} s of signal without loss and outside a sweep; try again")
        self._classifier.tare = frames.mean(axis=0, dtype=np.float64)
        return [f"largest {self._classifier.tare.max():.1f} digits"]

    def _new_object(self) -> list[object]:
        self._recorder.new_object()
        return []

    def _abort(self) -> list[object]:
        if not self._recorder.interrupt(Status.ABORTED, self._clock.now_ns()):
            raise ApplianceError("no sweep is open, so there is nothing to abort")
        return []


_OBEY: dict[str, Callable[[Box], list[object]]] = {
    "ID": Box._identity,
    "STATE": Box._state,
    "TEST": Box._self_test,
    "TARE": Box._tare,
    "NEW": Box._new_object,
    "ABORT": Box._abort,
}
