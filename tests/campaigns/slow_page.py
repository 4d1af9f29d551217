"""Sweeps by START and STOP of a recording's page, while slow heads and bodies hold its server.

`python -m tests.campaigns slow-page [SWEEPS]` starts `palpate record --web` on the simulated skin.
Threads open requests that never end, and a browser orders sweeps meanwhile. The exit code is 1
unless each sweep is started and answered.
"""

import json
import re
import socket
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from contextlib import ExitStack, suppress

from tests.factories.page_client import EventReader, PageAddress, port

ATTACKERS, HELD, PAUSE_S = 12, 40, 0.22
"""Threads, open requests of each, and the pause between two requests of a thread."""
SWEEP_S, REST_S, WAIT_S = 2.5, 2.0, 20
HEAD = b"GET / HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
BODY = HEAD.replace(b"GET /", b"POST /order") + b"Content-Length: 900\r\n\r\n{"


class SlowAttack:
    """One thread's requests. sent: how many were begun."""

    def __init__(self, there: int, number: int, ended: threading.Event) -> None:
        self.sent = 0
        self._there, self._ended = ("127.0.0.1", there), ended
        self._from = (f"127.0.0.{1 + number % 4}", 0)
        self._begin, self._more = ((HEAD, b"X: y\r\n"), (BODY, b"x"))[number % 2]
        threading.Thread(target=self._go, daemon=True).start()

    def _go(self) -> None:
        held: list[socket.socket] = []
        while not self._ended.wait(PAUSE_S):
            with suppress(OSError):
                one = socket.create_connection(self._there, timeout=2, source_address=self._from)
                held.append(one)
                one.sendall(self._begin)
                self.sent += 1
            with suppress(OSError):
                [one.sendall(self._more) for one in held[-5:]]
            while len(held) > HELD:
                held.pop(0).close()


class Ordering:
    """A browser: it listens to the events, again if the server closes, and sends orders. answered:
    the status of each sweep. slowest_s: of an order."""

    def __init__(self, page: PageAddress, ended: threading.Event) -> None:
        self.answered, self.slowest_s = dict[int, str](), 0.0
        self._page, self._ended, self._key, self._ready = page, ended, "", threading.Event()
        threading.Thread(target=self._listen, daemon=True).start()
        assert self._ready.wait(WAIT_S), f"the page sent no key within {WAIT_S} s"

    def _listen(self) -> None:
        while not self._ended.wait(0.3):
            with suppress(OSError, EOFError):
                reader = EventReader(self._page)
                while True:
                    name, content = reader.next()
                    if name == "sweep":
                        self.answered[content["sweep"]] = content["status"]
                    elif name == "key":
                        self._key = content
                        self._ready.set()

    def order(self, command: str) -> bool:
        """Whether the page has taken a command, at the first to third attempt."""
        headers = {"Content-Type": "application/json", "X-Palpate-Key": self._key}
        headers["Origin"] = address = self._page.address
        body = json.dumps({"command": command}).encode()
        request = urllib.request.Request(f"{address}/order", body, headers)
        for _ in range(3):
            begin_s = time.monotonic()
            with suppress(OSError):
                urllib.request.urlopen(request, timeout=5).read()
                self.slowest_s = max(self.slowest_s, time.monotonic() - begin_s)
                return True
            time.sleep(0.5)
        return False


def main() -> int:
    """Attack a page, and count its sweeps."""
    sweeps, ended = int(sys.argv[1]) if sys.argv[1:] else 18, threading.Event()
    with ExitStack() as stack:
        out = stack.enter_context(tempfile.TemporaryDirectory())
        words = f"record --sim skin --trigger serial --web 0 --material wood --out {out}"
        command = [sys.executable, "-m", "palpate", *words.split()]
        pipes = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "text": True}
        box = stack.enter_context(subprocess.Popen(command, **pipes))
        stack.callback(box.kill)
        stack.callback(ended.set)
        lines = (re.search(r"http://[\w.]+:\d+", line) for line in box.stderr or ())
        page = PageAddress(next(found[0] for found in lines if found))
        threading.Thread(target=lambda: list(box.stderr or ()), daemon=True).start()
        attacks = [SlowAttack(port(page), n, ended) for n in range(ATTACKERS)]
        browser, started = Ordering(page, ended), 0
        for _ in range(sweeps):
            started += browser.order("START")
            time.sleep(SWEEP_S)
            browser.order("STOP")
            time.sleep(REST_S)
    answered, slow = len(browser.answered), sum(one.sent for one in attacks)
    print(f"{started} of {sweeps} sweeps started, {answered} answered, {slow} slow requests")
    print(f"slowest order {browser.slowest_s:.3f} s, {sorted({*browser.answered.values()})}")
    return int(not started == answered == sweeps)


if __name__ == "__main__":
    sys.exit(main())
