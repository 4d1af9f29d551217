"""Peers that mean a bridge ill: `python -m tests.robots.attackers PORT` until its input ends. In: where the bridge listens on
loopback. Out: one line of JSON, how many connections and requests it had to bear.

All are in one process of low priority, which pauses between its rounds, so that it takes less than a core.
"""

from __future__ import annotations

import json
import os
import random
import select
import socket
import sys
import time
from collections import Counter
from collections.abc import Callable

PAUSE_S = 0.002
HELD = 1000
"""Connections that are held open, nearly all of which the bridge has closed."""
READ = bytes.fromhex("000100000006ff0400000028")
"""A request of Modbus TCP for all registers."""


def connected(port: int, seen: Counter[str]) -> socket.socket | None:
    """A connection that does not wait, None where there is no room for it now."""
    try:
        one = socket.create_connection(("127.0.0.1", port), timeout=0.2)
    except OSError:
        return None
    one.setblocking(False)
    seen["connections"] += 1
    return one


def talker(port: int, seen: Counter[str], said: Callable[[], bytes], *, reads: bool) -> Callable[[], None]:
    """One that sends without end, and comes again when it is closed. reads: takes the replies."""
    held: list[socket.socket] = []

    def act() -> None:
        if not held:
            one = connected(port, seen)
            held.extend([one] if one else [])
            return
        try:
            if reads and select.select(held, [], [], 0)[0] and not held[0].recv(1 << 16):
                raise ConnectionResetError
            seen["bytes"] += held[0].send(said())
        except BlockingIOError:
            return
        except OSError:
            held.pop().close()

    return act


def storm(port: int, seen: Counter[str]) -> Callable[[], None]:
    """Connections without end, with half a request now and then."""
    held: list[socket.socket] = []

    def act() -> None:
        one = connected(port, seen)
        if one:
            if random.random() < 0.3:
                one.send(READ[:7])
            held.append(one)
        if len(held) > HELD:
            held.pop(0).close()

    return act


def main(port: int) -> None:
    """Until standard input ends."""
    os.nice(19)
    seen: Counter[str] = Counter()
    acts = [talker(port, seen, lambda: READ * 50, reads=reads) for reads in (True, True, True, False, False)]
    acts += [talker(port, seen, lambda: random.randbytes(random.randrange(1, 3000)), reads=False) for _ in range(5)]
    acts.append(storm(port, seen))
    while not select.select([sys.stdin], [], [], 0)[0]:
        for act in acts:
            act()
        time.sleep(PAUSE_S)
    print(json.dumps(seen))


if __name__ == "__main__":
    main(int(sys.argv[1]))
