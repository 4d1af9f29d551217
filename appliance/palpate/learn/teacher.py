"""Leads through the materials of a session without a page, one after another."""

from __future__ import annotations

from collections.abc import Sequence

from palpate.core.health import Health
from palpate.core.log import log
from palpate.core.observer import Observer
from palpate.learn.session import TeachingSession


class Teacher(Observer):
    """Asks for `sweeps` good sweeps of each label. It must come after the session among the
    observers.

    done: true once all sweeps are stored; false for ever without labels.
    """

    def __init__(self, session: TeachingSession, labels: Sequence[str], sweeps: int) -> None:
        self._session, self._left, self._sweeps = session, [*labels], sweeps
        self._label, self._wanted = "", 0
        self.done = False

    def turn(self, health: Health) -> None:
        """Go on with the next material if this material is complete."""
        if not self._complete:
            return
        if self._left:
            self._label = self._left.pop(0)
            self._wanted = self._session.materials().get(self._label, 0) + self._sweeps
            self._session.commands["TEACH"](self._label)
            log.info(f"teach: now {self._label}: {self._sweeps} sweeps")
        elif self._label:
            self.done = True

    @property
    def _complete(self) -> bool:
        return not self._label or self._session.materials()[self._label] >= self._wanted
