"""The black box: the last sweeps in service, with their verdicts. In: sweeps, verdicts. Out: files that `replay` judges.

Sweeps without a window are not kept: their sentence holds all there is, and a robot that goes on without a skin would
drive out those that hold something.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from appliance.core.log import TroubleLog
from appliance.core.observer import Observer
from appliance.core.types import Sweep, SweepFormat, Verdict
from appliance.recording.recording import FULL, SweepFolder


class BlackBox(Observer):
    """Keeps the last `most` sweeps in `folder`, over restarts too.

    An old sweep goes once the new one is safe; on a full disk it goes before.
    """

    def __init__(self, folder: Path, fmt: SweepFormat, most: int) -> None:
        self._path, self._format, self._most = folder, fmt, most
        self._folder: SweepFolder | None = None
        self._log = TroubleLog(
            "black box: no sweep is kept", f"see to {folder}", end="black box: sweeps are kept again"
        )  # fmt: skip
        self._with_folder(lambda folder: None)  # while there is time: it waits for the disk several times

    def sweep(self, sweep: Sweep, verdict: Verdict, circumstances: Mapping[str, Any]) -> None:
        """Write the sweep if it has a window, and remove what is one too many."""
        if len(sweep.frames):
            self._with_folder(lambda folder: self._put(folder, sweep, verdict, circumstances))

    def close(self) -> None:
        """Give the folder back."""
        if self._folder:
            self._folder.close()

    def _with_folder(self, act: Callable[[SweepFolder], None]) -> None:
        def attempt() -> None:
            # a folder that cannot be used at the start may be usable later, and must not keep the box from its work
            self._folder = self._folder or SweepFolder(self._path, self._format)
            act(self._folder)

        self._log.attempt(attempt)

    def _put(self, folder: SweepFolder, sweep: Sweep, verdict: Verdict, circumstances: Mapping[str, Any]) -> None:
        while True:
            try:
                folder.put(sweep, verdict, circumstances)
                break
            except OSError as e:
                if e.errno not in FULL or not folder.numbers:
                    raise
            folder.remove(folder.numbers[0])
        while len(folder.numbers) > self._most:
            folder.remove(folder.numbers[0])
