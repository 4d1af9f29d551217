"""All peers of one box: `python -m tests.campaigns.full_load_peers FEED TCP MODBUS PAGE`, until
standard input ends.

The arguments are the feed's socket and the ports of the bridges and of the page. Prints a line of
JSON with the counts of each peer: eight readers of the feed, one of them never reads; a robot at
each bridge that asks a few times a second; a browser at the page.
"""

from __future__ import annotations

import json
import os
import select
import sys
import threading
import time
from collections import Counter

from palpate.core.sentences import sentence
from tests.campaigns.feed_readers import PAUSE_S, acts, asker
from tests.campaigns.page_load import browse
from tests.factories.page_client import PageAddress
from tests.robots.attackers import READ

READERS = "8"
ROUNDS = 50
"""Rounds between two steps of a robot: it asks in one round, and reads the answer in another."""


def main(feed: str, tcp: int, modbus: int, page: int) -> None:
    """Run until standard input ends."""
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    read: Counter[str] = Counter()
    robots = {"tcp": Counter[str](), "modbus": Counter[str]()}
    slow = [
        asker(("127.0.0.1", tcp), robots["tcp"], sentence("STATE")),
        asker(("127.0.0.1", modbus), robots["modbus"], READ),
    ]
    quick = acts(READERS, feed, read)
    events: list[int] = []
    ended = threading.Event()
    threading.Thread(
        target=browse, args=(PageAddress(f"http://127.0.0.1:{page}"), ended, events), daemon=True
    ).start()
    rounds = 0
    while not select.select([sys.stdin], [], [], 0)[0]:
        for act in quick + slow * (rounds % ROUNDS == 0):
            act()
        rounds += 1
        time.sleep(PAUSE_S)
    ended.set()
    answers = {kind: seen["answers of the bridge"] for kind, seen in robots.items()}
    print(json.dumps({"feed": read, "page": len(events), **answers}))


if __name__ == "__main__":
    main(sys.argv[1], *map(int, sys.argv[2:]))
