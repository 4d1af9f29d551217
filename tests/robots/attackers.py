"""Hostile peers of a bridge or of the page: `python -m tests.robots.attackers KIND PORT`, until
standard input ends.

KIND is modbus, tcp or page, PORT its port on loopback. Prints a line of JSON with the number of
connections and the answers that a good peer got. All peers are in one process of low priority. It
pauses between its rounds, so it takes less than a core.
"""

from __future__ import annotations

import json
import os
import select
import sys
import time
from collections import Counter
from functools import partial

from palpate.core.sentences import sentence
from tests.campaigns.feed_readers import (
    PAUSE_S,
    Act,
    Address,
    asker,
    noise,
    peer,
    send,
    storm,
    talker,
)

READ = bytes.fromhex("000100000006ff0400000028")
"""A request of Modbus TCP for all registers."""
ASK = b"GET / HTTP/1.1\r\nHost: localhost\r\n"
FLOODS = {
    "modbus": (READ * 50, b"\0\1\0\0\0\xff"),
    "tcp": (
        sentence("STATE") * 20,
        sentence("START") * 20 + sentence("ABORT") * 20,
        b"x" * 300,
        b"$PPLP,START*00\r\n" * 20,
    ),
    "page": (
        ASK + b"\r\n",
        ASK.replace(b"/", b"/../../etc/passwd", 1) + b"\r\n",
        ASK + b"X: " + b"y" * 2000,
        ASK.replace(b"/", b"/events", 1) + b"Authorization: Bearer wrong\r\n\r\n",
    ),
}
"""Bytes that are sent without end: valid, refused, endless and wrong requests."""
HALVES = {"modbus": READ[:7], "tcp": b"$PPLP,STA", "page": ASK[:20]}
GOOD = {"modbus": READ, "tcp": sentence("ID"), "page": ASK + b"\r\n"}
BURST = 2


def acts(kind: str, there: Address, seen: Counter[str]) -> list[Act]:
    """A good peer, and all hostile peers of a kind; the last but one asks and never reads."""
    good = GOOD[kind]
    floods = ((said, reads) for said in FLOODS[kind] for reads in (True, True, False))
    return [
        asker(there, seen, good),
        *(talker(there, seen, partial(bytes, said), reads=reads) for said, reads in floods),
        *(talker(there, seen, noise) for _ in range(3)),
        peer(there, lambda one: send(one, good)),
        storm(there, seen, HALVES[kind], BURST),
    ]


def main(kind: str, port: int) -> None:
    """Run until standard input ends."""
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    os.nice(19)
    seen: Counter[str] = Counter()
    all_acts = acts(kind, ("127.0.0.1", port), seen)
    while not select.select([sys.stdin], [], [], 0)[0]:
        for act in all_acts:
            act()
        time.sleep(PAUSE_S)
    print(json.dumps(seen))


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
