"""A client of the box for the robot's computer, over the serial line.

with Palpate("/dev/ttyUSB0") as box:
    box.wait_ready(timeout_s=10)
    box.start()                          # trigger.mode = "serial"; else the robot's GPIO lines
    ...                                  # slide
    box.stop()
    answer = box.result(timeout_s=2)
    print(answer.label if answer.known else answer.what_to_do)
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, Self

from palpate.client.answers import Answer, BoxIdentity, BoxState
from palpate.client.line import Line, open_port
from palpate.core.clock import Clock, SystemClock
from palpate.core.errors import CommandRefused, FormatError, LinkLost, NoAnswer
from palpate.core.sentences import MOST_FINGERS, Sentence, sentence

BAUD = 115200
KEPT = 256
"""Most answers that wait for `result`; then the oldest is dropped. It counts as missed, unless a
listener has heard it."""
POLL_S, QUESTION_S = 0.2, 1.0
"""Time between two questions of `wait_ready`, and for the answer to a question. A box that is
starting does not receive earlier ones."""

Heard = Answer | BoxState


class Palpate:
    """The box at the other end of a serial line. Threads may share it.

    port: a serial device, a pseudo-terminal, or `socket://host:port`. timeout_s: longest wait for
    the answer to a command. listener: is called with each answer and each state, in the reading
    thread. opener: opens the port, for tests and for other kinds of ports.

    trouble: the reason why the line is not open, "" if it is. missed: number of lost answers.
    damaged: number of damaged sentences; `damage` describes the last. restarts: how often the box's
    program has started again. All questions and waits have a deadline. A line that is lost ends a
    wait with LinkLost, and is opened again.
    """

    def __init__(
        self,
        port: str,
        *,
        baud: int = BAUD,
        timeout_s: float = 3.0,
        listener: Callable[[Heard], None] | None = None,
        opener: Callable[[], Any] | None = None,
        clock: Clock | None = None,
    ) -> None:
        self.missed = self.damaged = self.restarts = 0
        self.damage = ""
        self.newest: BoxState | None = None
        self._timeout_s, self._listener, self._clock = timeout_s, listener, clock or SystemClock()
        self._heard_ns = 0
        self._news = threading.Condition()
        self._asking = threading.Lock()
        self._replies: deque[list[str]] = deque(maxlen=KEPT)
        self._answers: deque[Answer] = deque()
        self._fingers: deque[Answer] = deque(maxlen=MOST_FINGERS)  # of the next answer
        # the number of the newest answer, numbers of missing answers before it, and the count of
        # answers in the last STA
        self._sweep: int | None = None
        self._absent: set[int] = set()
        self._answered: int | None = None
        self._line = Line(
            opener or partial(open_port, port, baud),
            self._on_sentence,
            self._on_change,
            name=port,
            clock=self._clock,
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def close(self) -> None:
        self._line.close()

    @property
    def trouble(self) -> str:
        return self._line.trouble

    def silent_s(self) -> float:
        """Time since the last sentence; infinite before the first. The box sends one each
        second."""
        return (self._clock.now_ns() - self._heard_ns) / 1e9 if self._heard_ns else float("inf")

    def wait_ready(self, timeout_s: float) -> BoxState:
        """Wait until a sweep can begin, and drop answers that `result` has not returned.

        Raises NoAnswer with the reason if that takes longer. A line that is not there yet is waited
        for as well.
        """
        end_ns = self._end_ns(timeout_s)
        while True:
            try:
                # the last question also gets time for its answer
                state = self.state(
                    min(self._timeout_s, QUESTION_S, max(POLL_S, self._left_s(end_ns)))
                )
                if state.ready:
                    self.forget()
                    return state
                why = (
                    f"a sweep is open (skin {state.skin})"
                    if state.sweeping
                    else f"the skin is {state.skin}"
                )
            # a bridge refuses while its own line is gone
            except (LinkLost, NoAnswer, CommandRefused) as e:
                why = str(e)
            with self._news:
                self._news.wait(min(POLL_S, max(0.0, self._left_s(end_ns))))
            if self._left_s(end_ns) <= 0:
                raise NoAnswer(f"not ready within {timeout_s:g} s: {why}; look at the box")

    def start(self, *, speed_mm_s: float | None = None, force_n: float | None = None) -> None:
        """Begin a sweep by command (trigger.mode = "serial"), and drop answers that `result` has
        not returned.

        speed_mm_s, force_n: of the slide, None if unknown; sent with six decimals. The box stores
        them with the sweep. Raises CommandRefused for a value that the box refuses.
        """
        self.forget()
        self.ask("START", *_decimals(speed_mm_s, force_n))

    def stop(self) -> None:
        """End the sweep by command. After an early answer nothing else follows."""
        self.ask("STOP")

    def new_object(self) -> None:
        """The next sweeps are of another object; from now on, sweeps of one object are fused."""
        self.ask("NEW")

    def abort(self) -> None:
        """End the open sweep; it is answered `aborted`."""
        self.ask("ABORT")

    def tare(self) -> str:
        """Take the last half second as the unloaded skin; returns the box's message."""
        return ",".join(self.ask("TARE"))

    def state(self, timeout_s: float | None = None) -> BoxState:
        return BoxState.of(self.ask("STATE", timeout_s=timeout_s))

    def identify(self) -> BoxIdentity:
        return BoxIdentity.of(self.ask("ID"))

    def labels(self) -> tuple[str, ...]:
        """The labels of the bundle; the code of a label on the class bits is its index + 1."""
        found: list[str] = []
        count = 1
        while len(found) < count:
            wanted = str(len(found) + 1)
            fields = self.ask("LABEL", wanted)
            if len(fields) != 3 or fields[0] != wanted or not fields[2].isdecimal():
                raise FormatError(
                    f"label {wanted} was answered {','.join(fields)}; update box or client"
                )
            found, count = [*found, fields[1]], int(fields[2])
        return tuple(found)

    def forget(self) -> None:
        """Drop answers that `result` has not returned."""
        with self._news:
            self._answers.clear()

    def result(self, timeout_s: float) -> Answer:
        """The oldest answer that was not returned yet; waits for it.

        Raises NoAnswer if none comes in time, and LinkLost at once if the line is lost, since the
        answer is then lost too.
        """
        with self._news:
            losses = self._line.losses
            self._news.wait_for(
                lambda: self._answers or self._line.trouble or self._line.losses != losses,
                max(0.0, timeout_s),
            )
            if self._answers:
                return self._answers.popleft()
            if self._line.trouble or self._line.losses != losses:
                raise LinkLost(
                    self._line.trouble
                    or "the line was lost meanwhile, and is open again; ask once more"
                )
        raise NoAnswer(f"no answer to a sweep within {timeout_s:g} s; {self._why_silent()}")

    def ask(self, name: str, *texts: str, timeout_s: float | None = None) -> list[str]:
        """Send a command; the fields of its answer. Text after a comma in `name` is the first of
        `texts`.

        Raises CommandRefused with the box's reason, NoAnswer if it does not answer in time,
        LinkLost if the line is not open or is lost.
        """
        name, *given = name.split(",")  # as a person writes it; the box answers with the name alone
        wait_s = self._timeout_s if timeout_s is None else timeout_s
        end_ns = self._end_ns(wait_s)
        if not self._asking.acquire(timeout=max(0.0, wait_s)):
            raise NoAnswer(
                f"{name} was not sent within {wait_s:g} s: another command is under way; "
                "wait longer"
            )
        try:
            with self._news:
                self._replies.clear()
                losses = self._line.losses
            self._line.write(sentence(name, *given, *texts))
            with self._news:
                while True:
                    self._news.wait_for(
                        lambda: self._replies or self._line.losses != losses,
                        max(0.0, self._left_s(end_ns)),
                    )
                    if self._line.losses != losses:
                        raise LinkLost(
                            f"{name}: {self._line.trouble or 'the line was lost meanwhile'}; "
                            "ask once more"
                        )
                    if not self._replies:
                        raise NoAnswer(
                            f"no answer to {name} within {wait_s:g} s; {self._why_silent()}"
                        )
                    answered, outcome, *fields = [*self._replies.popleft(), "", ""]
                    if answered in (name, "") and outcome == "error":
                        raise CommandRefused(f"{name}: {','.join(fields[:-2])}")
                    if answered == name and outcome == "ok":
                        return fields[:-2]
        finally:
            self._asking.release()

    def _end_ns(self, timeout_s: float) -> int:
        return self._clock.now_ns() + round(timeout_s * 1e9)

    def _left_s(self, end_ns: int) -> float:
        return (end_ns - self._clock.now_ns()) / 1e9

    def _why_silent(self) -> str:
        heard = (
            f"the last sentence came {self.silent_s():.1f} s ago"
            if self._heard_ns
            else "nothing was ever heard"
        )
        hurt = f", {self.damaged} were damaged ({self.damage})" if self.damaged else ""
        return f"{heard}{hurt}; is the box on, and does the line carry both ways?"

    def _on_change(self) -> None:
        with self._news:
            self._news.notify_all()

    def _on_sentence(self, heard: Sentence) -> None:
        """Sort a sentence in; runs in the thread of the line."""
        news: Heard | None = None
        with self._news:
            try:
                if heard.error or not heard.summed:
                    raise FormatError(
                        heard.error or f"{heard.kind} came without a checksum; look at the cable"
                    )
                self._heard_ns = self._clock.now_ns()
                if heard.kind == "ANS":
                    self._replies.append(heard.fields)
                elif heard.kind == "STA":
                    news = self.newest = self._counted_state(BoxState.of(heard.fields))
                elif heard.kind == "FIN":
                    self._fingers.append(Answer.of_finger(heard.fields))
                elif heard.kind == "RES":
                    news = self._counted(self._whole(Answer.of(heard.fields)))
                    self._keep(news)
            except FormatError as e:
                self.damaged += 1
                self.damage = str(e)
            self._news.notify_all()
        if news and self._listener:
            self._listener(news)

    def _whole(self, answer: Answer) -> Answer:
        """The answer with the answers of its fingers, which came before it."""
        fingers = tuple(f for f in self._fingers if f.sweep == answer.sweep)
        self._fingers.clear()
        return replace(answer, fingers=fingers)

    def _counted(self, answer: Answer) -> Answer:
        """The answer with the number of answers that are missing before it, as each sweep gets
        exactly one."""
        # it waited for late frames while the next sweep was answered at once
        if answer.sweep in self._absent:
            self._absent.remove(answer.sweep)
            self.missed -= 1
            return answer
        if self._sweep is not None and answer.sweep <= self._sweep:
            self._began_anew(0)
        absent = range(answer.sweep if self._sweep is None else self._sweep + 1, answer.sweep)
        self._absent = {*absent[-KEPT:]}
        self._sweep = answer.sweep
        self.missed += len(absent)
        return replace(answer, missed=len(absent))

    def _counted_state(self, state: BoxState) -> BoxState:
        """The state. A smaller count of answers than before means that the box's program has
        started again."""
        if self._answered is not None and state.answered < self._answered:
            self._began_anew(state.answered)
            self.missed += state.answered
        elif self._sweep is None:
            self._sweep = state.answered
        self._answered = state.answered
        return state

    def _began_anew(self, sweep: int) -> None:
        """The box's program has started again, and has answered this many sweeps since."""
        self.restarts += 1
        self._sweep, self._answered, self._absent = sweep, None, set()

    def _keep(self, answer: Answer) -> None:
        if len(self._answers) >= KEPT:
            self._answers.popleft()
            self.missed += self._listener is None
        self._answers.append(answer)


def _decimals(*values: float | None) -> list[str]:
    """The values as fields of a sentence, without exponents, since the box reads none. Empty fields
    at the end are left out."""
    texts = ["" if v is None else f"{v:.6f}".rstrip("0").rstrip(".") for v in values]
    while texts and not texts[-1]:
        texts.pop()
    return texts
