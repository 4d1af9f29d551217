"""The box itself: one thread, one loop. In: sensor, trigger, recorder, classifier, sinks. Out: answers to all triggers.

Which parts these are is decided elsewhere (`__main__`); nothing here knows whether they are real.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from types import MappingProxyType
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from appliance.core.clock import Clock
from appliance.core.errors import ApplianceError
from appliance.core.health import Health, HealthObserver
from appliance.core.types import Status, Sweep, SweepFormat, Verdict
from appliance.inference.classifier import Classifier
from appliance.inference.early_exit import Decider
from appliance.io.robot_link import Command, Port, ResultSink, sentence
from appliance.io.trigger import Edge, Trigger
from appliance.io.usb_sensor import Sensor, SensorCounters
from appliance.recording.sweep_window import SweepCutter
from appliance.service.journal import WARNING

TARE_S = 0.5
"""How much of the latest signal a tare averages."""


class Panel(Protocol):
    """The lines that tell the robot how the box is."""

    def show(self, *, ready: bool, busy: bool, fault: bool, decided: bool = False) -> None:
        """Drive READY, BUSY, FAULT and DECIDED."""
        ...


class InputObserver(Protocol):
    """Takes note of what comes in beside frames, for captures."""

    def edges(self, t_ns: int, edges: list[Edge]) -> None:
        """Edges have settled."""
        ...

    def command(self, t_ns: int, name: str) -> None:
        """A command is about to be carried out."""
        ...


SweepObserver = Callable[[Sweep, Verdict], None]
"""Takes a sweep with its verdict, after all answers of the turn are out. Must not raise: a full disk costs the record,
never the classifying."""


class Box:
    """Turns triggers into verdicts. `step` is one turn of the loop: read, cut, classify, answer, listen.

    early: answers sweeps that still go on, or None. panel: READY, BUSY, FAULT, DECIDED, or None.
    port: where commands come from and state sentences go, or None.
    tap: takes note of edges and commands, for captures. keepers: given each sweep with its verdict, for recordings.
    pulses: told at the end of each turn. obey: further commands, from their text to the fields of their answer; what
    they raise as ApplianceError is the answer.
    """

    def __init__(
        self, sensor: Sensor, trigger: Trigger, recorder: SweepCutter, classifier: Classifier, clock: Clock, *,
        early: Decider | None = None,
        sinks: Sequence[ResultSink] = (), port: Port | None = None, panel: Panel | None = None,
        state_s: float = 1.0, source: str = "usb", log: Callable[[str], None] = lambda line: None,
        tap: InputObserver | None = None, keepers: Sequence[SweepObserver] = (), pulses: Sequence[HealthObserver] = (),
        obey: Mapping[str, Callable[[str], list[object]]] = MappingProxyType({}),
    ) -> None:  # fmt: skip
        self.answered = 0
        self._sensor, self._trigger, self._recorder, self._classifier = sensor, trigger, recorder, classifier
        self._early, self._clock, self._sinks, self._port, self._panel = early, clock, sinks, port, panel
        self._decided = False
        self._state_ns, self._source, self._log = round(state_s * 1e9), source, log
        self._tap, self._keepers, self._pulses, self._more = tap, keepers, pulses, obey
        self._next_state_ns = clock.now_ns()
        self._troubles: dict[str, str] = {}

    @property
    def counters(self) -> SensorCounters:
        """What the sensor has counted since the start."""
        return self._sensor.counters

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
        for pulse in self._pulses:
            pulse.stopping()
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
        if self._pulses:
            health = self.health
            for pulse in self._pulses:
                pulse.turn(health)
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
                self._keep(sweep, verdict)
                return [verdict]
        return []

    def _answer(self, sweeps: list[Sweep]) -> list[Verdict]:
        verdicts = [self._classifier(sweep) for sweep in sweeps]
        for verdict in verdicts:
            self._send(verdict)
        for sweep, verdict in zip(sweeps, verdicts, strict=True):  # a disk takes its time, so after all answers
            self._keep(sweep, verdict)
        return verdicts

    def _keep(self, sweep: Sweep, verdict: Verdict) -> None:
        for keep in self._keepers:
            keep(sweep, verdict)

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
                self._tap.command(now_ns, command.line)
            self._port.say(self._obey(command))
        self._note("serial", self._port.trouble, "open")
        if now_ns >= self._next_state_ns:
            self._next_state_ns = now_ns + self._state_ns
            self._port.say(sentence("STA", *self._state()))

    def _note(self, what: str, trouble: str, fine: str) -> None:
        if self._troubles.get(what) != trouble:
            self._troubles[what] = trouble
            self._log(f"{WARNING if trouble else ''}{what}: {trouble or fine}")

    @property
    def health(self) -> Health:
        """How it is now."""
        sensor, counters = self._sensor, self._sensor.counters
        return Health(
            time_ns=self._clock.now_ns(), skin=sensor.state, trouble=str(sensor.trouble or ""),
            streams=sensor.state == "streaming" and counters.frames > 0, sweeping=self._recorder.sweeping,
            answered=self.answered, frames=counters.frames, lost_frames=counters.lost_frames,
            garbage_bytes=counters.garbage_bytes, enumerations=counters.enumerations,
            dropped=self._port.dropped if self._port else 0, bundle=self._classifier.bundle.id, source=self._source,
        )  # fmt: skip

    def circumstances(self) -> dict[str, Any]:
        """What a recorded sweep should tell beside its frames, as it is now: for JSON.

        device: the board's name, serial number and firmware, None before it was asked. clock: see DeviceClock.quality.
        tare: [R, C] digits.
        """
        who = self._sensor.identity
        return {
            "device": asdict(who) if who else None,
            "clock": self._sensor.clock,
            "tare": self._classifier.tare.tolist(),
            "bundle": self._classifier.bundle.id,
            "rule": self._classifier.rule,
            "source": self._source,
        }

    def _state(self) -> list[object]:
        """Fields of the STA sentence (PROTOCOL.md, part 2)."""
        h = self.health
        return [
            f"{h.time_ns / 1e9:.3f}", h.skin, int(h.sweeping), h.answered, h.frames, h.lost_frames, h.garbage_bytes,
            h.enumerations, h.dropped, h.bundle, h.source,
        ]  # fmt: skip

    def _obey(self, command: Command) -> bytes:
        """Carry out a command; its ANS sentence."""
        if command.error:
            return sentence("ANS", command.name, "error", command.error)
        try:
            return sentence("ANS", command.name, "ok", *self._carried_out(command))
        except ApplianceError as e:
            return sentence("ANS", command.name, "error", e)

    def _carried_out(self, command: Command) -> list[object]:
        if command.name in self._more:
            return self._more[command.name](command.text)
        if command.name not in _OBEY:
            raise ApplianceError("nothing is recorded now; use palpate record")
        return _OBEY[command.name](self)

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
