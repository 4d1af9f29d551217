"""Settings: layers and their sources, all faults of a file, and the board files as wiring plans."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import re
import tomllib
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from palpate.core import config, schema
from palpate.core.errors import ConfigError
from tests.factories.paths import ROOT

FIRMWARE = ROOT / "firmware_config"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with `skin.toml`, two boards and an empty `palpate.toml`."""
    (tmp_path / "skin.toml").write_text(
        "[skin]\nsilence_ms = 50\nrate_hz = 300\n[trigger]\nglitch_us = 100\n"
    )
    (tmp_path / "board-a.toml").write_text(
        '[trigger]\nstart = "L1"\nstop = "L2"\nglitch_us = 200\n'
    )
    (tmp_path / "board-b.toml").write_text('[output]\nready = "L9"\n')
    (tmp_path / "palpate.toml").write_text("")
    return tmp_path


def _load(folder: Path, board: str | None = None, *sets: str) -> config.Config:
    return config.load(board, sets, folder=folder, site=folder / "palpate.toml")


def _shipped(board: str | None = None, *sets: str) -> config.Config:
    """The files of this repository, without those of this machine in /etc."""
    return config.load(board, sets, folder=FIRMWARE, site=Path(os.devnull))


def test_later_layers_win_and_each_value_knows_its_source(folder):
    """Each layer decides one value; of two --set the last wins."""
    (folder / "palpate.toml").write_text("[trigger]\nglitch_us = 300\nactive_low = true\n")
    sets = ("trigger.glitch_us=9", "trigger.glitch_us=400", "serial.port=/dev/ttyUSB0")
    c = _load(folder, "a", *sets)
    assert (c.board, c.sources["board"]) == ("a", "--board")
    for name, value, source in (
        ("output.settle_us", 200, "code"),
        ("skin.silence_ms", 50, "skin.toml"),
        ("trigger.start", "L1", "board-a.toml"),
        ("trigger.active_low", True, "palpate.toml"),
        ("trigger.glitch_us", 400, "--set"),
        ("serial.port", "/dev/ttyUSB0", "--set"),
    ):
        section, key = name.split(".")
        assert (getattr(getattr(c, section), key), c.sources[name]) == (value, source), name
    sections = config.Config.__slots__[1:-2]
    assert len(c.sources) == 1 + sum(len(schema.keys(type(getattr(c, s)))) for s in sections)


def test_a_board_is_named_by_file_or_option_or_not_at_all(folder, tmp_path):
    """--board wins over palpate.toml; without either, the defaults wire no line."""
    (folder / "palpate.toml").write_text('board = "a"\n')
    assert (_load(folder).trigger.start, _load(folder).sources["board"]) == ("L1", "palpate.toml")
    assert (_load(folder, "b").trigger.start, _load(folder, "b").output.ready) == ("", "L9")
    (bare := tmp_path / "bare").mkdir()
    (bare / "palpate.toml").write_text("")
    c = _load(bare)
    assert set(c.sources.values()) == {"code"}
    assert c.trigger == config.TriggerConfig()
    assert (c.output.ready, c.output.class_bits, c.trigger.start, c.serial.port) == ("", (), "", "")


@pytest.mark.parametrize(
    ("text", "name", "hint"),
    [
        ("[trigger]\nglich_us = 3", "trigger.glich_us", "trigger.glitch_us?"),
        ("[skin]\nsettle_us = 9", "skin.settle_us", "output.settle_us?"),
        ("[triger]\nmode = 'one-line'", "triger", "mean trigger?"),
        ("[gpio]\nx = 1", "gpio", "known are skin, trigger"),
        ("settle_us = 9", "settle_us", "output.settle_us?"),
        ("skin = 5", "skin = 5", "[skin]"),
        ("[trigger]\nglitch_us = 0", "glitch_us = 0", "from 1 to 1000000"),
        ("[trigger]\nglitch_us = true", "glitch_us = True", "whole number"),
        ("[trigger]\nactive_low = 1", "active_low = 1", "true or false"),
        ("[trigger]\nmode = 'both'", "mode = 'both'", '"two-lines", "one-line"'),
        ("[classifier]\nfuse = ['vote']", "fuse = ['vote']", '"product", "vote"'),
        ("[trigger]\nstart = 17", "start = 17", "string in quotes"),
        ('[trigger]\nstart = "a\\u0000"', r"start = 'a\x00'", "control characters"),
        ("[output]\nclass_bits = 'GPIO16'", "class_bits = 'GPIO16'", '["GPIO16"]'),
        ("[output]\nclass_bits = ['A', '']", "class_bits = ['A', '']", '["GPIO16"]'),
        ("[sweep]\nmax_duration_s = nan", "max_duration_s = nan", "0.1 to 3600.0"),
        ("[skin]\nusb = '1209'", "skin.usb = '1209'", '"1209:7ac7"'),
        ("[skin]\nusb = 0x1209", "skin.usb = 4617", '"1209:7ac7"'),
        ("[skin]\ntimeout_ms = 9", "skin.timeout_ms", "mean skin."),
        ("[skin\nport = 1", "not TOML", "line 1"),
        ("[skin]\n\nlink = vendor", "not TOML", "line 3"),
    ],
)
@pytest.mark.parametrize("file", ["skin.toml", "board-a.toml", "palpate.toml"])
def test_a_wrong_file_is_told_with_the_key_and_what_is_allowed(folder, file, text, name, hint):
    """The same mistakes in each layer's file: the message has path, key with value, and advice."""
    (folder / file).write_text(text)
    with pytest.raises(ConfigError) as e:
        _load(folder, "a")
    assert all(part in str(e.value) for part in (str(folder / file), name, hint))


@pytest.mark.parametrize(
    ("option", "said"),
    [
        ("trigger.glich_us=3", "trigger.glitch_us"),
        ("serial.baud=fast", "serial.baud = 'fast'"),
        ("skin.grid=1234", "skin.grid = 1234"),
        ("glitch_us=3", "section.key=value"),
    ],
)
def test_a_wrong_set_option_is_told(folder, option, said):
    """--set goes through the same checks as a file."""
    with pytest.raises(ConfigError, match=f"^--set.*{said}"):
        _load(folder, None, option)


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("trigger.start=GPIO5", "GPIO5"),
        ("trigger.start=", ""),
        ('skin.grid="1234"', "1234"),
        ("sweep.max_duration_s=3", 3.0),
        ('output.class_bits=["A", "B"]', ("A", "B")),
        ("serial.port=/dev/ttyS0 # not a comment", "/dev/ttyS0 # not a comment"),
        ('serial.port="a" x=1', '"a" x=1'),
    ],
)
def test_set_takes_toml_or_a_bare_string(folder, option, value):
    """A text that is not one TOML value is used as a string."""
    section, key = option.partition("=")[0].split(".")
    got = getattr(getattr(_load(folder, None, option), section), key)
    assert (got, type(got)) == (value, type(value))


@pytest.mark.parametrize("board", ["c", "../a", "a.toml", 0, [], ["a"], True])
def test_a_missing_board_lists_the_boards_there(folder, board):
    """By option and by file; no name leads out of the folder."""
    (folder / "palpate.toml").write_text(f"board = {json.dumps(board)}\n")
    with pytest.raises(ConfigError, match=r"a, b$"):
        _load(folder)
    if isinstance(board, str):
        with pytest.raises(ConfigError, match=r"--board: .*a, b$"):
            _load(folder, board)


def test_files_that_cannot_be_read_are_named(folder):
    """A named site file that is missing, a folder at its path, and bytes that are not UTF-8."""
    with pytest.raises(ConfigError, match=r"other\.toml"):
        config.load(None, folder=folder, site=folder / "other.toml")
    with pytest.raises(ConfigError, match="directory"):
        config.load(None, folder=folder, site=folder)
    (folder / "skin.toml").write_bytes(b'[skin]\ngrid = "\xff"\n')
    with pytest.raises(ConfigError, match=r"skin\.toml.*utf-8"):
        _load(folder)


_NAMES = ["skin.grid", "skin.usb", "serial.baud", "output.class_bits", "trigger.mode", "x.y"]


@pytest.mark.slow
@given(st.text(max_size=30), st.sampled_from(_NAMES))
def test_any_set_text_is_a_value_or_a_config_error(text, name):
    """No text raises another exception."""
    with contextlib.suppress(ConfigError):
        assert _shipped(None, f"{name}={text}").sources[name] == "--set"


def test_describe_gives_each_value_with_its_source_and_loads_again(folder):
    """The printed text is a palpate.toml with the same settings."""
    sets = [
        "output.class_bits=['A', 'B']",
        "skin.grid=Ü𝄞 \\",
        "sweep.max_duration_s=3",
        "trigger.active_low=true",
    ]
    c = _load(folder, "a", *sets)
    lines = config.describe(c).splitlines()
    assert len(lines) == len(c.sources)
    shown = {" ".join(line.split()) for line in lines}
    assert shown > {
        'board = "a" # --board',
        'skin.usb = "1209:7ac7" # code',
        'trigger.start = "L1" # board-a.toml',
    }
    (folder / "palpate.toml").write_text("\n".join(lines))
    assert _load(folder) == c


@pytest.mark.parametrize(
    ("usb", "ids"),
    [("1209:7ac7", (0x1209, 0x7AC7, "")), ("2E8A:0005:E661:4", (0x2E8A, 5, "E661:4"))],
)
def test_usb_ids_and_serial_number(folder, usb, ids):
    """One setting holds both."""
    skin = _load(folder, None, f"skin.usb={usb}").skin
    assert (skin.vendor_id, skin.product_id, skin.serial) == ids


def test_the_shipped_skin_toml_is_complete_and_names_no_board(folder):
    """It changes nothing; `board` there would be read too late."""
    table = tomllib.loads((FIRMWARE / "skin.toml").read_text())
    known = schema.keys(config.SkinConfig)
    assert table == {"skin": {name: key.default for name, key in known.items()}}
    (folder / "skin.toml").write_text('board = "a"\n')
    with pytest.raises(ConfigError, match=r"skin\.toml.*--board"):
        _load(folder)


_ODD = "3V3 2 3 4 GND 17 27 22 3V3 10 9 11 GND ID_SD 5 6 13 19 26 GND"
_EVEN = "5V 5V GND 14 15 18 GND 23 24 GND 25 8 7 ID_SC GND 12 GND 16 20 21"
HEADER = {
    first + 2 * i: f"GPIO{name}" if name.isdigit() else name
    for first, column in ((1, _ODD), (2, _EVEN))
    for i, name in enumerate(column.split())
}
"""The lines of the 40-pin header, by pin."""


@pytest.mark.parametrize(
    "board", sorted(path.stem.removeprefix("board-") for path in FIRMWARE.glob("board-*.toml"))
)
def test_the_drawing_of_a_board_shows_the_lines_that_its_values_name(board):
    """Each pin and role is where the header has it."""

    def page(board: str) -> str:
        return (FIRMWARE / f"board-{board}.toml").read_text()

    def drawing(board: str) -> tuple[dict[int, str], dict[str, str]]:
        """The drawing of a board file: {pin: name}, {role: name}, a role with the box's arrow."""
        rows = re.findall(
            r"^#\s+(?:(\w+(?: \d)?) ([<>])\s+)?(\w+)\s+\((\d+)\) \((\d+)\)\s+(\w+)(?: ([<>]) ([\w "
            r"]+))?$",
            page(board),
            re.MULTILINE,
        )
        pins, roles = {}, {}
        for left_role, left_way, left, odd, even, right, right_way, right_role in rows:
            pins |= {int(odd): left, int(even): right}
            for role, way, inward, line in (
                (left_role, left_way, ">", left),
                (right_role, right_way, "<", right),
            ):
                if role:
                    roles[f"{'in' if way == inward else 'out'} {role}"] = line
        return pins, roles

    c = _shipped(board)
    pins, roles = drawing(board)
    assert pins == HEADER
    wired = {f"in {name}": getattr(c.trigger, name) for name in ("start", "stop", "new_object")}
    wired |= {
        f"out {name}": getattr(c.output, name)
        for name in ("ready", "busy", "result_valid", "fault", "decided")
    }
    wired |= {f"out class_bits {i}": name for i, name in enumerate(c.output.class_bits)}
    assert roles == wired | {"out serial TXD": "GPIO14", "in serial RXD": "GPIO15"}
    beside = re.findall(r"^\w+ = (.*GPIO.*)# pins? ([\d, ]+)", page(board), re.MULTILINE)
    names, numbers = (re.findall(r"\w+", " ".join(column)) for column in zip(*beside, strict=True))
    assert names == [HEADER[int(pin)] for pin in numbers] == list(wired.values())


def test_one_cable_fits_both_boards_and_a_line_one_role(folder):
    """Raspberry Pi 4 and 5 agree on every value; both roles and sources are named."""
    four, five = map(_shipped, ("rpi4", "rpi5"))
    assert dataclasses.replace(four, board="rpi5") == five
    with pytest.raises(ConfigError) as e:
        _load(folder, "a", "output.busy=L1")
    for said in ("--set", "output.busy = 'L1'", "trigger.start", "board-a.toml"):
        assert said in str(e.value)
    with pytest.raises(ConfigError, match="class_bits"):
        _load(folder, None, "output.class_bits=['X', 'X']")


def test_rules_and_unit_agree_with_the_settings():
    """udev rules have the skin's ids; the unit's groups are sysusers'."""
    skin = config.SkinConfig()
    rules = (FIRMWARE / "70-palpate.rules").read_text()
    assert (
        rules.count(f'=="{skin.vendor_id:04x}"') == rules.count(f'=="{skin.product_id:04x}"') == 2
    )
    unit, users = (
        (ROOT / "systemd" / f"palpate.{kind}").read_text() for kind in ("service", "sysusers")
    )
    groups = set(re.findall(r"^SupplementaryGroups=(.*)$", unit, re.MULTILINE)[0].split())
    assert groups == set(re.findall(r"^g (\w+)", users, re.MULTILINE))
    assert set(re.findall(r'GROUP="(\w+)"', rules)) <= groups


def test_a_unit_has_settings_and_folders_of_its_name(tmp_path, monkeypatch):
    """The unit reads left.toml, not palpate.toml, and its default folders end in -left."""
    monkeypatch.setattr(config, "SITE", tmp_path / "palpate.toml")
    (tmp_path / "palpate.toml").write_text("[skin]\nport = '/dev/a'")
    (tmp_path / "left.toml").write_text("[skin]\nport = '/dev/b'\n[store]\nruntime = '/r'")
    left = config.load(None, unit="left")
    assert (left.skin.port, left.store.folder) == ("/dev/b", "/var/lib/palpate-left")
    assert str(left.store.feed) == "/r/feed.sock"
    for wrong, word in (("right", "right.toml"), ("Left", "Left"), ("../left", "left")):
        with pytest.raises(ConfigError, match=word):
            config.load(None, unit=wrong)
