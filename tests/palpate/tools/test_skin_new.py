"""`palpate skin new` finds the frames of emulated skins, and writes profiles that decode them."""

from __future__ import annotations

import re
import tomllib
from dataclasses import replace
from pathlib import Path

import pytest

from palpate.cli.main import main
from palpate.core import config
from palpate.core.clock import SystemClock
from palpate.core.errors import ConfigError, SensorMismatch, SensorSilent
from palpate.io import skin_codecs, skin_profile, skins
from palpate.io.serial_port import PortInfo
from palpate.sim.rig import VirtualClock
from palpate.tools import skin_new
from palpate.tools.skin_new import PortSample
from palpate.tools.stream_analysis import Proposal, Read
from tests.factories.played_skins import Numbered, played

MARKED = Proposal(
    "marker", b"\xaa\x55", 18, "", "uint8", False, 16, ((4, 4, 1), (2, 8, 1)), 99.94, 0.99
)


class ScriptedPort:
    """A port that gives these reads, then nothing; time passes while it waits."""

    def __init__(self, clock: VirtualClock, reads: list[bytes]) -> None:
        self._clock, self._reads, self.closed = clock, reads, False

    def write(self, data: bytes) -> None:
        """Nothing may be sent."""
        raise AssertionError("an unknown skin must be told nothing")

    def read(self, size: int, timeout_ms: int) -> bytes:
        """The next of the reads."""
        self._clock.sleep_until(self._clock.now_ns() + min(timeout_ms, 10) * 1_000_000)
        return self._reads.pop(0) if self._reads else b""

    def close(self) -> None:
        """Note it."""
        self.closed = True


def test_the_first_speed_with_a_pattern_is_taken_and_every_port_is_closed() -> None:
    """The first speed with a pattern is taken and every port is closed."""
    clock, ports = VirtualClock(), []
    good = [b"\xaa\x55" + bytes((i * 7 * k) % 251 for k in range(1, 17)) for i in range(60)]

    def open_port(baud: int) -> ScriptedPort:
        ports.append(
            ScriptedPort(
                clock,
                good if baud == 9600 else [bytes([i * i % 256, 3 * i % 256]) for i in range(60)],
            )
        )
        return ports[-1]

    heard = skin_new.listen(open_port, (1200, 9600, 4800), 1.0, clock)
    assert heard.baud == 9600
    assert heard.proposals[0].values == 16
    assert len(ports) == 2
    assert all(port.closed for port in ports)


def test_silence_and_noise_are_told_apart() -> None:
    """Silence and noise cause different errors."""
    clock = VirtualClock()
    with pytest.raises(SensorSilent, match="nothing came in 1 s at 9600, 1200 baud"):
        skin_new.listen(lambda baud: ScriptedPort(clock, []), (9600, 1200), 1.0, clock)
    noise = [bytes((i * k * k + 91 * k) % 253 for k in range(40)) + bytes(i % 7) for i in range(30)]
    with pytest.raises(SensorMismatch, match=r"bytes at 9600 baud have no pattern"):
        skin_new.listen(lambda baud: ScriptedPort(clock, list(noise)), (9600,), 1.0, clock)


def test_a_proposal_in_words() -> None:
    """A proposal in words."""
    assert (
        skin_new.words(MARKED)
        == "18 bytes: marker aa 55, 16 x uint8; 99.9 Hz, 99% of the bytes; grids: 4x4, 2x8"
    )
    lines = Proposal("text", b"", 16, "", "uint16", False, 256, ((16, 16, 1),), 32.0, 1.0)
    assert skin_new.words(lines).startswith("16 lines of text: 256 x uint16")


@pytest.mark.parametrize("text", ["4x5", "4", "4x4x3", "0x16", "axb", "", "4x4x1x1"])
def test_a_grid_of_another_size_is_refused_with_those_that_fit(text: str) -> None:
    """A grid of another size is refused with those that fit."""
    with pytest.raises(ConfigError, match=r"no proposal.*4x4, 2x8"):
        skin_new.choose(PortSample(115_200, [], [MARKED]), text, 0)


def test_the_first_proposal_with_the_grid_is_taken_unless_one_is_named() -> None:
    """The first proposal with the grid is taken unless one is named."""
    longer = replace(MARKED, mark=b"\xaa", values=17, grids=((1, 17, 1),))
    heard = PortSample(115_200, [], [longer, MARKED, replace(MARKED, mark=b"U")])
    assert skin_new.choose(heard, "2x8", 0) == (MARKED, (2, 8, 1))
    assert skin_new.choose(heard, "4x4", 3)[0].mark == b"U"
    with pytest.raises(ConfigError, match="use 1 to 3"):
        skin_new.choose(heard, "4x4", 4)


@pytest.mark.parametrize(
    ("proposal", "grid"),
    [
        (MARKED, (4, 4, 1)),
        (Proposal("trailer", b"\r\n", 82, "", "float32", False, 20, (), 28.1, 1.0), (5, 1, 4)),
        (Proposal("marker", b"\x7e", 27, "uint16", "uint16", True, 12, (), 100.0, 1.0), (2, 2, 3)),
        (Proposal("text", b"", 16, "", "uint16", False, 256, (), 32.0, 1.0), (16, 16, 1)),
        (Proposal("text", b"", 1, "", "float32", False, 12, (), 32.0, 1.0), (3, 4, 1)),
    ],
)
def test_the_profile_that_is_written_can_be_read_and_holds_the_proposal(
    proposal: Proposal, grid: tuple[int, int, int]
) -> None:
    """The profile that is written can be read and holds the proposal."""
    text = skin_new.profile(proposal, grid, 2_000_000, PortInfo("/dev/ttyUSB0", 0x1A86, 0x7523))
    made = skin_profile.from_json(tomllib.loads(text), "test")
    assert (made.rows, made.cols, len(made.take)) == grid
    assert made.ids == [(0x1A86, 0x7523)]
    assert (made.number, made.sequence, made.baud) == (proposal.dtype, proposal.sequence, 2_000_000)
    assert made.byte_order == ("big" if proposal.big_endian else "little")
    assert {"marker": made.marker, "trailer": made.trailer, "text": b""}[
        proposal.framing
    ] == proposal.mark
    assert made.rate_hz == pytest.approx(proposal.rate_hz, rel=0.01)


def test_what_was_heard_is_read_with_the_new_profile() -> None:
    """The new profile decodes the bytes it was made from."""
    reads = [Read(i, b"\xaa\x55" + bytes(range(16))) for i in range(50)]
    text = skin_new.profile(MARKED, (4, 4, 1), 115_200, PortInfo("p"))
    frames, garbage = skin_new.decoded(text, [Read(0, b"boot"), *reads])
    assert frames >= 49
    assert garbage == 4


@pytest.mark.parametrize(
    ("name", "grid"), [("matrix", "4x4"), ("anyskin", "4x5"), ("3d-vitac", "16x16")]
)
def test_emulated_skins_are_described_and_read_again(
    name: str, grid: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The command, on the terminal of an emulated skin: without --grid it proposes, with it the
    profile is written."""
    with played(name) as player:
        common = ["skin", "new", "mine", "--seconds", "2", "--out", str(tmp_path)]
        common += ["--port", str(player.path), "--baud", "115200"]
        assert main(common) == 0
        assert not list(tmp_path.iterdir())
        told = capsys.readouterr()
        first = told.out.splitlines()[0]
        assert f"listening at {player.path}: 2 s at each speed" in told.err
        assert first.startswith("1: ")
        assert grid in first
        assert main([*common, "--grid", grid]) == 0
        assert main([*common, "--grid", grid]) == 78  # it is there now
    written = skin_profile.load("mine", [tmp_path])
    assert written.rate_hz == pytest.approx(Numbered(name).rate_hz, rel=0.25)
    out, err = capsys.readouterr()
    path = tmp_path / "mine.toml"
    assert out.splitlines()[-1].endswith(f"use it with --skin {path}")
    assert skins.profile(config.load(None, [f"skin.profile={path}"])) == written
    frames = int(re.search(r"mine.toml: decodes (\d+) frames", out)[1])
    assert frames > 0.5 * 2 * Numbered(name).rate_hz
    assert "already" in err
    assert "--replace" in err
    assert skin_codecs.codec(written)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (["Mine", "--port", "p"], "'Mine' cannot name a profile"),
        (["matrix", "--port", "/dev/null"], "there is a profile matrix already"),
        (
            ["mine", "--port", "/dev/no-such-port", "--grid", "4x4", "--out", "OUT"],
            "no port /dev/no-such-port",
        ),
        (
            ["mine", "--port", "/dev/no-such-port", "--grid", "4x4", "--out", "/proc/x"],
            "/proc/x cannot be made: no such",
        ),
    ],
)
def test_what_cannot_be_is_said_in_one_line(
    options: list[str], text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Impossible requests cause one line. A folder that cannot be written is refused before the
    command listens."""
    assert main(
        ["skin", "new", *(str(tmp_path) if option == "OUT" else option for option in options)]
    ) in (69, 78)
    assert text in capsys.readouterr().err


def test_clock_of_the_command_is_the_systems() -> None:
    """A port that never stops sending ends with the time, too."""
    clock = SystemClock()
    begun = clock.now_ns()
    with played("flexitac", paced=False) as player:
        assert (
            main(
                [
                    "skin",
                    "new",
                    "mine",
                    "--seconds",
                    "1",
                    "--port",
                    str(player.path),
                    "--baud",
                    "115200",
                ]
            )
            == 0
        )
    assert clock.now_ns() - begun < 60_000_000_000
