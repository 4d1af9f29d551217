"""A session in which a person or a robot teaches the box: records sweeps, assesses them after each,
and makes a bundle of them on demand.

Processes next to the loop do the work (process.py). A failure leaves the sweeps and the
bundle in service as they are.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future
from functools import partial
from pathlib import Path
from typing import Any

from palpate.core.clock import SystemClock
from palpate.core.config import TeachConfig
from palpate.core.errors import ApplianceError, ConfigError
from palpate.core.log import log
from palpate.core.observer import Health, Observer
from palpate.core.sentences import CommandHandler, Reply, future_of, sentence
from palpate.core.types import Sweep, Verdict
from palpate.io.robot_link import check_bits
from palpate.learn.process import News, TeachingProcess, learning
from palpate.sweeps.recording import Labels, RecordingSession
from palpate.sweeps.sweep_folder import NOT_THIS, number_of

FEWEST_TAUGHT = 2
"""Fewest sweeps of a material that can be assessed, and fewest such materials."""
MOST_NAMED = 64
"""Most materials that wait for their first sweep: names cost nothing, and each is shown."""
PAUSE_NS = 300_000_000
"""Time without a new sweep before an assessment begins."""

Learn = Callable[[str], list[str]]
"""The command of a process that does all of `install`, for the person or program that asks; for ""
of a process that only assesses the sweeps."""


def refuse_trained(trained: Iterable[str], labels: Iterable[str]) -> None:
    """Raises ConfigError for a label that the delivered bundle was trained on, for sweeps that
    would move its limits, and for a material whose label looks like NOT_THIS."""
    trained, labels = tuple(trained), tuple(labels)
    if alike := [name for name in labels if name != NOT_THIS and name.lower() == NOT_THIS]:
        raise ConfigError(f"{alike[0]!r} would be taught as a material; write {NOT_THIS!r}")
    if trained and NOT_THIS in labels:
        raise ConfigError(
            f"a delivered bundle keeps its limits, and {NOT_THIS!r} cannot move them; set "
            'classifier.strangers = "strict"'
        )
    if known := next((name for name in labels if name in trained), ""):
        advice = "record it for the desktop (palpate record), or take another name"
        raise ConfigError(f"the bundle in service was trained on {known!r}; {advice}")


class TeachingSession(Observer):
    """Observes a recording and teaches the stored sweeps.

    learn: makes the command of USE. say: called with TCH sentences. codes: number of codes of the
    class bits, 0 without class bits. base: labels of the delivered bundle into which new materials
    are taught, () without one. trained: the labels that it was trained on. It must come after
    `recording` among the observers.
    """

    def __init__(
        self,
        recording: RecordingSession,
        settings: TeachConfig,
        learn: Learn,
        say: Callable[[bytes], None],
        codes: int = 0,
        base: tuple[str, ...] = (),
        trained: tuple[str, ...] = (),
    ) -> None:
        self._recording, self._settings = recording, settings
        self._codes, self._base, self._trained = codes, base, trained
        self._fewest = 1 if base else FEWEST_TAUGHT
        self._learn, self._clock, self._say = learn, SystemClock(), say
        self._place = recording.about()["position"] or "1"  # of the first sweeps
        self._named: dict[str, None] = {}  # materials without a sweep so far, in order
        self._process: TeachingProcess | None = None
        self._using, self._seen = False, self._kept
        self._due_ns: int | None = self._clock.now_ns()
        self._learnt: News | None = None
        self._step: News | None = None
        self._trouble = self._too_many()
        self._refused: set[int] = set()
        self.by = "the serial line"
        self.taught: News | None = None
        moves: dict[str, CommandHandler]
        moves = {name: partial(self._move, name) for name in ("MOVE", "RENAME", "UNDO")}
        self.recording_commands = {**recording.commands, "MATERIAL": self._material, **moves}
        """The commands of the recording, which here refuse what TEACH refuses."""
        self.commands: Mapping[str, CommandHandler] = {
            "TEACH": self._teach,
            "USE": self._use,
            "FORGET": self._forget,
        }

    def about(self) -> dict[str, Any]:
        """The session for JSON.

        base: labels of the bundle into which materials are taught; fewest: number of materials
        that USE needs.
        materials: each with its number of sweeps, forgotten ones left out. learnt: the last
        assessment, None without one; assessing: whether the next is being made. using: the step of
        USE with the share done and the seconds left, None if it does not run. taught: the result of
        USE. trouble: why the last step failed, "" if it did not.
        """
        idle = {"step": "start", "done": 0.0, "left_s": None}
        return {
            "base": [*self._base],
            "fewest": self._fewest,
            "materials": self.materials(),
            "learnt": self._learnt,
            "assessing": (bool(self._process) and not self._using) or self._due_ns is not None,
            "using": (self._step or idle) if self._using else None,
            "taught": self.taught,
            "trouble": self._trouble,
        }

    def materials(self) -> dict[str, int]:
        """The number of sweeps of each new material, those without one included."""
        counts = self._recording.materials()
        counts = {name: n for name, n in counts.items() if name not in self._trained}
        return dict.fromkeys(self._named, 0) | counts

    def taken(self, material: str) -> int:
        """The number of its sweeps that count, also sweeps that are still being written."""
        return self.materials().get(material, 0) + self._recording.coming(material)

    def _taught(self) -> dict[str, int]:
        """`materials` that an answer may name."""
        return {name: n for name, n in self.materials().items() if name != NOT_THIS}

    @property
    def _kept(self) -> tuple[int, int | None]:
        """Another pair after each sweep that was stored or discarded."""
        return self._recording.stored, self._recording.last

    def sweep(self, sweep: Sweep, verdict: Verdict, circumstances: Mapping[str, Any]) -> None:
        """Tell the robot of a sweep that is not taught; the recording tells a person."""
        if verdict.status.faulty:
            self._refuse(f"sweep {sweep.id}: {verdict.status} {verdict.detail}".rstrip())

    def _refuse(self, text: str) -> None:
        self._say(sentence("TCH", "refused", text))

    def admit(self, *labels: str, renamed: str = "") -> None:
        """Raises ConfigError for a material that the delivered bundle was trained on, and if the
        class bits cannot hold these materials with the earlier materials, without the renamed one.
        A box without class bits admits any number."""
        refuse_trained(self._trained, labels)
        if self._codes:
            wanted = dict.fromkeys((*self._base, *self.materials(), *labels))
            for name in (renamed, NOT_THIS):
                wanted.pop(name, None)
            for name in {*self._recording.sweeps.forgotten} - self.materials().keys() - {*labels}:
                if name not in self._trained:
                    wanted.pop(name, None)
            check_bits(self._codes, [*wanted])

    def _too_many(self) -> str:
        """Why the materials of before cannot be sent, "" if they can: one may be forgotten."""
        try:
            self.admit()
        except ConfigError as e:
            return f"{e}, or forget a material"
        return ""

    def turn(self, health: Health) -> None:
        """Take the news of the process, and begin an assessment that is due."""
        if self._seen != self._kept:
            self._seen = self._kept
            self._due_ns = self._clock.now_ns() + PAUSE_NS
        if self._process:
            for one in self._process.news():
                self._take(one)
            if self._process.ended:
                self._process, self._using, self._step = None, False, None
        elif self._due_ns is not None and self._clock.now_ns() >= self._due_ns:
            self._due_ns = None
            if sum(n >= FEWEST_TAUGHT for n in self._taught().values()) >= self._fewest:
                self._assess()
            else:
                self._learnt = None

    def close(self) -> None:
        """End the process. Sweeps stay as they are, and so does the bundle in service."""
        if self._process:
            self._process.close()

    def _assess(self) -> None:
        """Begin an assessment; a failure is shown."""
        try:
            own = learning(self._recording.sweeps.folder, self._settings)
            self._begin(self._learn("") if self._base else own)
        except ApplianceError as e:
            self._take({"type": "error", "text": str(e)})

    def _begin(self, command: list[str], *, using: bool = False) -> None:
        self._process = TeachingProcess(command, self._settings.limit_s, self._clock, group=True)
        self._using, self._step = using, None

    def _take(self, news: News) -> None:
        kind = news["type"]
        if kind == "step":
            self._step = news
            return
        text = str(news.get("text", ""))
        self._trouble = text if kind == "error" else ""
        for one in news.get("no_slides", ()):
            if one["number"] not in self._refused:
                self._refused.add(one["number"])
                self._recording.leave_out(one["number"])
                log.warning(f"teach: {one['text']}; it is not counted")
                self._refuse(one["text"])
        if kind == "assessed":
            self._learnt = news
            log.info(f"teach: {text}; next: {news['advice']}")
        elif kind == "taught":
            self.taught = news
            log.info(f"teach: {text}")
        else:
            log.warning(f"teach: {text}")
        self._say(sentence("TCH", kind, text))

    def _teach(self, label: str) -> list[object]:
        """The next sweeps are of this material; returns it and the number of its sweeps."""
        label = label.strip()
        if not label:
            raise ApplianceError("TEACH needs the name of a material, such as PPLP TEACH cork")
        Labels(material=label)
        self.admit(label)
        if list(self.materials().values()).count(0) >= MOST_NAMED and label not in self._named:
            raise ApplianceError(
                f"{MOST_NAMED} materials wait for a sweep; record one of them, or forget it"
            )
        self._named.setdefault(label)
        now = self._recording.about()
        if now["material"] not in ("", label) and now["position"].isdecimal():
            self._recording.commands["POSITION"](self._place)  # each material begins there
        self._recording.commands["MATERIAL"](label)
        return [label, self.taken(label)]

    def _material(self, label: str) -> Reply:
        self.admit(*filter(None, [label.strip()]))
        return self._recording.commands["MATERIAL"](label)

    def _move(self, command: str, text: str) -> Reply:
        """Move a sweep, rename a material or undo that; the sweeps are then assessed again."""
        if self._using:
            raise ApplianceError("a bundle is being made; move sweeps afterwards")
        what, _, label = (part.strip() for part in text.partition(","))
        if command == "UNDO":
            what, label = self._recording.undoes
        renamed = "" if command == "MOVE" else what
        refuse_trained(self._trained, [renamed])
        self.admit(*filter(None, [label]), renamed=renamed)
        reply = self._recording.commands[command](text)
        future_of(reply).add_done_callback(partial(self._moved, what, label))
        return reply

    def _moved(self, what: str, label: str, reply: Future[list[object]]) -> None:
        """Sweeps have another material. what: the number of one, or the former name of all."""
        if reply.exception():
            return
        if what in self._named:
            self._named = {label if name == what else name: None for name in self._named}
        if self._learnt:
            suspects = self._learnt.get("suspects", ())
            kept = [one for one in suspects if what not in _about(one)]
            self._learnt = {**self._learnt, "suspects": kept}
        self._due_ns = self._clock.now_ns() + PAUSE_NS

    def _use(self, _: str) -> Reply:
        """Begin to teach all sweeps, once they are written; returns the number of materials and of
        sweeps."""
        if self._using:
            raise ApplianceError("a bundle is being made already; wait for TCH")
        return self._recording.once_written(self._used, "USE")

    def _used(self) -> list[object]:
        held = {name: n for name, n in self._taught().items() if n}
        if len(held) < self._fewest:
            why = "teach one" if self._base else "a model tells at least two apart: teach another"
            raise ApplianceError(f"{len(held)} materials have sweeps; {why}")
        self.admit()
        if self._process:
            self._process.close()
        self._trouble, self.taught = "", None
        self._begin(self._learn(self.by), using=True)
        return [len(held), sum(held.values())]

    def _forget(self, label: str) -> Reply:
        """Teach a material no longer; returns it and the number of its sweeps."""
        label = label.strip()
        number = self.taken(label)
        if label not in self.materials() and not number:
            raise ApplianceError(
                f"there is no material {label!r} to forget; name a recorded material"
            )
        if self._using:
            raise ApplianceError("a bundle is being made; forget it afterwards")
        return self._recording.forget(label, partial(self._forgotten, label, number))

    def _forgotten(self, label: str, number: int) -> list[object]:
        """A material is forgotten. Returns the fields of the reply."""
        self._named.pop(label, None)
        self._trouble = self._too_many()
        self._due_ns = self._clock.now_ns()
        return [label, number]


def _about(suspect: Mapping[str, Any]) -> tuple[str, ...]:
    """The number of its file and the materials of a suspect, as commands have them."""
    number = str(number_of(Path(f"{suspect['sweep']}.npy")))
    return number, str(suspect["material"]), str(suspect["looks_like"])


class Teacher(Observer):
    """Leads through the materials of a session without a page: asks for `sweeps` good sweeps of
    each label, one after another. Sweeps that are still being written count, so that a slow disk
    gives no label to sweeps of the next material; where one cannot be stored, its label is asked
    for again at the end. It must come after the session among the observers. done: true once all
    sweeps are stored; false for ever without labels."""

    def __init__(
        self,
        session: TeachingSession,
        recording: RecordingSession,
        labels: Sequence[str],
        sweeps: int,
    ) -> None:
        self._session, self._recording = session, recording
        self._left, self._sweeps = [*labels], sweeps
        self._wanted: dict[str, int] = {}  # sweeps of each label so far, the last in hand
        self.done = False

    def turn(self, health: Health) -> None:
        """Go on with the next material if this material is complete."""
        if (not self._left and not self._wanted) or self._lacks([*self._wanted][-1:]):
            return
        if self._left:
            label = self._left.pop(0)
            self._wanted[label] = self._session.taken(label) + self._sweeps
            self._ask(label)
            return
        self._recording.disk.settle()
        if again := self._lacks(self._wanted):
            self._ask(again[0])
        else:
            self.done = True

    def _ask(self, label: str) -> None:
        self._wanted[label] = wanted = self._wanted.pop(label)  # the last in hand
        self._session.commands["TEACH"](label)
        log.info(f"teach: now {label}: {wanted - self._session.taken(label)} sweeps")

    def _lacks(self, labels: Iterable[str]) -> list[str]:
        """The labels that want more sweeps, without forgotten and renamed labels."""
        named, taken = self._session.materials(), self._session.taken
        return [one for one in labels if one in named and taken(one) < self._wanted[one]]
