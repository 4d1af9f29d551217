"""All pages in the browsers of older tablets: Chromium 83, 88 and 92, and 72, which is too old; and
in WebKit, the engine of Safari, which Debian's webkit2gtk-driver brings.

`python -m tests.campaigns old-browsers [VERSION ...]` takes Chromium from the npm packages of
chrome-aws-lambda, once, into build/browsers. Each opens every view, and orders a sweep on the pages
that record and teach. The exit code is 1 unless all work and the oldest says why it does not.
"""

from __future__ import annotations

import asyncio
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from tornado.websocket import WebSocketClientConnection, websocket_connect

from palpate.sweeps.recording import Labels
from palpate.web.access import Access
from tests.factories.paths import ROOT
from tests.factories.recorded_page import RecordedPage
from tests.factories.shown_page import Shown

PACKAGES = {"72": "1.11.2", "83": "3.1.1", "88": "5.5.0", "92": "10.1.0"}
"""Versions of the package by those of Chromium."""
TOO_OLD = "72"
WEBKIT = "WebKit"
WEBKIT_PROGRAMS = "xvfb-run", "xauth", "WebKitWebDriver"
FAILED = "failed"
FOLDER = ROOT / "build" / "browsers"
UNPACK = (
    "require('fs').writeFileSync(process.argv[2], require('zlib').brotliDecompressSync("
    "require('fs').readFileSync(process.argv[1])), {mode: 0o755})"
)
FLAGS = ("--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage")
WAIT_S = 60
STATE = "document.getElementById('state').textContent"
SAID = "document.getElementById('banner').textContent"
SEEN = {
    "start": "document.querySelectorAll('#there dd').length > 0",
    "watch": "document.querySelectorAll('.row').length == 40",
    "align": "document.getElementById('message').textContent.length > 10",
    "history": "document.querySelectorAll('#past td').length > 0",
}
"""What is true of each view once it is drawn."""


def program(version: str) -> Path:
    """The browser. Raises OSError or CalledProcessError if it cannot be had."""
    there = FOLDER / f"chromium-{version}"
    if not there.exists():
        with tempfile.TemporaryDirectory() as folder:
            package = f"chrome-aws-lambda@{PACKAGES[version]}"
            subprocess.run(["npm", "pack", "--silent", package], cwd=folder, check=True)
            (packed,) = Path(folder).glob("*.tgz")
            shutil.unpack_archive(packed, folder, "gztar")
            (found,) = Path(folder, "package", "bin").glob("chromium*.br")
            FOLDER.mkdir(parents=True, exist_ok=True)
            subprocess.run(["node", "-e", UNPACK, str(found), str(there)], check=True)
    return there


@contextmanager
def started(version: str) -> Iterator[Tab]:
    """A tab of a new Chromium."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        # the oldest has no process apart that could start others as root
        one = "--single-process" if version == TOO_OLD else "--no-zygote"
        options = (*FLAGS, one, "--remote-debugging-port=0", f"--user-data-dir={folder}")
        browser = subprocess.Popen([program(version), *options], stderr=subprocess.DEVNULL)
        try:
            port, end = Path(folder, "DevToolsActivePort"), time.monotonic() + WAIT_S
            while not (port.exists() and "\n" in port.read_text()):
                assert time.monotonic() < end, f"Chromium {version} does not start"
                time.sleep(0.1)
            yield Tab(int(port.read_text().split()[0]))
        finally:
            browser.kill()
            browser.wait()


class Tab:
    """A tab of the browser at `port`."""

    def __init__(self, port: int) -> None:
        self._port, self._number = port, 0
        self._link: WebSocketClientConnection | None = None

    async def do(self, method: str, **parameters: Any) -> Any:
        """The answer to a command of the DevTools protocol."""
        if self._link is None:
            with urllib.request.urlopen(f"http://127.0.0.1:{self._port}/json", timeout=9) as tabs:
                (tab, *_) = [one for one in json.load(tabs) if one["type"] == "page"]
            self._link = await websocket_connect(tab["webSocketDebuggerUrl"])
        self._number += 1
        await self._link.write_message(
            json.dumps({"id": self._number, "method": method, "params": parameters})
        )
        while (answer := json.loads(str(await self._link.read_message()))).get(
            "id"
        ) != self._number:
            pass
        return answer["result"]

    async def until(self, script: str) -> None:
        """Wait until a script gives true."""
        end = time.monotonic() + WAIT_S
        while not (await self.do("Runtime.evaluate", expression=script))["result"].get("value"):
            assert time.monotonic() < end, f"{script} did not come to hold"
            await asyncio.sleep(0.2)


class WebKitTab(Tab):
    """The tab of a new WebKit, told by the protocol of WebDriver at `port`."""

    def __init__(self, port: int) -> None:
        super().__init__(port)
        (program,) = Path("/usr/lib").glob("*/webkit2gtk-4.1/MiniBrowser")
        options = {"binary": str(program), "args": ["--automation"]}
        wanted = {"capabilities": {"alwaysMatch": {"webkitgtk:browserOptions": options}}}
        self._session = ""
        self._session = f"/{self._answer('', wanted)['sessionId']}"

    def _answer(self, path: str, content: object) -> Any:
        address = f"http://127.0.0.1:{self._port}/session{self._session}{path}"
        with urllib.request.urlopen(address, json.dumps(content).encode(), WAIT_S) as answer:
            return json.load(answer)["value"]

    async def do(self, method: str, **parameters: Any) -> Any:
        """As the protocol of DevTools has the two commands that are needed."""
        if method == "Page.navigate":
            return self._answer("/url", parameters)
        script = f"return ({parameters['expression']})"
        return {"result": {"value": self._answer("/execute/sync", {"script": script, "args": []})}}


@contextmanager
def webkit() -> Iterator[WebKitTab]:
    """A tab on a screen that nobody sees."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = ("xvfb-run", "-a", "WebKitWebDriver", f"--port={port}")
    driver = subprocess.Popen(command, stderr=subprocess.DEVNULL, start_new_session=True)
    try:
        end = time.monotonic() + WAIT_S
        while socket.socket().connect_ex(("127.0.0.1", port)):
            assert time.monotonic() < end, "WebKitWebDriver does not start"
            time.sleep(0.1)
        yield WebKitTab(port)
    finally:
        os.killpg(driver.pid, signal.SIGTERM)  # the screen is a process of its own
        driver.wait(WAIT_S)


async def opened(version: str, tab: Tab) -> None:
    """Open all pages. Raises AssertionError."""
    with Shown(Access(0)) as shown:
        shown.shift()
        for view, seen in SEEN.items():
            await tab.do("Page.navigate", url="about:blank")
            await tab.do("Page.navigate", url=f"{shown.server.address}/#{view}")
            await tab.until(f"{SAID}.includes('too old')" if version == TOO_OLD else seen)
    for teaching, button in ((False, "start"), (True, "sweep-button")):
        with ExitStack() as stack:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
            page = stack.enter_context(RecordedPage(folder, Labels("wood"), teaching=teaching))
            await tab.do("Page.navigate", url=page.page.server.address)
            if version == TOO_OLD:
                await tab.until(f"{SAID}.includes('too old')")
                continue
            await tab.until(f"{STATE} == 'ready'")
            click = f"document.getElementById('{button}').click()"
            await tab.do("Runtime.evaluate", expression=click)
            await tab.until(f"{STATE} == 'sweeping'")
            assert page.done == ["START"]


def missing(version: str) -> str:
    """Why a browser cannot be had here, "" if it can."""
    if version == WEBKIT:
        return " ".join(name for name in WEBKIT_PROGRAMS if not shutil.which(name))
    try:
        program(version)
    except (OSError, subprocess.CalledProcessError, ValueError) as e:
        return str(e)
    return ""


def tried(version: str) -> str:
    """What came of opening the pages in one browser."""
    if why := missing(version):
        return f"skipped, since it cannot be had here ({why})"
    try:
        with webkit() if version == WEBKIT else started(version) as tab:
            asyncio.run(opened(version, tab))
    except (AssertionError, KeyError, ValueError) as e:
        return f"{FAILED}: {e}"
    return "says that it is too old" if version == TOO_OLD else "ok"


def main() -> int:
    """Open the pages in each browser; the exit code."""
    said = {version: tried(version) for version in sys.argv[1:] or (*PACKAGES, WEBKIT)}
    for version, text in said.items():
        print(f"{version if version == WEBKIT else f'Chromium {version}'}: {text}")
    return 1 if any(text.startswith(FAILED) for text in said.values()) else 0


if __name__ == "__main__":
    sys.exit(main())
