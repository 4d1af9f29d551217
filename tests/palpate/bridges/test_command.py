"""Values that a bridge takes from the settings of the box where no option sets them."""

from __future__ import annotations

import argparse
import os
import re
import select
import signal
import socket
import subprocess
import sys
import tty
from importlib import import_module
from pathlib import Path

import pytest

from palpate.bridges.options import LINKS, PORTS, add_arguments, needed, settle
from palpate.bridges.source import warn_of
from palpate.core import config
from palpate.core.errors import ConfigError
from tests.factories.paths import NO_SITE, ROOT


def settled(kind: str, *options: str, sets: tuple[str, ...] = ()) -> argparse.Namespace:
    """The options of a bridge, once the settings have filled them in."""
    parser = argparse.ArgumentParser("bridge")
    add_arguments(parser)
    args = parser.parse_args([kind, *options])
    settle(kind, args, config.load(None, sets, site=NO_SITE))
    return args


@pytest.mark.slow
@pytest.mark.thorough  # starts processes and waits for them
@pytest.mark.parametrize("kind", ["tcp", "modbus"])
def test_ctrl_c_while_the_box_owes_an_answer(kind):
    """A command is pending: the bridge ends at once with exit code 130 and without a traceback."""
    far, near = os.openpty()
    tty.setraw(near)
    words = [sys.executable, "-m", "palpate", "bridge", kind, "--port", os.ttyname(near)]
    with subprocess.Popen(
        [*words, "--listen", "127.0.0.1:0", "--allow-writes"],
        stderr=subprocess.PIPE,
        text=True,
        cwd=ROOT,
    ) as bridge:
        assert bridge.stderr
        told = bridge.stderr.readline()
        port = int(re.search(r"listening on 127.0.0.1:(\d+)", told)[1])
        with socket.create_connection(("127.0.0.1", port)) as client:
            coil = bytes.fromhex("000100000006010500000000 00010000000601050000ff00")  # 0, then 1
            client.sendall({"tcp": b"PPLP START\r\n", "modbus": coil}[kind])
            assert select.select([far], [], [], 30)[0]
            bridge.send_signal(signal.SIGINT)
            rest = bridge.communicate(timeout=60)[1]
    os.close(far)
    os.close(near)
    assert (bridge.returncode, "Traceback" in rest) == (130, False), rest


def test_a_serial_line_that_is_not_there_gets_a_warning(caplog):
    """A port that does not exist is named; sockets and existing ports are not."""
    warn_of(settled("modbus", "--port", "/dev/nonexist"))
    assert "/dev/nonexist" in caplog.text
    caplog.clear()
    warn_of(settled("modbus", "--port", "/dev/null"))
    warn_of(settled("tcp", "--port", "socket://127.0.0.1:9"))
    assert not caplog.text


def test_settings_of_a_new_box_and_options():
    """Modbus reads the feed here, without commands; options are not changed by settings."""
    args = settled("modbus")
    assert (args.feed, args.listen) == ("/run/palpate/feed.sock", "127.0.0.1:1502")
    assert (args.link, args.allow_writes) == (None, False)
    with pytest.raises(ConfigError, match="/run/palpate-tcp/line"):
        settled("tcp")
    sets = (f"serial.port={LINKS['tcp']}", "bridge.address=192.168.0.10")
    options = ("--port", "/dev/ttyUSB0", "--listen", "[::1]:7", "--allow-writes")
    args = settled("tcp", *options, sets=sets)
    assert (args.port, args.listen) == ("/dev/ttyUSB0", "[::1]:7")
    assert (args.link, args.allow_writes) == (None, True)
    assert settled("modbus", "--feed", "/tmp/x", sets=sets).feed == "/tmp/x"


@pytest.mark.parametrize("kind", LINKS)
def test_the_line_of_the_bridge(kind):
    """serial.port names its link: the bridge makes it, with the address of the settings."""
    sets = (f"serial.port={LINKS[kind]}", "bridge.address=192.168.0.10", "bridge.allow_writes=true")
    args = settled(kind, sets=sets)
    assert (args.link, args.allow_writes) == (Path(LINKS[kind]), True)
    if kind in PORTS:
        assert args.listen == f"192.168.0.10:{PORTS[kind]}"


@pytest.mark.parametrize(
    "sets",
    [
        ("bridge.allow_writes=true",),
        ("store.runtime=",),
        ("serial.port=/dev/ttyAMA0", "store.runtime="),
    ],
)
def test_no_way_to_the_box(sets):
    """Commands without a line, or neither line nor feed: refused, with what to set."""
    with pytest.raises(ConfigError, match="/run/palpate-modbus/line"):
        settled("modbus", sets=sets)


@pytest.mark.parametrize(
    "options",
    [
        ("tcp", "--feed", "x"),
        ("ros", "--port", "x"),
        ("modbus", "--feed", "x", "--port", "y"),
        ("modbuss",),
    ],
)
def test_options_that_do_not_fit(options):
    """An option of another kind, or two ways to the box: exit code 2."""
    with pytest.raises(SystemExit) as ended:
        settled(*options)
    assert ended.value.code == 2


def test_a_module_that_a_library_hardly_uses(tmp_path, monkeypatch):
    """It is loaded at its first use, and by the next import of another."""
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "hardly").mkdir()
    for name in ("used", "unused"):
        (tmp_path / "hardly" / f"{name}.py").write_text("VALUE = 1")
    with needed("a library", "extra", "hardly.used", "hardly.unused"):
        from hardly import unused, used
    assert not {"hardly.used", "hardly.unused"} & {*sys.modules}
    assert used.VALUE == 1
    assert "hardly.used" in sys.modules
    assert import_module("hardly.unused") is not unused
    assert unused.VALUE == 1


@pytest.mark.parametrize("kind", ["mqtt", "opcua"])
def test_modules_that_the_bridges_leave_out(kind, tmp_path):
    """They take more than a MiB, and no bridge needs them."""
    pytest.importorskip({"mqtt": "paho.mqtt", "opcua": "asyncua"}[kind])
    own = {"mqtt": ("--broker", "none"), "opcua": ("--folder", str(tmp_path))}[kind]
    words = [kind, "--feed", "none", *own]
    code = "import sys; from palpate.bridges import command\n"
    code += f"print(command.main({words}), [*sys.modules])"
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert ran.stdout.startswith("78 "), ran.stderr
    assert f"'palpate.bridges.{kind}'" in ran.stdout
    assert not [m for m in ("'http.client'", "'shelve'", "'anyio'") if m in ran.stdout]
