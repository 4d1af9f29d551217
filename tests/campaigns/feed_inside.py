"""Runs a command and counts the processor time that the box's loop spends in the feed: `python -m
tests.campaigns.feed_inside FILE COMMAND...`.

COMMAND is the command line of `palpate`; FILE holds the nanoseconds up to now. The time of the
whole process would not show the feed's share: it varies more from turn to turn, because caches and
memory are shared with other programs.
"""

from __future__ import annotations

import mmap
import struct
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from palpate.__main__ import main
from palpate.service.feed import FeedServer

CALLS = ("frames", "answered", "sweep", "turn")
_COUNT = struct.Struct("=q")


def spent_ns(path: Path) -> int:
    """The nanoseconds in FILE."""
    return int(_COUNT.unpack(path.read_bytes())[0])


def count(path: Path, feed: type) -> None:
    """From now on, add the processor time of each of CALLS of the class `feed` to the file."""
    path.write_bytes(_COUNT.pack(0))
    with path.open("r+b") as file:
        total = mmap.mmap(file.fileno(), _COUNT.size)

    def counted(plain: Callable[..., None]) -> Callable[..., None]:
        def call(*args: Any) -> None:
            begun_ns = time.thread_time_ns()
            try:
                plain(*args)
            finally:
                _COUNT.pack_into(
                    total, 0, _COUNT.unpack_from(total)[0] + time.thread_time_ns() - begun_ns
                )

        return call

    for name in CALLS:
        setattr(feed, name, counted(getattr(feed, name)))


if __name__ == "__main__":
    count(Path(sys.argv[1]), FeedServer)
    sys.exit(main(sys.argv[3:]))  # without the name of this program
