"""The pages of the other boxes of a site, which announce themselves on the network."""

from __future__ import annotations

from palpate.core.clock import Clock
from palpate.core.errors import ConfigError
from palpate.service import network

KEPT_NS = 60_000_000_000
"""How long an answer of the network is kept."""


class OtherBoxes:
    """Lists the pages of other boxes, each with `name` and `address`; none without zeroconf."""

    def __init__(self, clock: Clock) -> None:
        self._clock, self._asked_ns, self._found = clock, -KEPT_NS, list[dict[str, str]]()

    def __call__(self) -> list[dict[str, str]]:
        """The list; it takes some seconds if the last one is too old."""
        now_ns = self._clock.now_ns()
        if now_ns - self._asked_ns >= KEPT_NS:
            self._asked_ns = now_ns
            self._found = self._ask()
        return self._found

    def _ask(self) -> list[dict[str, str]]:
        try:
            there = network.found(self._clock)
        except (ConfigError, OSError):
            return []
        own = network.box_id()
        pages = {}
        for one in reversed(there):  # the lowest port of a box is that of the start
            if one.kind == "page" and not one.box.endswith(own):
                host = f"[{one.host}]" if ":" in one.host else one.host
                pages[one.box] = f"https://{host}:{one.port}/"
        return [{"name": box, "address": pages[box]} for box in sorted(pages)]
