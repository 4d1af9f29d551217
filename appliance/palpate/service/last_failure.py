"""Why the service has ended: a small file next to the status file, for `palpate status` and for the
pause before the next start.

The file is in memory (/run), so it does not outlive a boot.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from palpate.core.errors import EX_CONFIG, ApplianceError
from palpate.core.runtime_folder import LAST_FAILURE as FILE

if TYPE_CHECKING:
    from palpate.core.clock import Clock

AGAIN_NS = 60_000_000_000
"""A failure within this time after the last one lengthens the pause."""
PAUSES_S = (0.0, 1.0, 2.0, 4.0, 6.0)
"""Pauses after the first failure, the second and so on, next to RestartSec of the unit. The last is
shorter than TimeoutStopSec."""
MOST_BYTES = 1 << 14


class Failure(NamedTuple):
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
        return PAUSES_S[min(self.failures, len(PAUSES_S)) - 1]


def read(folder: Path | None) -> Failure | None:
    """The content of the file in the runtime folder; None if there is none, or none that can be
    read."""
    if not folder:
        return None
    try:
        with (folder / FILE).open("rb") as f:
            found = Failure(**json.loads(f.read(MOST_BYTES)))
        right = [type(v) is type(w) for v, w in zip(found, Failure("", 0, 0), strict=True)]
        return found if all(right) and found.why.isprintable() else None
    except (OSError, ValueError, TypeError, RecursionError):
        return None


@contextmanager
def recorded(folder: Path | None, clock: Clock) -> Iterator[None]:
    """Write the file if the block ends by an error, and remove it at an end in order. A file that
    cannot be written is left out: the journal has the reason, too."""
    try:
        yield
    except Exception as e:
        _record(folder, e, clock.now_ns())
        raise
    if folder:
        with suppress(OSError):
            (folder / FILE).unlink()


def _record(folder: Path | None, e: Exception, now_ns: int) -> None:
    if not (folder and folder.is_dir()):
        return
    before = read(folder)
    again = before and 0 <= now_ns - before.time_ns < AGAIN_NS
    code = e.exit_code if isinstance(e, ApplianceError) else ApplianceError.exit_code
    why = str(e) if isinstance(e, ApplianceError) else f"{type(e).__name__}: {e}"
    failure = Failure(why[:1000], code, now_ns, before.failures + 1 if before and again else 1)
    from palpate.core import storage

    data = json.dumps(failure._asdict()).encode()
    with suppress(OSError):
        storage.put(folder / FILE, data, durable=False, mode=0o644)
