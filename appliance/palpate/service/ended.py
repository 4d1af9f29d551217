"""Why the service has ended: a small file beside the status file, for `palpate status`, and for the
pause before the next start.

The file is in memory (/run), so it does not outlive a boot.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path

from palpate.core import storage
from palpate.core.clock import Clock
from palpate.core.errors import EX_CONFIG, ApplianceError
from palpate.core.schema import typed

FILE = "ended.json"
AGAIN_NS = 60_000_000_000
"""A failure within this time after the last one lengthens the pause."""
PAUSES_S = (0.0, 1.0, 2.0, 4.0, 6.0)
"""Pauses after the first failure, the second and so on, beside RestartSec of the unit. The last is
shorter than TimeoutStopSec."""
MOST_BYTES = 1 << 14


@dataclass(frozen=True, slots=True)
class Ended:
    """The last end of the service that was not in order. failures: in a row. time_ns: host
    monotonic."""

    why: str
    code: int
    time_ns: int
    failures: int = 1

    @property
    def text(self) -> str:
        """The reason and the next step, for a person."""
        if self.code == EX_CONFIG:
            return (
                f"it ended with exit code {self.code} and stays stopped: {self.why}; correct that,"
                " then systemctl restart palpate"
            )
        return (
            f"it ended with exit code {self.code}, {self.failures} times in a row, and is started"
            f" again by itself: {self.why}"
        )

    @property
    def pause_s(self) -> float:
        """Pause before the next start."""
        return PAUSES_S[min(self.failures, len(PAUSES_S)) - 1]


def read(folder: Path | None) -> Ended | None:
    """The content of the file in the runtime folder; None if there is none, or none that can be
    read."""
    if not folder:
        return None
    try:
        with (folder / FILE).open("rb") as f:
            return typed(Ended, json.loads(f.read(MOST_BYTES)))
    except (OSError, ValueError, TypeError, RecursionError):
        return None


@contextmanager
def noted(folder: Path | None, clock: Clock) -> Iterator[None]:
    """Write the file if the block ends by an error, and remove it at an end in order. A file that
    cannot be written is left out: the journal has the reason, too."""
    try:
        yield
    except Exception as e:
        _note(folder, e, clock.now_ns())
        raise
    if folder:
        with suppress(OSError):
            (folder / FILE).unlink()


def _note(folder: Path | None, e: Exception, now_ns: int) -> None:
    if not (folder and folder.is_dir()):
        return
    before = read(folder)
    again = before and 0 <= now_ns - before.time_ns < AGAIN_NS
    code = e.exit_code if isinstance(e, ApplianceError) else ApplianceError.exit_code
    why = str(e) if isinstance(e, ApplianceError) else f"{type(e).__name__}: {e}"
    ended = Ended(why[:1000], code, now_ns, before.failures + 1 if before and again else 1)
    with suppress(OSError):
        storage.put(folder / FILE, json.dumps(asdict(ended)).encode(), durable=False, mode=0o644)
