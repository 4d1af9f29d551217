"""Skin profiles: all faults of a file, the changes by settings, and the delivered profiles."""

from __future__ import annotations

import contextlib
import json
import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from palpate.core import config
from palpate.core.config import SkinConfig
from palpate.core.errors import ConfigError
from palpate.core.types import SweepFormat
from palpate.io import skin_profile, skins
from palpate.io.skin_profile import SkinProfile, adapted, from_json, load, warning
from tests.factories.paths import NO_SITE, ROOT
from tests.factories.skin_wires import FOLDER, NAMES, profile

GOOD = 'about = "a"\nsource = "s"\ncodec = "fixed"\nmarker = "aa 55"\n'


def written(tmp_path: Path, text: str) -> Path:
    """A folder with own.toml."""
    (tmp_path / "own.toml").write_text(text)
    return tmp_path


@pytest.mark.parametrize(
    ("text", "hint"),
    [
        (GOOD + "row = 4", "row is unknown; did you mean rows?"),
        (GOOD + "rows = 0", "rows = 0 is not allowed; use a whole number from 1 to 255"),
        (GOOD + "rows = 256", "from 1 to 255"),
        (GOOD + "cols = 4.0", "a whole number"),
        (GOOD + 'number = "int64"', 'one of "uint8", "int16", "uint16", "float32"'),
        (GOOD + 'byte_order = "middle"', 'one of "little", "big"'),
        (GOOD + 'trailer = "0g"', "bytes in hexadecimal"),
        (GOOD + f'trailer = "{"00" * 17}"', "up to 16 bytes"),
        (GOOD + 'checksum = "crc9"', "parameters"),
        (GOOD + 'usb_ids = ["1a86-7523"]', 'USB ids such as ["1a86:7523"]'),
        (GOOD + 'usb_ids = "1a86:7523"', "USB ids such as"),
        (GOOD + "take = [1]", "take = [1] is not 1 to 8 different ones of 0 to 0"),
        (GOOD + "values = 3\ntake = [0, 0]", "different ones"),
        (GOOD + "take = []", "take = []"),
        (GOOD + "values = 9\ntake = [0, 1, 2, 3, 4, 5, 6, 7, 8]", "1 to 8"),
        (GOOD + 'orientation = ["upside-down"]', 'one of "transpose", "flip'),
        (GOOD + "rate_hz = 0", "a number from 0.1"),
        (GOOD + "baud = 600", "from 1200 to 4000000"),
        (GOOD + "rate_hz = nan", "a number from 0.1"),
        (GOOD + "rates_hz = [0]", "from 0.1 to 100000"),
        (GOOD + 'start = ["hex:9"]', "commands such as"),
        (GOOD + 'start = ["hex:01\u00a002"]', "commands such as"),
        (GOOD + "start = [1]", "commands such as"),
        (GOOD.replace('marker = "aa 55"\n', ""), "needs a marker or a trailer"),
        (GOOD.replace("fixed", "text"), "has marker"),
        (GOOD.replace("fixed", "csv"), 'one of "palpate", "fixed", "text", "papillarray"'),
        (GOOD.replace('about = "a"', ""), "about is missing; matrix.toml explains each key"),
        (GOOD.replace('source = "s"', 'source = ""'), "source is missing"),
        ('about = "a"\nsource = "s"\ncodec = "papillarray"', 'values = 6 and number = "float32"'),
        (
            'about = "a"\nsource = "s"\ncodec = "robotiq-tsf"\nnumber = "uint16"\n',
            "neither one finger",
        ),
        ('about = "a"\nsource = "s"\ncodec = "palpate"\nusb_ids = ["1a86:7523"]', "skin.link"),
        ("about = a", "not TOML"),
        ("x = [" * 3000, "not TOML"),
    ],
)
def test_a_wrong_file(tmp_path, text, hint):
    """Each mistake names the file, the key with its value, and the allowed values."""
    with pytest.raises(ConfigError) as e:
        load("own", [written(tmp_path, text)])
    assert str(tmp_path / "own.toml") in str(e.value)
    assert hint in str(e.value)
    assert "\n" not in str(e.value)


def test_names(tmp_path, monkeypatch):
    """Misspelt, out of the folder, empty; own profiles come first; `palpate` has none."""
    folder = written(tmp_path, GOOD)
    with pytest.raises(ConfigError, match="oven"):
        load("oven", [folder])
    for name in ("../own", ""):
        with pytest.raises(ConfigError, match="profile"):
            load(name, [folder])
    with pytest.raises(ConfigError, match=r"own\.toml"):
        load("own.toml", [folder])
    assert load(str(folder / "own.toml"), []) == load("own", [folder])
    (folder / "flexitac.toml").write_text(GOOD)
    assert load("flexitac", [folder, FOLDER]).about == "a"
    assert load("palpate", [folder]) == SkinProfile()
    with pytest.raises(ConfigError, match="none"):
        load("own", [tmp_path / "nowhere"])
    monkeypatch.setattr(skins, "OWN", written(tmp_path, GOOD))
    settings = config.load(None, ["skin.profile=own", "skin.grid=2x3"], site=NO_SITE)
    assert settings.folder == ROOT / "firmware_config"
    assert (skins.profile(settings).rows, skins.profile(settings).cols) == (2, 3)


@pytest.mark.parametrize("name", NAMES)
def test_delivered(name):
    """Each describes itself and its source, claims no measurement, and survives JSON."""
    p = profile(name)
    assert p.about
    assert p.source
    assert p.measured == ""
    assert from_json(json.loads(json.dumps(p.json())), "x") == p
    assert p.format.window == max(1, round(2 * p.rate_hz))


def test_modem_manager_leaves_each_skin_alone():
    """The rules that `make install` delivers name the USB ids of every delivered profile."""
    rules = (ROOT / "firmware_config" / "70-palpate.rules").read_text()
    ignored = 'SUBSYSTEM!="tty", GOTO="palpate_skins_end"', 'LABEL="palpate_skins_end"'
    lines = rules.split(ignored[0])[1].split(ignored[1])[0].splitlines()
    named = [
        re.search(r'idVendor}=="(\w{4})", ATTRS{idProduct}=="(\w{4})"', line)
        for line in lines
        if line
    ]
    assert all(
        'ENV{ID_MM_DEVICE_IGNORE}="1"' in line and 'ENV{ID_MM_PORT_IGNORE}="1"' in line
        for line in lines
        if line
    )
    assert sorted(f"{ids[1]}:{ids[2]}" for ids in named if ids) == sorted(
        usb_id for name in NAMES for usb_id in profile(name).usb_ids
    )


@pytest.mark.parametrize(
    ("name", "settings", "wanted"),
    [
        ("flexitac", {"grid": "12x32"}, SweepFormat(12, 32, 100, 200, "uint8")),
        ("flexitac", {"grid": "16x16", "rate_hz": 50.0}, SweepFormat(16, 16, 50, 100, "uint8")),
        (
            "papillarray",
            {"grid": "6x3", "rate_hz": 250.0},
            SweepFormat(6, 3, 250, 500, "float32", 3),
        ),
        ("anyskin", {}, SweepFormat(5, 1, 28, 56, "float32", 3)),
    ],
)
def test_settings_change_a_profile(name, settings, wanted):
    """Grid and rate come from the settings where they are set."""
    new = adapted(profile(name), SkinConfig(**settings))
    assert (new.format, new.baud) == (wanted, profile(name).baud)


@pytest.mark.parametrize(
    ("name", "settings", "hint"),
    [
        ("flexitac", {"grid": "12*32"}, "skin.grid = '12*32' is not allowed; use rows x columns"),
        ("flexitac", {"grid": "0x4"}, "rows x columns"),
        ("flexitac", {"grid": "300x4"}, "rows x columns"),
        (
            "papillarray",
            {"rate_hz": 300.0},
            "skin.rate_hz = 300 cannot be set on this skin; use one of 100, 250",
        ),
        ("robotiq-tsf", {"grid": "5x5"}, "neither one finger"),
    ],
)
def test_settings_that_do_not_fit(name, settings, hint):
    """The error names the setting and the allowed values."""
    with pytest.raises(ConfigError) as e:
        adapted(profile(name), SkinConfig(**settings))
    assert hint in str(e.value)


def test_what_each_lacks():
    """Only a skin that counts its frames shows loss; PROTOCOL.md announces its grid itself."""
    # Delivered profiles with a checksum and without a count
    summed = ("bota-serial", "dfrobot-tactile", "paxini", "synria")
    for settings in ({"grid": "4x4"}, {"rate_hz": 100.0}):
        with pytest.raises(ConfigError, match=r"skin\..*PROTOCOL"):
            adapted(SkinProfile(), SkinConfig(**settings))
    assert {name: profile(name).lacks for name in NAMES} == {
        name: ()
        if name == "papillarray"
        else ("sequence", "time", "checksum")[: 2 if name in summed else 3]
        for name in NAMES
    }
    assert SkinProfile(codec="fixed", marker=b"\xaa", sequence="uint8").lacks == (
        "time",
        "checksum",
    )


def test_commands_and_slow_skins():
    """Rate and period are put in; below 200 frames the finest texture is named."""
    p = SkinProfile()
    texts = ["f{rate}\n", "p{period_ms}\n", "hex:9a 00 {period_ms}", "\x00\xff"]
    assert p.commands(texts, 250.0) == [b"f250\n", b"p4\n", b"\x9a\x00\x04", b"\x00\xff"]
    assert p.commands(["hex:{period_ms}"], 0.5) == [b"\xff"]
    assert p.commands(["hex:{period_ms}"], 5000) == [b"\x01"]
    assert p.commands(["hex:01 {sum8} 02 {sum8}"], 250.0) == [b"\x01\x01\x02\x04"]
    assert warning(SweepFormat(4, 4, 100, 200, "uint8")) == ""
    assert "56" in warning(SweepFormat(5, 1, 28, 56, "float32", 3))
    assert "1.5" in warning(SweepFormat(5, 1, 28, 56, "float32", 3))


@given(
    st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats() | st.text(), st.lists, max_leaves=5
    )
)
@pytest.mark.slow
def test_any_value_of_any_key_is_taken_or_refused(value):
    """Any value in a file gives a profile or a ConfigError."""
    for key in skin_profile._KEYS:
        with contextlib.suppress(ConfigError):
            assert from_json(
                {"about": "a", "source": "s", "codec": "fixed", "marker": "aa55", key: value}, "own"
            ).format
