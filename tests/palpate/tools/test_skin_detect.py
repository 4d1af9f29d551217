"""`palpate skin detect` and `skin list`: every delivered skin is found by its ids or by listening;
nothing is written to a port unasked."""

from __future__ import annotations

import os

import pytest

from palpate.cli.main import main
from palpate.core.errors import SensorBusy
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
    (found,) = skin_detect.detect([info], PROFILES, port.open, clock, **options)
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
    assert f'skin.profile = "{name}", skin.port = "/dev/ttyUSB0"' in found.detail
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


def test_a_skin_that_has_to_be_asked():
    """Nothing is written without --write; with it the profile is found, and it is stopped."""
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


def test_a_board_of_the_protocol_has_to_be_asked():
    """With --write the identity is asked for, and the answer is the board's."""
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
    first, second = skin_detect.detect(
        infos, PROFILES, lambda path, baud: ports[path].open(path, baud), clock
    )
    assert first.profile == ""
    assert SensorBusy("port held by another program").args[0] in first.detail
    assert second.profile == "matrix"


def test_the_commands(capsys, tmp_path, monkeypatch):
    """list: a table of all profiles, and a line for one that cannot be read; detect: --write needs
    --port, a silent port says what to do."""
    assert main(["skin", "list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert {line.split()[0] for line in lines} >= set(PROFILES), (
        "this computer may have others in /etc/palpate"
    )
    assert lines[0].split() == ["profile", "format", "lacks", "skin"]
    flexitac = next(line for line in lines if line.startswith("flexitac"))
    assert flexitac[lines[0].index("lacks") :].startswith("sequence, time, checksum  FlexiTac")
    assert sum("measured" in line for line in lines) == 1
    assert main(["skin", "detect", "--write"]) == 78
    assert "--port" in capsys.readouterr().err
    monkeypatch.setattr(skin_detect, "LISTEN_S", 0.05)
    with pseudo_terminal.pair() as (far, path):
        assert main(["skin", "detect", "--port", path]) == 1
        told = capsys.readouterr()
        assert f"{path}: no profile fits: sends nothing unasked" in told.out
        assert f"listening at {path}; some seconds" in told.err
        with pytest.raises(BlockingIOError):
            os.read(far, 1)
    (tmp_path / "skins").mkdir()
    (tmp_path / "skins" / "broken.toml").write_text("rows = 0\n")
    assert main(["skin", "list", "--config-dir", str(tmp_path)]) == 1
    assert "255" in capsys.readouterr().out
