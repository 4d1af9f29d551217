"""The load of the page: `python -m tests.campaigns.page_load --seconds 60 --out
docs/data/page-load.json`, seconds for each number of browsers.

Prints a table and writes JSON: memory and share of a core of `palpate watch --web` with none, one
and eight browsers. One box (`palpate run --sim skin`, in real time) and one page run; the numbers
of browsers take turns. A browser is a connection that reads all events and requests the picture of
each sweep, as the page's script does; the load of a tablet is not measured.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

from palpate.core import storage
from palpate.core.provenance import commit
from tests.factories.page_client import EventReader, PageAddress, ask
from tests.factories.paths import ROOT

BROWSERS = (0, 1, 8)
SETTLE_S = 5.0
RUN = [sys.executable, "-m", "palpate"]


def used(pid: int) -> tuple[float, int, int]:
    """Processor seconds, KiB resident and KiB proportional (PSS) of a process."""
    parts = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    kib = dict(
        re.findall(r"(?m)^(Rss|Pss):\s+(\d+) kB", Path(f"/proc/{pid}/smaps_rollup").read_text())
    )
    return (
        (int(parts[11]) + int(parts[12])) / os.sysconf("SC_CLK_TCK"),
        int(kib["Rss"]),
        int(kib["Pss"]),
    )


def browse(page: PageAddress, ended: threading.Event, read: list[int]) -> None:
    """Read events as a page does, and request the picture of each sweep."""
    with suppress(OSError, EOFError):
        reader = EventReader(page)
        while not ended.is_set():
            name, content = reader.next()
            read.append(1)
            if name == "signal":
                ask(page, f"/sweep/{content['number']}")


def measured(pid: int, page: PageAddress, browsers: int, seconds: float) -> dict[str, Any]:
    """The resources of the process with so many browsers."""
    ended, read = threading.Event(), []
    threads = [
        threading.Thread(target=browse, args=(page, ended, read), daemon=True)
        for _ in range(browsers)
    ]
    for thread in threads:
        thread.start()
    time.sleep(SETTLE_S)
    begin, before = time.monotonic(), used(pid)
    read.clear()
    time.sleep(seconds)
    after, wall_s = used(pid), time.monotonic() - begin
    ended.set()
    for thread in threads:
        thread.join(10)
    share = (after[0] - before[0]) / wall_s
    return {
        "browsers": browsers,
        "share": share,
        "rss_kib": after[1],
        "pss_kib": after[2],
        "events_s": len(read) / wall_s,
    }


def main() -> int:
    """Measure and print; returns 0."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        feed = ["--set", f"store.runtime={folder}"]
        box = subprocess.Popen(
            [*RUN, "run", "--sim", "skin", *feed], stdout=subprocess.DEVNULL, cwd=ROOT
        )
        watch = subprocess.Popen(
            [*RUN, "watch", "--web", "0", *feed],
            stderr=subprocess.PIPE,
            text=True,
            cwd=ROOT,
        )
        try:
            page = PageAddress(watch.stderr.readline().split("page: ")[1].strip())
            results = [measured(watch.pid, page, browsers, args.seconds) for browsers in BROWSERS]
        finally:
            for one in (watch, box):
                one.terminate()
                one.wait(10)
    for one in results:
        shown = (
            f"{100 * one['share']:.1f} % of a core, {one['rss_kib'] / 1024:.0f} MiB "
            f"resident, {one['pss_kib'] / 1024:.0f} MiB in proportion"
        )
        print(f"{one['browsers']} browsers: {shown}, {one['events_s']:.0f} events a second")
    if args.out:
        about = {
            "commit": commit(),
            "seconds": args.seconds,
            "cores": os.cpu_count(),
            "results": results,
        }
        storage.put(args.out, json.dumps(about, indent=1).encode())
    return 0


if __name__ == "__main__":
    sys.exit(main())
