"""The box's end of a serial line, played by a script, for tests of programs at the other end."""

import contextlib
import os
import select
import threading
import tty
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Self

from palpate.core import sentences
from palpate.core.sentences import Sentence, sentence

LABELS = ("wood", "paper", "plastic rough")
STREAMING = ("9.000", "streaming", 0, 0, 3000, 0, 0, 1, 0, "9f3c2a1b", "sim")
IDENTITY = ("mine", "2", "9f3c2a1b", "4x4 uint8 at 750 Hz  window 1500", "skin-4x4 A0017 1.2.0")

Script = Callable[[Sentence], Iterable[bytes]]


def state(
    skin: str = "streaming", answered: int = 0, *, sweeping: int = 0, bundle: str = "9f3c2a1b"
) -> bytes:
    """An STA sentence."""
    return sentence("STA", "9.000", skin, sweeping, answered, *STREAMING[4:9], bundle, "sim")


def result(
    sweep: int,
    status: str = "ok",
    label: str = "wood",
    share: str = "1.00",
    detail: str = "",
    optional: Sequence[object] = (),
) -> bytes:
    """A RES sentence. optional: the fields after the detail."""
    fields = (sweep, "9.500", status, label, "0.900", "0.800", 1, 0, "1.25", "9f3c2a1b", "sim")
    return sentence("RES", *fields, share, detail, *optional)


def finger(
    name: str, sweep: int, status: str = "ok", label: str = "wood", probability: str = "0.900"
) -> bytes:
    """A FIN sentence."""
    fields = (name, sweep, "9.500", status, label, probability, "0.800", 1, 0, "1.25")
    return sentence("FIN", *fields, "9f3c2a1b", "sim", "1.00", "")


def obeying(heard: Sentence) -> list[bytes]:
    """The answers of a box without faults: STOP ends a sweep, which is answered `ok`."""
    known = {"STATE": STREAMING, "ID": IDENTITY, "TARE": ("16 taxels",)}
    fields: tuple[object, ...] = known.get(heard.kind, ())
    if heard.kind == "LABEL":
        code = int(heard.fields[0])
        fields = (code, LABELS[code - 1], len(LABELS))
    answer = sentence("ANS", heard.kind, "ok", *fields)
    return [answer, result(1)] if heard.kind == "STOP" else [answer]


class SpeakingBox:
    """Answers by script at `path`; `unplug`, `plug_in`; heard: the commands."""

    def __init__(self, path: Path, script: Script = obeying) -> None:
        self.path, self.script = path, script
        self.heard: list[Sentence] = []
        self._come = threading.Condition()
        self._ends: tuple[int, ...] = ()
        self._ending = threading.Event()
        self._lock = threading.RLock()
        self.plug_in()
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *reason: object) -> None:
        self._ending.set()
        self._thread.join(5)
        self.unplug()

    def plug_in(self) -> None:
        with self._lock:
            far, near = os.openpty()
            for end in (far, near):
                tty.setraw(end)
            os.set_blocking(far, False)
            self._ends = far, near
            self.path.symlink_to(os.ttyname(near))

    def unplug(self) -> None:
        """Remove the robot's end."""
        with self._lock:
            self.path.unlink(missing_ok=True)
            for end in self._ends:
                os.close(end)
            self._ends = ()

    def say(self, *lines: bytes) -> None:
        """Send lines, in pieces if the terminal is full; what nobody reads for 5 s is lost."""
        rest = b"".join(lines)
        with self._lock:
            while rest and select.select([], [self._ends[0]], [], 5)[1]:
                with contextlib.suppress(BlockingIOError):
                    rest = rest[os.write(self._ends[0], rest) :]

    def wait_for(self, kind: str, timeout_s: float = 30) -> None:
        """Wait until a command has arrived."""
        with self._come:
            came = self._come.wait_for(lambda: any(s.kind == kind for s in self.heard), timeout_s)
            assert came, self.heard

    def _listen(self) -> None:
        rest = b""
        while not self._ending.wait(0.002):
            with self._lock, contextlib.suppress(OSError):
                if not self._ends or not select.select([self._ends[0]], [], [], 0)[0]:
                    continue
                found, rest = sentences.parse(os.read(self._ends[0], 4096), rest)
                for one in found:
                    with self._come:  # before the answer: a test with that may read `heard`
                        self.heard.append(one)
                        self._come.notify_all()
                    for line in self.script(one):
                        self.say(line)
