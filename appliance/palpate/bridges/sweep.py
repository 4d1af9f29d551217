"""A sweep by command, from START to its answer, for bridges that offer it as one call."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from typing import Protocol

from palpate.bridges.source import STALE_S
from palpate.client.answers import Answer
from palpate.client.box import Palpate
from palpate.core.clock import Clock, SystemClock
from palpate.core.errors import ApplianceError, CommandRefused, ConfigError, LinkLost, NoAnswer
from palpate.core.status import Status

READY_S = 3.0
"""Longest wait until the box is ready for START."""
ABORTED_S = 2.0
"""Longest wait for the answer to an aborted sweep."""
TURN_S = 0.05
"""Longest time until a canceled sweep or a lost box is noticed."""
LONGEST_S = 3600.0


class Terms(Protocol):
    """Parameters of a sweep: the fields of Sweep.action. speed_mm_s, force_n: 0 for unknown."""

    new_object: bool
    slide_s: float
    timeout_s: float
    speed_mm_s: float
    force_n: float


class CommandedSweep:
    """Carries out one sweep at a time.

    canceled: whether the answer is not wanted any more. say: is called with each phase, `sliding`,
    `judging` or `early`, the last with the answer.
    """

    def __init__(
        self,
        box: Palpate,
        *,
        canceled: Callable[[], bool],
        say: Callable[[str, Answer | None], None],
        clock: Clock | None = None,
    ) -> None:
        self._box, self._canceled, self._say = box, canceled, say
        self._clock = clock or SystemClock()

    def run(self, terms: Terms) -> Answer:
        """The answer; it is `aborted` if the sweep was canceled.

        Raises ConfigError for invalid terms, CommandRefused, NoAnswer or LinkLost. The box's sweep
        is then aborted if the box can be reached.
        """
        check(terms)
        # so every earlier sweep is answered, and the next answer belongs to this sweep
        self._box.wait_ready(READY_S)
        if self._canceled():
            raise CommandRefused("the sweep was canceled before START; send another goal")
        if terms.new_object:
            self._box.new_object()
        try:
            self._box.start(speed_mm_s=terms.speed_mm_s or None, force_n=terms.force_n or None)
            self._say("sliding", None)
            answer = self._answered(terms)
        except CommandRefused:  # no sweep of ours is open
            raise
        except Exception:  # after any failure, the box must not be left with an open sweep
            with suppress(ApplianceError):
                self._box.abort()
            raise
        return answer or self._aborted()

    def _answered(self, terms: Terms) -> Answer | None:
        """The answer, None if the sweep was canceled. STOP is sent when it is due, or when the
        answer is there."""
        begin_ns = self._clock.now_ns()
        stop_s = terms.slide_s or math.inf
        stopped = False
        while not self._canceled():
            past_s = (self._clock.now_ns() - begin_ns) / 1e9
            if not stopped and past_s >= stop_s:
                self._box.stop()
                stopped = True
                self._say("judging", None)
            turns = TURN_S, terms.timeout_s - past_s, TURN_S if stopped else stop_s - past_s
            if answer := self._next(min(turns)):
                if answer.early:
                    self._say("early", answer)
                if terms.slide_s and not stopped:
                    self._close(answer)
                return answer
            if min(past_s, self._box.silent_s()) > STALE_S:
                raise NoAnswer(
                    f"the box has said nothing for {STALE_S:g} s during the sweep; is it on?"
                )
            if past_s >= terms.timeout_s:
                raise NoAnswer(
                    f"no answer within timeout_s = {terms.timeout_s:g} of START; the sweep was "
                    "aborted"
                )
        return None

    def _close(self, answer: Answer) -> None:
        """Send STOP for a sweep that was already answered. It causes no answer; without it, the
        next START would end the sweep."""
        # with NO_STOP, a START of another peer has closed it, and the STOP belongs to that peer
        if answer.status is not Status.NO_STOP:
            with suppress(ApplianceError):
                self._box.stop()

    def _aborted(self) -> Answer:
        with suppress(CommandRefused):  # it may just have been answered
            self._box.abort()
        answer = self._next(ABORTED_S)
        if answer is None:
            raise NoAnswer(
                f"the box did not answer the aborted sweep within {ABORTED_S:g} s; look at its log"
            )
        return answer

    def _next(self, limit_s: float) -> Answer | None:
        """The next answer, if it comes in time. Raises LinkLost."""
        try:
            return self._box.result(limit_s)
        except NoAnswer:
            return None
        except LinkLost as e:
            raise LinkLost(f"the box was lost during the sweep: {e}; sweep again") from e


def check(terms: Terms) -> None:
    """Raises ConfigError for invalid times."""
    if not 0 <= terms.slide_s <= LONGEST_S:
        raise ConfigError(
            f"slide_s = {terms.slide_s:g} is not a valid time from START to STOP; use 0 to "
            f"{LONGEST_S:g}"
        )
    if not terms.slide_s < terms.timeout_s <= LONGEST_S:
        raise ConfigError(
            f"timeout_s = {terms.timeout_s:g} is not a valid limit from START to the answer; use "
            "more than slide_s ="
            f" {terms.slide_s:g}, up to {LONGEST_S:g}"
        )
