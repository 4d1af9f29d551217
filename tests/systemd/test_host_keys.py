"""Keys of boxes: stored at the first contact, refused with KNOWN=1, always refused when changed."""

import os
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.factories.paths import ROOT

paramiko = pytest.importorskip("paramiko", reason="no pyinfra here; make .venv/fleet.done")
pytestmark = pytest.mark.slow

CONNECT = (
    "import sys; import fleet; "
    "sys.exit(fleet.each(fleet.options('connect', 20).parse_args(), lambda box: 'is reached'))"
)


class OpenServer(paramiko.ServerInterface):
    """Lets everybody in and offers nothing."""

    def check_auth_publickey(self, username: str, key: object) -> int:
        return int(paramiko.AUTH_SUCCESSFUL)

    def get_allowed_auths(self, username: str) -> str:
        return "publickey"


@pytest.fixture
def key() -> paramiko.ECDSAKey:
    """The key of the box."""
    return paramiko.ECDSAKey.generate()


@pytest.fixture
def port(key: paramiko.ECDSAKey) -> Iterator[int]:
    """The port of an ssh server with this key."""
    kept = []
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def serve() -> None:
            while True:
                try:
                    transport = paramiko.Transport(listener.accept()[0])
                except OSError:
                    return
                transport.add_server_key(key)
                transport.start_server(server=OpenServer(), event=threading.Event())
                kept.append(transport)

        threading.Thread(target=serve, daemon=True).start()
        yield listener.getsockname()[1]
        listener.shutdown(socket.SHUT_RDWR)
    for transport in kept:
        transport.close()


@pytest.fixture
def known(tmp_path: Path) -> Path:
    """The known keys of a person with a key of their own."""
    (tmp_path / ".ssh").mkdir(mode=0o700)
    paramiko.ECDSAKey.generate().write_private_key_file(str(tmp_path / ".ssh" / "id_ecdsa"))
    (tmp_path / ".ssh" / "known_hosts").touch()
    return tmp_path / ".ssh" / "known_hosts"


def connect(known: Path, port: int, *options: str) -> subprocess.CompletedProcess[str]:
    """Reach the box as this person does."""
    return subprocess.run(
        [sys.executable, "-c", CONNECT, "--host", f"somebody@127.0.0.1:{port}", *options],
        env=os.environ
        | {"HOME": str(known.parent.parent), "PYTHONPATH": f"{ROOT / 'systemd'}:{ROOT}"},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )


def test_a_new_key_is_stored_and_reported(known: Path, port: int):
    """The next contact reports nothing."""
    first = connect(known, port)
    assert (first.returncode, "accepting" in first.stderr) == (0, True), first
    assert f"[127.0.0.1]:{port} ecdsa-sha2-nistp256 " in known.read_text()
    again = connect(known, port, "--known-hosts-only")
    assert (again.returncode, again.stderr) == (0, "")


def test_a_box_that_is_not_known_is_refused_where_asked(known: Path, port: int):
    """KNOWN=1 of the Makefile: nothing is stored."""
    done = connect(known, port, "--known-hosts-only")
    assert done.returncode == 1, done
    assert "FAILED: " in done.stdout
    assert "host key" in done.stdout
    assert known.read_text() == ""


@pytest.mark.parametrize("options", [(), ("--known-hosts-only",)], ids=["default", "KNOWN=1"])
def test_a_changed_key_is_refused(known: Path, port: int, options: tuple[str, ...]):
    """Somebody stands in between: refused in any case, and the known key stays."""
    line = f"[127.0.0.1]:{port} ecdsa-sha2-nistp256 {paramiko.ECDSAKey.generate().get_base64()}\n"
    known.write_text(line)
    done = connect(known, port, *options)
    assert done.returncode == 1, done
    assert "FAILED: " in done.stdout
    assert known.read_text() == line
