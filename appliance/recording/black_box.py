"""The black box: the last sweeps in service, with their verdicts. In: sweeps, verdicts. Out: files that `replay` judges.

Sweeps without a window are not kept: their sentence says all there is, and a robot that goes on without a skin would
drive out those that hold something.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from appliance.core.types import Sweep, SweepFormat, Verdict
from appliance.recording.recording import FULL, SweepFolder
from appliance.service.journal import WARNING


class BlackBox:
    """Keeper of a running box: the last `most` sweeps lie in `folder`, over restarts too.

    An old sweep goes once the new one is safe; on a full disk it goes before. circumstances: what stands in the sidecars
    beside sweep and verdict. log: told once where nothing can be kept, and once where it can again.
    """

    def __init__(
        self, folder: Path, fmt: SweepFormat, most: int, *,
        circumstances: Callable[[], Mapping[str, Any]], log: Callable[[str], None],
    ) -> None:  # fmt: skip
        self._place, self._format, self._most = folder, fmt, most
        self._circumstances, self._log = circumstances, log
        self._folder: SweepFolder | None = None
        self._trouble = ""
        self._try(lambda folder: None)  # while there is time: it waits for the disk several times

    def keep(self, sweep: Sweep, verdict: Verdict) -> None:
        """Write the sweep if it has a window, and take away what is one too many."""
        if len(sweep.frames):
            self._try(lambda folder: self._put(folder, sweep, verdict))

    def close(self) -> None:
        """Give the folder back."""
        if self._folder:
            self._folder.close()

    def _try(self, what: Callable[[SweepFolder], None]) -> None:
        trouble = ""
        try:
            # a folder that cannot be used at the start may be usable later, and must not keep the box from its work
            self._folder = self._folder or SweepFolder(self._place, self._format)
            what(self._folder)
        except OSError as e:
            trouble = str(e.strerror)
        if trouble != self._trouble:
            self._trouble = trouble
            if trouble:
                self._log(f"{WARNING}black box: no sweep is kept: {trouble}; see to {self._place}")
            else:
                self._log("black box: sweeps are kept again")

    def _put(self, folder: SweepFolder, sweep: Sweep, verdict: Verdict) -> None:
        about = self._circumstances()
        while True:
            try:
                folder.put(sweep, verdict, about)
                break
            except OSError as e:
                if e.errno not in FULL or not folder.numbers:
                    raise
            folder.remove(folder.numbers[0])
        while len(folder.numbers) > self._most:
            folder.remove(folder.numbers[0])
