"""Pages behind nginx: below a path of its own, and with defaults that hold back small answers."""

from __future__ import annotations

import shutil
import socket
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from getpass import getuser
from pathlib import Path

import pytest

from palpate.web.access import Access
from tests.factories.browser import BrowsedPage, until
from tests.factories.shown_page import Shown

NGINX = shutil.which("nginx", path="/usr/sbin:/usr/bin:/usr/local/sbin")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not NGINX, reason="no nginx: apt-get install nginx-light"),
]
SETTINGS = """user {4}; daemon off; worker_processes 1; pid {0}/pid; error_log {0}/log; events {{}}
http {{ access_log off; client_body_temp_path {0}/b; proxy_temp_path {0}/p;
fastcgi_temp_path {0}/f; uwsgi_temp_path {0}/u; scgi_temp_path {0}/s;
server {{ listen 127.0.0.1:{1}; location {2} {{ proxy_pass http://127.0.0.1:{3}/; }} }} }}"""


@contextmanager
def proxy(folder: Path, location: str, port: int) -> Iterator[int]:
    """The port of an nginx of this user that passes a path on to a page's port."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        own = free.getsockname()[1]
    (folder / "conf").write_text(SETTINGS.format(folder, own, location, port, getuser()))
    command = [str(NGINX), "-p", str(folder), "-e", str(folder / "log"), "-c", str(folder / "conf")]
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as process:
        try:
            until(lambda: socket.socket().connect_ex(("127.0.0.1", own)) == 0)
            yield own
        finally:
            process.terminate()
            process.wait(10)


def port_of(shown: Shown) -> int:
    return int(shown.server.address.rsplit(":", 1)[1])


def test_a_path_of_its_own(browser, tmp_path):
    """Files, events, counts and pictures come through, in each view."""
    with Shown(Access(0)) as shown, proxy(tmp_path, "/cells/palpate/", port_of(shown)) as port:
        shown.shift()
        address = f"http://localhost:{port}/cells/palpate/"
        seen = BrowsedPage(browser, f"{address}#watch")
        until(lambda: seen.page.locator(".row").count() == 40)
        until(lambda: "16 taxels" in str(seen.page.get_attribute("#signal", "aria-label")))
        seen.page.goto(f"{address}#history")
        until(lambda: seen.text("#past-counted").startswith("40 sweeps"))
        assert not seen.errors


def test_an_event_is_not_kept_until_there_are_more(tmp_path):
    """Fewer bytes than nginx keeps by itself arrive at once."""

    def received(one: socket.socket, wanted: bytes) -> bytes:
        """Received bytes, up to and with `wanted`."""
        found = b""
        while wanted not in found:
            more = one.recv(4096)
            assert more
            found += more
        return found

    with (
        Shown(Access(0)) as shown,
        proxy(tmp_path, "/", port_of(shown)) as port,
        socket.create_connection(("127.0.0.1", port), timeout=20) as one,
    ):
        one.sendall(b"GET /events HTTP/1.1\r\nHost: localhost\r\n\r\n")
        before = received(one, b"event: begin")
        shown.server.publish("note", {"text": "little"})
        assert len(before + received(one, b"little")) < 4096
