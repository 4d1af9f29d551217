"""`skin detect` and `skin list`: by ids or by listening; nothing is written unasked."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib

import pytest

from palpate.cli.main import main
from palpate.io import packets, skin_profile
from palpate.io.serial_port import PortInfo
from palpate.sim.rig import VirtualClock
from palpate.tools import pseudo_terminal, skin_detect
from palpate.tools.skin_detect import PortFinding
from tests.factories.skin_wires import FOLDER, NAMES, WirePort, profile, wire

PROFILES = {name: skin_profile.load(name, [FOLDER]) for name in ["palpate", *NAMES]}
PORT = PortInfo("/dev/ttyUSB0", 0x1A86, 0x7523, "", "USB Serial")


def found_on(
    port: WirePort, clock: VirtualClock, info: PortInfo = PORT, **options: bool
) -> PortFinding:
    """The finding on a port."""
    (found,) = skin_detect.Ports(port.open, clock).detect([info], PROFILES, **options)
    return found


@pytest.mark.parametrize(
    ("name", "rate"), [*((name, 1.0) for name in NAMES), ("flexitac", 0.8), ("papillarray", 0.8)]
)
def test_every_skin_is_found(name, rate):
    """A streaming skin is found with profile, rate and settings; not a byte is written."""
    clock, p = VirtualClock(), profile(name)
    port = WirePort(clock, lambda i: wire(name, i), p.format.period_ns / rate)
    found = found_on(port, clock)
    assert found.profile == name
    assert re.search(f'"{name}", .*"/dev/ttyUSB0"', found.detail)
    assert port.sent == []
    assert not port.is_open
    hz = float(found.detail.split(" at ")[1].split(" Hz")[0])
    assert hz == pytest.approx(p.rate_hz * rate, rel=0.03)
    assert ("skin.rate_hz" in found.detail) == (rate != 1 and not p.rates_hz)


def test_another_grid_of_a_known_skin():
    """The marks of a matrix at another distance: the number of its taxels, and what to set."""
    clock = VirtualClock()
    port = WirePort(clock, lambda i: b"\xaa\x55" + bytes((i + k) % 160 for k in range(384)), 1e7)
    found = found_on(port, clock)
    assert "384" in found.detail
    assert "matrix.toml" in found.detail
    assert found.profile in ("flexitac", "matrix")


def test_skins_and_boards_that_have_to_be_asked():
    """Nothing is written without --write; with it they are found, and stopped."""
    clock, p = VirtualClock(), profile("robotiq-tsf")
    start = p.commands(p.start, p.rate_hz)[0]
    port = WirePort(clock, lambda i: b"", p.format.period_ns)
    port.frames = lambda i: wire("robotiq-tsf", i) if start in port.sent else b""
    found = found_on(port, clock)
    assert (found.profile, port.sent) == ("", [])
    assert "robotiq-tsf" in found.detail
    assert "--write" in found.detail
    assert found_on(port, clock, write=True).profile == "robotiq-tsf"
    assert port.sent[-1] == p.commands(p.stop, p.rate_hz)[-1]
    clock = VirtualClock()
    who = packets.pack_reply(
        packets.Request.IDENTITY, packets.pack_identity(packets.Identity(1, (1, 0, 0), "pico", "7"))
    )
    port = WirePort(clock, lambda i: b"", 1e7)
    port.frames = lambda i: who if port.sent[-1:] == [bytes([packets.Request.IDENTITY])] else b""
    found = found_on(port, clock, write=True)
    assert found.profile == "palpate"
    assert "PROTOCOL.md" in found.detail
    assert "skin.link" in found.detail


@pytest.mark.parametrize(
    "sent", [b"hello world\n", bytes(range(256)), b"\xaa\x55", b"\x0d\x0a" * 40]
)
def test_something_else_is_no_skin(sent):
    """Bytes without frames: no profile, and the file that describes a skin."""
    clock = VirtualClock()
    found = found_on(WirePort(clock, lambda i: sent, 1e7), clock)
    assert found.profile == ""
    assert "matrix.toml" in found.detail


def test_a_port_that_is_held():
    """The other ports are still examined."""
    clock = VirtualClock()
    held = WirePort(clock, lambda i: b"", 1e7, busy=True)
    free = WirePort(clock, lambda i: wire("matrix", i), 1e7)
    ports = {"/dev/a": held, "/dev/b": free}
    infos = [PortInfo(path, 1, 2) for path in ports]
    listener = skin_detect.Ports(lambda path, baud: ports[path].open(path, baud), clock)
    first, second = listener.detect(infos, PROFILES)
    assert first.profile == ""
    assert "another program" in first.detail
    assert second.profile == "matrix"


def test_the_commands(capsys, tmp_path, monkeypatch):
    """Tables, an unreadable profile, --write needs --port, a silent port."""
    assert main(["skin", "list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert {line.split()[0] for line in lines} >= set(PROFILES), (
        "this computer may have others in /etc/palpate"
    )
    assert lines[0].split() == ["profile", "format", "lacks", "skin"]
    flexitac = next(line for line in lines if line.startswith("flexitac"))
    assert flexitac[lines[0].index("lacks") :].startswith("sequence, time, chec")
    assert sum("measured" in line for line in lines) == 1
    assert main(["skin", "detect", "--write"]) == 78
    assert "--port" in capsys.readouterr().err
    monkeypatch.setattr(skin_detect, "LISTEN_S", 0.05)
    with pseudo_terminal.pair() as (far, path):
        assert main(["skin", "detect", "--port", path]) == 1
        told = capsys.readouterr()
        assert f"{path}: no profile fits" in told.out
        assert f"listening at {path}" in told.err
        with pytest.raises(BlockingIOError):
            os.read(far, 1)
    (tmp_path / "skins").mkdir()
    (tmp_path / "skins" / "broken.toml").write_text("rows = 0\n")
    assert main(["skin", "list", "--config-dir", str(tmp_path)]) == 1
    assert "255" in capsys.readouterr().out


LOG = b"\x1b[0;32mI (%d) wifi: pm start, type: 1\x1b[0m\n"


def numbers(i: int, wide: int = 16) -> bytes:
    """A line of numbers."""
    return (",".join(str(100 + (i * i + k) % 97) for k in range(wide)) + "\n").encode()


def rows(i: int) -> bytes:
    """Four lines of six numbers."""
    return b"".join(numbers(i + k, 6) for k in range(4))


@pytest.mark.parametrize(
    ("sent", "grid", "taxels"),
    [
        (numbers, None, "4 x 4"),
        (lambda i: LOG % i * (i % 50 == 3) + numbers(i), None, "4 x 4"),
        (lambda i: LOG % i * (i % 50 == 3) + numbers(i), (4, 4), "4 x 4"),
        (lambda i: LOG % i * (i % 4 == 3) + numbers(i), (2, 8), "2 x 8"),
        (lambda i: b"Frame %d\n" % i + b"".join(numbers(i + k) for k in range(8)), None, ""),
        (lambda i: b"\n" + b"".join(numbers(i + k) for k in range(4)), (4, 16), "4 x 16"),
        (lambda i: b"Frame %d\n" % i + rows(i), (4, 6), "4 x 6"),
        (lambda i: b"<start>\n" + rows(i) + b"<end>\n", (4, 6), "4 x 6"),
        (lambda i: b"<start>\n" + rows(i) + b"<end>\n", (6, 4), ""),
        (lambda i: b"<start>\n" + rows(i) + b"<end>\n", None, ""),
        (lambda i: b"%d," % (i * i % 7 < 2) + numbers(i, 15), (4, 4), "4 x 4"),
        (lambda i: b"".join(b"%d,%d\n" % (k, i) for k in range(i % 3, 16, 3)), None, ""),
        (lambda i: numbers(i).replace(b"\n", b";\n"), None, "4 x 4"),
        (lambda i: b"\x1b[0;32mI (%d) s: " % i + numbers(i)[:-1] + b"\x1b[0m\n", None, "4 x 4"),
        (lambda i: b"%d\n" % i, None, ""),
        (numbers, (3, 4), ""),
        (lambda i: bytes([200, i % 256]) * 20, None, ""),
    ],
)
def test_lines_of_numbers_are_described(sent, grid, taxels):
    """Log lines between frames are passed over; frames of several lines need their grid.
    Numbers of taxels and taxels that flicker are told apart."""
    clock = VirtualClock()
    port = WirePort(clock, sent, 1e7)
    text, heard = skin_detect.Ports(port.open, clock).propose("/dev/a", {}, grid)
    assert text.startswith(f'about = "{taxels} taxels' if taxels else "")
    assert bool(text) == bool(taxels)
    if text:
        profile = skin_profile.from_json(tomllib.loads(text), "proposed")
        assert skin_detect.measured_hz(profile, heard) == pytest.approx(profile.rate_hz, rel=0.02)


@pytest.mark.parametrize(
    "sent",
    [
        "Press any key\r\n",
        "Press any key: ",
        "Start? \n\n",
        "Dr\u00fccken!\n",
        "\x1b[1mOK\x1b[0m\n",
    ],
)
def test_other_text_is_shown(sent):
    """A prompt, with or without the end of a line, that comes again while nobody answers."""
    clock = VirtualClock()
    found = found_on(WirePort(clock, lambda i: sent.encode(), 1e9), clock)
    assert found.profile == ""
    assert re.search(r"\w+", sent.replace("\x1b[1m", ""))[0] in found.detail


@pytest.mark.parametrize("baud", [9600, 57600, 250000, 500000])
def test_other_speeds_are_tried_until_one_gives_text(baud):
    """Most sketches begin with 9600; another speed gives bytes that are no text."""
    clock = VirtualClock()
    ports = {
        right: WirePort(clock, (lambda i: bytes([200] * 9), numbers)[right], 1e7)
        for right in (False, True)
    }
    text, _ = skin_detect.Ports(lambda p, b: ports[b == baud].open(p, b), clock).propose(
        "/dev/a", {}
    )
    assert f"baud = {baud}" in text


@pytest.mark.parametrize(("sent", "code"), [(numbers, 0), (lambda i: b"Press any key\n", 69)])
def test_a_profile_is_written(capsys, tmp_path, monkeypatch, sent, code):
    """It loads; wrong names and grids are refused before the port is opened."""
    clock = VirtualClock()
    opened = lambda path, baud, *_, **how: WirePort(clock, sent, 1e7).open(path, baud)  # noqa: E731
    monkeypatch.setattr("palpate.io.serial_sensor.SerialLink", opened)
    monkeypatch.setattr("palpate.cli.skin_commands.SystemClock", lambda: clock)
    words = ["skin", "new", "mine", "--port", "/dev/a", "--out", str(tmp_path), "--grid"]
    assert main([*words, "4x4"]) == code
    told = capsys.readouterr()
    if code:
        assert "Press any key" in told.err
        assert not list(tmp_path.iterdir())
        return
    made = skin_profile.load(str(tmp_path / "mine.toml"), [])
    assert (made.rows, made.cols, made.baud) == (4, 4, 115200)
    assert main([*words, "4x4"]) == 78
    assert main([*words[:2], "../a", *words[3:], "4x4"]) == 78
    assert main([*words[:2], "b", *words[3:], "4"]) == 78


def test_another_package_in_place_of_pyserial(tmp_path):
    """PyPI's serial has the same module; the message gives the commands."""
    (tmp_path / "serial").mkdir()
    (tmp_path / "serial" / "__init__.py").write_text("__version__ = '0'\n")
    ended = subprocess.run(
        [sys.executable, "-m", "palpate", "skin", "list"],
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert ended.returncode == 78
    assert "pip uninstall serial" in ended.stderr
    assert "Traceback" not in ended.stderr
