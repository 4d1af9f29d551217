"""The loop of the box, in one thread: from frames, edges and commands to verdicts, states and
answers.

`assembly` chooses the devices. The loop does not depend on whether they are real or simulated.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future
from contextlib import suppress
from types import MappingProxyType
from typing import Any

from numpy.typing import NDArray

from palpate.core.clock import Clock
from palpate.core.errors import ApplianceError, ModelError
from palpate.core.log import TroubleLog, log
from palpate.core.observer import Health, Observer
from palpate.core.sentences import CommandHandler, Reply, future_of, sentence
from palpate.core.types import Edge, Status, Sweep, SweepFormat, Verdict, entries
from palpate.inference.classifier import Classifier, EarlyExit
from palpate.io.gpio_lines import Lines
from palpate.io.robot_link import Command, Port, result
from palpate.io.sensor import Sensor, SensorCounters
from palpate.io.trigger import Trigger
from palpate.sweeps.sweep_check import SweepCheck
from palpate.sweeps.sweep_window import SweepCutter

TARE_S = 0.5
"""Length of the latest signal that a tare averages."""
FAILURES, SOUND = 3, 20
"""The program ends after this many `failed` sweeps, each less than SOUND sweeps after the last. It
is started again, and the end counts against a bundle on trial."""
LEAST_NS, QUICK_NS, PAUSES = 1_000_000, 20_000_000, 30
"""Shortest and longest answer that is rehearsed, and the pause after it in lengths of an answer."""
EVENTS = ("frames", "triggered", "command", "answered", "sweep", "turn", "stopping")
"""The methods of an Observer."""


Answerer = Classifier | SweepCheck
"""Gives each sweep its verdict: with a bundle, or without."""


class Box:
    """Turns triggers into verdicts. `step` is one turn of the loop: read, cut, classify, answer,
    listen.

    early: answers unfinished sweeps, or None. port: sends verdicts and state sentences and receives
    commands, or None. lines: READY, BUSY, FAULT, DECIDED, or None. serving: whether READY may rise.
    observers: called in this order, after the port. commands: further commands by name. source:
    origin of the frames, as in sentences. state_s: time between two state sentences."""

    def __init__(
        self,
        sensor: Sensor,
        trigger: Trigger,
        cutter: SweepCutter,
        answerer: Answerer,
        clock: Clock,
        *,
        early: EarlyExit | None = None,
        port: Port | None = None,
        lines: Lines | None = None,
        serving: bool = True,
        observers: Sequence[Observer] = (),
        commands: Mapping[str, CommandHandler] = MappingProxyType({}),
        source: str = "usb",
        state_s: float = 1.0,
    ) -> None:
        self.answered = 0
        self._unanswered: deque[Sweep] = deque()  # cut, but not sent yet
        self._asked: deque[Command] = deque()  # commands that were not carried out yet
        self._owed: list[tuple[str, Future[list[object]]]] = []  # commands without an answer yet
        self._edges: list[Edge] = []  # edges that the cutter has not taken yet
        self._failures, self._sound, self._failure = 0, 0, ""
        self._took_ns, self._rehearsal_ns = QUICK_NS, 0
        self._sensor, self._trigger, self._cutter = sensor, trigger, cutter
        self._answerer, self._early = answerer, early
        self._clock, self._port, self._commands = clock, port, commands
        self._lines, self._serving = lines, serving
        self._source, self._state_ns = source, round(state_s * 1e9)
        # only overridden methods of observers are called, so nothing is computed in vain
        self._on: dict[str, list[Callable[..., None]]] = {
            event: [
                getattr(o, event)
                for o in observers
                if getattr(type(o), event) is not getattr(Observer, event)
            ]
            for event in EVENTS
        }
        self._decided = False
        self._next_state_ns = self._turn_ns = clock.now_ns()
        self._skin_log = TroubleLog("skin", end="skin: streaming", known=False)
        self._observer_log = TroubleLog("a part of the program failed", "the answers go on")
        self._early_log = TroubleLog("early answers failed", "the whole sweeps are answered")
        self._port_log = TroubleLog(
            "serial", end=f"serial: {port.name} open" if port else "", known=False
        )

    @property
    def counters(self) -> SensorCounters:
        return self._sensor.counters

    @property
    def format(self) -> SweepFormat:
        return self._answerer.format

    def newest_frame(self) -> NDArray[Any] | None:
        """The newest frame [R, C] or [R, C, A] of raw counts, None before the first."""
        frames = self._cutter.latest(1)
        return None if frames is None else frames[0]

    def run(self, stopped: Callable[[], bool]) -> None:
        """Take turns until `stopped()`; at the end answer an open sweep with `aborted`."""
        try:
            while not stopped():
                self.step()
            self._notify("stopping")
        finally:
            self._end()

    def step(self) -> list[Verdict]:
        """One turn, which takes at most the sensor's timeout. Returns the verdicts that were sent.
        Raises ModelError after FAILURES sweeps that could not be classified; they are answered."""
        frames = self._sensor.read()
        now = self._turn_ns = self._clock.now_ns()
        self._cutter.put(frames, now)
        if len(frames):
            self._notify("frames", frames)
        # before the edges of this turn: a capture gives frames and edges in turns of their own
        verdicts = self._decide(now)
        self._take_edges(now, ready=self._able)
        if self._sensor.state != "streaming":
            self._cutter.interrupt(Status.SENSOR_LOST, now)
        self._show()
        verdicts += self._answer(self._cutter.finished(now))
        self._report(now)
        if self._on["turn"]:
            self._notify("turn", self.health)
        if self._failures >= FAILURES:
            raise ModelError(
                f"{self._failures} sweeps could not be classified: {self._failure}; "
                "look at the log, and go back by `palpate rollback`"
            )
        return verdicts

    def _take_edges(self, now_ns: int, *, ready: bool) -> None:
        self._edges += self._trigger.edges(now_ns)
        # first into the cutter: no edge may be lost between the two, whatever fails
        self._cutter.trigger(self._edges, ready, now_ns)
        edges, self._edges = self._edges, []
        if edges:
            self._notify("triggered", now_ns, edges)

    def _end(self) -> None:
        """Answer each open sweep, whatever has failed; a failed step is tried twice."""
        now = self._turn_ns
        for what, act in (
            ("the last commands", self._obey_asked),
            ("the last edges", lambda: self._take_edges(self._clock.now_ns(), ready=True)),
            ("the open sweep", lambda: self._abort_all(now)),
        ):
            _succeeds(what, act) or _succeeds(what, act)
        for _ in range(len(self._unanswered) + 1):
            _succeeds("the last answers", lambda: self._send_aborted(now))

    def _abort_all(self, now_ns: int) -> None:
        self._cutter.interrupt(Status.ABORTED, now_ns)
        self._unanswered.extend(self._cutter.finished(now_ns))

    def _send_aborted(self, now_ns: int) -> None:
        while self._unanswered:
            sweep = self._unanswered[0]
            verdict = self._aborted(sweep, now_ns)
            self._send(verdict)
            self._pass_on([sweep], [verdict])

    def _aborted(self, sweep: Sweep, now_ns: int) -> Verdict:
        """The answer to a sweep that was cut but not classified."""
        status = Status.ABORTED if sweep.status is Status.OK else sweep.status
        return Verdict.of(sweep, status, now_ns, self._answerer.model)

    def _notify(self, event: str, *content: Any) -> None:
        """Call the observers. Only expected errors of the outputs stop the loop."""
        for call in self._on[event]:
            try:
                call(*content)
            except ApplianceError:
                raise
            except Exception as e:
                of = getattr(call, "__qualname__", call)
                self._observer_log.update(f"{of}: {type(e).__name__}: {e}")

    @property
    def _able(self) -> bool:
        return self._sensor.state == "streaming" and not self._trigger.blind

    def _show(self) -> None:
        sweeping, able = self._cutter.sweeping, self._able
        self._decided = self._decided and not sweeping
        if self._lines:
            ready = self._serving and able and not sweeping
            self._lines.show(ready=ready, busy=sweeping, fault=not able, decided=self._decided)

    def _decide(self, now_ns: int) -> list[Verdict]:
        """Answer the open sweep early, if the settings allow it and the bundle can."""
        self._rehearse(now_ns)
        if not self._early:
            return []
        for sweep in self._cutter.so_far(self._early.steps, now_ns):
            if verdict := self._early_verdict(self._early, sweep):
                self._cutter.settle()
                self._unanswered.append(sweep)
                self._send(verdict)
                self._decided = True
                self._show()
                self._pass_on([sweep], [verdict])
                return [verdict]
        return []

    def _rehearse(self, now_ns: int) -> None:
        """Compute an answer in vain while the open sweep may end. Code and tables that were not
        used for seconds have left the processor's caches, and an answer takes twice as long."""
        due = self._took_ns < QUICK_NS and now_ns >= self._rehearsal_ns
        if due and self._cutter.may_end(now_ns):
            self._rehearsal_ns = now_ns + PAUSES * max(self._took_ns, LEAST_NS)
            with suppress(Exception):  # the sweep's own answer will say it
                self._answerer.rehearse()

    def _early_verdict(self, early: EarlyExit, sweep: Sweep) -> Verdict | None:
        try:
            verdict = early(sweep)
        except Exception as e:  # the classes of onnxruntime have no other base in common
            self._early_log.update(f"{type(e).__name__}: {e}")
            return None
        self._early_log.update("")
        return verdict

    def _answer(self, sweeps: list[Sweep]) -> list[Verdict]:
        self._unanswered.extend(sweeps)
        verdicts = [self._classified(sweep) for sweep in sweeps]
        for verdict in verdicts:
            self._send(verdict)
        self._pass_on(sweeps, verdicts)
        return verdicts

    def _classified(self, sweep: Sweep) -> Verdict:
        """The verdict on one sweep; `failed` with the reason if it cannot be computed."""
        try:
            verdict = self._answerer(sweep)
            self._took_ns = verdict.latency_ns
        except Exception as e:  # as in _early_verdict
            self._failures, self._sound = self._failures + 1, 0
            self._failure = str(e) or type(e).__name__
            now_ns, model = self._clock.now_ns(), self._answerer.model
            return Verdict.of(sweep, Status.FAILED, now_ns, model, detail=self._failure)
        self._sound += sweep.status is Status.OK
        if self._sound >= SOUND:
            self._failures = self._sound = 0
        return verdict

    def _pass_on(self, sweeps: Iterable[Sweep], verdicts: Sequence[Verdict]) -> None:
        """Give answered sweeps to their observers, after all answers: disks are slow."""
        if not (verdicts and self._on["sweep"]):
            return
        circumstances = self.circumstances()
        for sweep, verdict in zip(sweeps, verdicts, strict=True):
            self._notify("sweep", sweep, verdict, circumstances)

    def _send(self, verdict: Verdict) -> None:
        if self._port:
            known = self._sensor.loss_known
            self._port.say(result(verdict, self._source, loss_known=known))
        if self._unanswered:
            self._unanswered.popleft()
        self.answered += 1
        self._notify("answered", verdict)

    def _report(self, now_ns: int) -> None:
        """Log changes, answer commands, and send the state every `state_s`."""
        trouble = str(self._sensor.trouble or "")
        if trouble or self._sensor.state == "streaming":  # not before its first frame
            self._skin_log.update(trouble)
        if not self._port:
            return
        self._asked.extend(self._port.commands())
        self._obey_asked()
        self._port_log.update(self._port.trouble)
        if now_ns >= self._next_state_ns:
            self._next_state_ns = now_ns + self._state_ns
            self._port.say(sentence("STA", *self._state()))

    @property
    def health(self) -> Health:
        sensor = self._sensor
        return Health(
            time_ns=self._clock.now_ns(),
            skin=sensor.state,
            trouble=str(sensor.trouble or ""),
            streams=sensor.state == "streaming",
            sweeping=self._cutter.sweeping,
            answered=self.answered,
            dropped=self._port.dropped if self._port else 0,
            bundle=self._answerer.model,
            source=self._source,
            loss_known=sensor.loss_known,
            ready=self._able and not self._cutter.sweeping,
            degraded=self._answerer.degraded,
            due_ns=self._trigger.due_ns,
            **entries(sensor.counters),
            **entries(self._trigger.edge_counters),
        )

    def circumstances(self) -> dict[str, Any]:
        """The present entries for the sidecar of a recorded sweep, for JSON.

        device: the readout board's name, serial number and firmware, None before it was asked.
        clock: see DeviceClock.quality. trigger: see Trigger.about. loss_known: whether lost frames
        can be detected.
        """
        who = self._sensor.identity
        return {
            "device": entries(who) if who else None,
            "clock": self._sensor.clock,
            "loss_known": self._sensor.loss_known,
            "trigger": self._trigger.about,
            "source": self._source,
            **self._answerer.about(),
        }

    def _state(self) -> list[object]:
        """Fields of the STA sentence (PROTOCOL.md, part 2)."""
        h = self.health
        counts = h[h._fields.index("answered") : h._fields.index("storms") + 1]
        return [f"{h.time_ns / 1e9:.3f}", h.skin, int(h.sweeping), *counts, *_last_fields(h)]

    def _obey_asked(self) -> None:
        """Carry out the commands, and answer all that are done, also of earlier turns."""
        self._say_owed()
        while self._port and self._asked:
            command = self._asked.popleft()
            self._owed.append((command.name, self._begun(command)))
            self._say_owed()

    def _say_owed(self) -> None:
        for owed in [owed for owed in self._owed if owed[1].done()]:
            self._owed.remove(owed)
            if self._port:
                self._port.say(_answer(*owed))

    def _begun(self, command: Command) -> Future[list[object]]:
        """Carry out a command of the serial line."""
        try:
            if command.error:
                raise ApplianceError(command.error)
            return future_of(self.obey(command))
        except Exception as e:  # also an unexpected error: the robot waits for an answer
            reply: Future[list[object]] = Future()
            reply.set_exception(e)
            return reply

    def obey(self, command: Command) -> Reply:
        """Carry out a command of any origin. To be called between two turns or in an observer's
        `turn`. Raises ApplianceError with the reason for a refusal."""
        self._notify("command", self._turn_ns, command.line)
        if command.name in self._commands:
            return self._commands[command.name](command.text)
        if command.name in ("START", "STOP"):
            raise ApplianceError("sweeps are triggered otherwise; set trigger.mode to serial")
        if command.name not in _COMMANDS:
            raise ApplianceError("nothing is recorded now; use palpate record")
        return _COMMANDS[command.name](self)

    def _identity(self) -> list[object]:
        who = self._sensor.identity
        skin = f"{who.board} {who.serial} {'.'.join(map(str, who.firmware))}" if who else "none"
        return [*self._answerer.describe(), skin]

    def _self_test(self) -> list[object]:
        return [self._answerer.test()]

    def _tare(self) -> list[object]:
        """Take the mean of the latest signal as the unloaded skin."""
        frames = self._cutter.latest(max(1, round(TARE_S * self.format.rate_hz)))
        if frames is None or self._cutter.sweeping or self._sensor.state != "streaming":
            raise ApplianceError(
                f"tare needs {TARE_S} s of signal without loss and outside a sweep; try again"
            )
        return [self._answerer.set_tare(frames)]

    def _new_object(self) -> list[object]:
        self._cutter.new_object()
        return []

    def _abort(self) -> list[object]:
        if not self._cutter.interrupt(Status.ABORTED, self._clock.now_ns()):
            raise ApplianceError("no sweep is open, so there is nothing to abort; send START first")
        return []


def _succeeds(what: str, act: Callable[[], object]) -> bool:
    """Whether `act` raises no exception; one is logged, and the next step is done as well."""
    try:
        act()
    except Exception as e:
        log.error(f"{what}: {type(e).__name__}: {e}")
        return False
    return True


def _answer(name: str, reply: Future[list[object]]) -> bytes:
    if e := reply.exception():
        return sentence("ANS", name, "error", str(e) or type(e).__name__)
    return sentence("ANS", name, "ok", *reply.result())


def _last_fields(h: Health) -> list[object]:
    """The fields of STA that are often missing: unseen losses, and broken taxels."""
    if h.degraded:
        return ["" if h.loss_known else 1, h.degraded]
    return [] if h.loss_known else [1]


_COMMANDS: dict[str, Callable[[Box], list[object]]] = {
    "ID": Box._identity,
    "STATE": Box._state,
    "TEST": Box._self_test,
    "TARE": Box._tare,
    "NEW": Box._new_object,
    "ABORT": Box._abort,
}
