"""The page of `palpate record --web`: events of the loop for the page, and orders of the page for
the loop.

The loop carries out at most one order between two turns, like a command of the serial line. It
never waits for a browser.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from functools import lru_cache, partial
from queue import Empty, Full, Queue
from typing import Any, Self

from palpate.alignment.live import VIEW_NS, ContactTracker, Expected
from palpate.core.clock import Clock
from palpate.core.config import TriggerConfig
from palpate.core.errors import ApplianceError, FormatError, NoAnswer
from palpate.core.observer import Health, Observer
from palpate.core.sentences import Reply, future_of
from palpate.core.status import REASONS
from palpate.core.types import Frames, Sweep, SweepFormat, Verdict
from palpate.io.robot_link import PAIRS, Command
from palpate.sweeps.recording import Labels
from palpate.web.access import ROLES, Access
from palpate.web.server import PageServer
from palpate.web.sweep_picture import DrawnWindow, picture

MOST_WAITING = 16
"""Most commands that wait for the loop; further commands are refused at once."""
PERIOD_NS = 1_000_000_000
"""Time between two states of the recording without changes."""
LABELS = tuple(name.upper() for name in Labels.__slots__)
TEACHING, MATERIALS = ("TEACH", "USE", "FORGET", "DONE"), ("TEACH", "FORGET")
"""Commands of a page that teaches, and the commands with the name of a material."""
TRIGGERS = {
    "two-lines": "the robot's lines START and STOP",
    "one-line": "the robot's line START",
    "serial": "START and STOP, here or on the serial line",
    "key": "the space bar in the terminal of palpate record",
}
"""The trigger of sweeps in words."""

STATE = ("skin", "trouble", "sweeping", "ready", "due_ns", "frames")
"""Facts of the box that the page shows; a change of any but the last is shown at once."""
Obey = Callable[[Command], Reply]
"""Carries out a command. Raises ApplianceError."""


def order(body: bytes, allowed: Sequence[str], named: Callable[[str], str] = str.strip) -> Command:
    """The command in an order of a page, such as `{"command": "MATERIAL", "text": "wood"}`.
    allowed: names of commands. named: finds the label for the typed name of a material. Raises
    FormatError for other orders, and ConfigError, as the command itself does, for a label that
    cannot be used."""
    try:
        asked = json.loads(body)
    except (ValueError, RecursionError) as e:
        example = '{"command": "MATERIAL", "text": "wood"}'
        raise FormatError(f"an order is not JSON; send {example}") from e
    if not isinstance(asked, dict) or not asked.keys() <= {"command", "text"}:
        raise FormatError('an order holds "command" and "text" and nothing else; send these two')
    name, text = str(asked.get("command")), asked.get("text", "")
    if name not in allowed or not isinstance(text, str):
        raise FormatError(
            f"unknown order; the commands are {' '.join(allowed)}, each with a text or none"
        )
    text = text.strip()
    if name in (*LABELS, *MATERIALS):
        field = "material" if name in MATERIALS else name.lower()
        text = named(text) if field == "material" else text
        Labels(**{field: text})  # before a capture records the order
    elif name in PAIRS:
        what, _, typed = text.partition(",")
        text = f"{what},{Labels(named(typed.strip())).material}"
    elif text and not (name == "DISCARD" and text.isascii() and text.isdecimal()):
        raise FormatError(
            f"{name} takes no text, but for DISCARD the number of a sweep; leave it out"
        )
    return Command(name, text)


class CommandQueue:
    """Commands from the server's thread to the loop, and their answers."""

    def __init__(self) -> None:
        self._waiting: Queue[tuple[Command, Future[list[object]]]] = Queue(MOST_WAITING)

    def put(self, command: Command) -> Future[list[object]]:
        """Have a command carried out and return its answer. Raises NoAnswer if too many commands
        wait."""
        answer: Future[list[object]] = Future()
        try:
            self._waiting.put_nowait((command, answer))
        except Full:
            raise NoAnswer(
                f"{MOST_WAITING} commands wait already; try again when they are carried out"
            ) from None
        return answer

    def carry_out(self, obey: Obey) -> bool:
        """Carry out the next command that is still wanted, in the loop's thread. Returns whether
        there was a command."""
        try:
            while not (waiting := self._waiting.get_nowait())[1].set_running_or_notify_cancel():
                pass
        except Empty:
            return False
        command, answer = waiting
        try:
            future_of(obey(command)).add_done_callback(partial(_pass_on, answer))
        except ApplianceError as e:
            answer.set_exception(e)
        return True

    def refuse(self) -> None:
        while self.carry_out(_ended):
            pass


def _pass_on(answer: Future[list[object]], reply: Future[list[object]]) -> None:
    if e := reply.exception():
        answer.set_exception(e)
    else:
        answer.set_result(reply.result())


def _ended(_: Command) -> list[object]:
    raise NoAnswer("the recording has ended; this was not carried out")


class RecordPage(Observer):
    """The page of a recording at `access`. It is served within its `with` block.

    format: of the sweeps. source: of the frames. trigger: its settings. about: see
    RecordingSession.about. obey: carries out the orders of the page, in the loop's thread. clock:
    the host's real clock. unit: of the skin's profile. named: as for `order`. teaching: it is the
    page of `palpate teach`. Raises ConfigError if the address cannot be used.
    """

    def __init__(
        self,
        access: Access,
        format: SweepFormat,
        source: str,
        trigger: TriggerConfig,
        about: Callable[[], Mapping[str, Any]],
        obey: Obey,
        clock: Clock,
        unit: str = "",
        named: Callable[[str], str] = str.strip,
        *,
        teaching: bool = False,
    ) -> None:
        self._about, self._obey, self._clock, self._named = about, obey, clock, named
        self._tracker = ContactTracker(Expected(format, unit=unit), source)
        self._rate_hz = format.rate_hz
        by_page = ("START", "STOP") if trigger.mode == "serial" else ()
        taught = TEACHING if teaching else ()
        self._commands = (*LABELS, "NEXT", "DISCARD", *PAIRS, "UNDO", *by_page, *taught)
        self._known = {
            "source": source,
            "format": str(format),
            "unit": unit,
            "trigger": trigger_words(trigger),
            "commands": self._commands,
        }
        self._queue = CommandQueue()
        self._window: DrawnWindow | None = None
        self._picture = lru_cache(1)(lambda window: picture(window))
        self._enumerations = 0
        self._state: tuple[object, ...] = ()
        self._state_ns = self._view_ns = clock.now_ns()
        name, answers = f"{'teach' if teaching else 'record'}.html", {"sweep": self._shown}
        self.server = PageServer(name, access, clock.now_ns, {}, answers, self._ordered)

    def __enter__(self) -> Self:
        self.server.__enter__()
        return self

    def __exit__(self, *reason: object) -> None:
        self._queue.refuse()
        self.server.__exit__(*reason)

    def frames(self, frames: Frames) -> None:
        """Keep the newest frames for the picture of the skin, if a browser is connected."""
        if self.server.watched:
            self._tracker.put(frames.taxels)

    def sweep(self, sweep: Sweep, verdict: Verdict, circumstances: Mapping[str, Any]) -> None:
        """Show the result of a sweep, after the recording has stored it."""
        taxels = sweep.frames.taxels
        self._window = DrawnWindow(sweep.id, self._rate_hz, taxels) if len(taxels) else None
        self.server.publish(
            "sweep",
            {
                "sweep": sweep.id,
                "time_ns": self._clock.now_ns(),
                "status": verdict.status,
                "label": verdict.label,
                "probability": round(verdict.probability, 4),
                "signal": bool(self._window),
                "reason": REASONS.get(verdict.status, ""),
                "detail": verdict.detail,
                "lost": verdict.lost,
                "faulty": verdict.status.faulty,
            },
        )
        self._state = ()

    def turn(self, health: Health) -> None:
        """Carry out a command, and show the changes."""
        self._queue.carry_out(self._obey)
        now_ns = self._clock.now_ns()
        if health.enumerations != self._enumerations:
            self._enumerations = health.enumerations
            self._tracker.reset()
        state = tuple(getattr(health, name) for name in STATE[:-1])
        if state != self._state or now_ns - self._state_ns >= PERIOD_NS:
            self._state, self._state_ns = state, now_ns
            self.server.publish(
                "recording",
                {
                    **self._known,
                    **self._about(),
                    "time_ns": now_ns,
                    **{name: getattr(health, name) for name in STATE},
                    "lost_frames": health.lost_frames if health.loss_known else None,
                },
            )
        if self.server.watched and now_ns - self._view_ns >= VIEW_NS:
            self._view_ns = now_ns
            self.server.show(self._tracker.view(health.skin, health.trouble))

    def _ordered(self, body: bytes, role: str) -> Future[list[object]]:
        command = order(body, self._commands, self._named)
        needed = "teach" if command.name in TEACHING else "operate"
        if ROLES.index(role) < ROLES.index(needed):
            may = f"{command.name} is not for the role {role}"
            raise ApplianceError(f"{may}; open enter.html, and give the token of {needed}")
        answer = self._queue.put(command)
        answer.add_done_callback(self._show_soon)
        return answer

    def _show_soon(self, _: object) -> None:
        self._state = ()

    def _shown(self, which: str) -> dict[str, Any] | None:
        """The picture of the last sweep, if it has this number. It is computed once."""
        window = self._window
        return self._picture(window) if window and window.sweep == int(which) else None


def trigger_words(trigger: TriggerConfig) -> str:
    if trigger.mode == "timed":
        return f"the clock: {trigger.sweep_s:g} s in every {trigger.every_s:g} s"
    return TRIGGERS[trigger.mode]
