"""A service that tries again until an address can be used."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from palpate.core.clock import Clock
from palpate.core.errors import AddressError
from palpate.core.log import in_journal, log

Made = TypeVar("Made")
FIRST_S, MOST_S, STEP_S = 1.0, 60.0, 0.2
"""The first pause, the longest one, and the time between two looks at `stopped`."""


def retried(
    make: Callable[[], Made],
    clock: Clock,
    stopped: Callable[[], bool] = lambda: False,
    *,
    always: bool = False,
) -> Made:
    """`make()`; a service tries again with a growing pause as long as an address cannot be used.
    After a power cut the address may come later than the service. Raises AddressError in a
    terminal, where a person reads it (not if `always`), and once `stopped()`."""
    pause_s = FIRST_S
    while True:
        try:
            return make()
        except AddressError as e:
            if stopped() or not (always or in_journal()):
                raise
            if pause_s == FIRST_S:
                log.warning(f"{e}; trying again, with a pause of up to {MOST_S:g} s")
        end_ns = clock.now_ns() + round(pause_s * 1e9)
        while not stopped() and (now_ns := clock.now_ns()) < end_ns:
            clock.sleep_until(min(end_ns, now_ns + round(STEP_S * 1e9)))
        pause_s = min(2 * pause_s, MOST_S)
