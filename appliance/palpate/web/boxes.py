"""The pages of the other boxes of a site, which announce themselves on the network."""

from __future__ import annotations

from contextlib import suppress

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
        if now_ns - self._asked_ns < KEPT_NS:
            return self._found
        self._asked_ns, own, pages = now_ns, network.box_id(), {}
        with suppress(ConfigError, OSError):
            for one in reversed(network.found(self._clock)):  # the lowest port is the start's
                if one.kind == "page" and not one.box.endswith(own):
                    host = f"[{one.host}]" if ":" in one.host else one.host
                    pages[one.box] = f"https://{host}:{one.port}/"
        self._found = [{"name": box, "address": pages[box]} for box in sorted(pages)]
        return self._found
