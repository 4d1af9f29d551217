"""A box whose line is read and timed here first, and then passed on to a bridge."""

import os
import select
from contextlib import suppress

from palpate.tools import pseudo_terminal
from tests.rig.soak_boxes import ThisMachine


class SharedLine(ThisMachine):
    """A ThisMachine with a bridge on its line. line: the port for `bridge tcp --port`."""

    line = ""

    def launch(self, *options: str) -> None:
        """As ThisMachine."""
        self._bridge, self.line = self._stack.enter_context(pseudo_terminal.pair())
        super().launch(*options)

    def heard(self, wait_s: float) -> list[tuple[float, str]]:
        """As ThisMachine; also passes on commands of the bridge."""
        ready = select.select([self._far, self._bridge], [], [], wait_s)[0]
        if self._bridge in ready:
            with suppress(BlockingIOError):
                os.write(self._far, os.read(self._bridge, 4096))
        return super().heard(0)

    def _said(self) -> bytes:
        data = super()._said()
        with suppress(BlockingIOError):  # no bridge has opened its end yet
            os.write(self._bridge, data)
        return data
