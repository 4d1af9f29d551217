"""The settings of a box with several fingers."""

from __future__ import annotations

from pathlib import Path

import pytest

from palpate.core import config, fingers
from palpate.core.errors import ConfigError

TWO = """
[skin]
silence_ms = 900

[skins.left]
usb = "1209:7ac7:L1"

[skins.right]
usb = "1209:7ac7:R1"
silence_ms = 300
bundle = "/a"
"""


def loaded(tmp_path: Path, text: str, *sets: str) -> config.Config:
    """The settings with `text` as the site's file."""
    site = tmp_path / "palpate.toml"
    site.write_text(text)
    return config.load(None, sets, site=site)


def test_a_finger_has_the_values_of_skin_unless_it_has_its_own(tmp_path: Path):
    """`finger` gives the settings of a box with this skin only, with the bundle of the finger."""
    c = loaded(tmp_path, TWO, "classifier.bundle=/b", "skins.left.tare=true")
    assert list(c.skins) == ["left", "right"]
    left, right = c.finger("left"), c.finger("right")
    assert (left.skin.serial, right.skin.serial) == ("L1", "R1")
    assert (left.skin.silence_ms, right.skin.silence_ms) == (900, 300)
    assert (left.skin.tare, right.skin.tare) == (True, False)
    assert (left.classifier.bundle, right.classifier.bundle) == ("/b", "/a")
    assert not left.skins
    assert c.sources["skins.right.silence_ms"] == "palpate.toml"
    assert c.sources["skins.left.tare"] == "--set"


def test_a_finger_without_values_of_its_own_is_described(tmp_path: Path):
    """Its table may be empty, as long as the others differ from [skin]."""
    c = loaded(tmp_path, "[skins.left]\n[skins.right]\nport = 'a'\n")
    assert list(c.skins) == ["left", "right"]
    assert c.sources["skins.left.part"] == "code"
    assert loaded(tmp_path, config.describe(c)).skins == c.skins


def test_describe_shows_what_a_finger_has_of_its_own_and_loads_again(tmp_path: Path):
    """The printed text is a palpate.toml with the same fingers."""
    c = loaded(tmp_path, TWO)
    text = config.describe(c)
    assert 'skins.left.usb = "1209:7ac7:L1"' in text
    assert "skins.left.silence_ms" not in text
    assert loaded(tmp_path, text).skins == c.skins


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("[skins.left]\nport = 'a'", r"has 1 finger\(s\), left; use 2 to 4, or \[skin\]"),
        (
            "".join(f"[skins.f{i}]\nport = '{i}'\n" for i in range(5)),
            r"has 5 finger\(s\).*use 2 to 4",
        ),
        ("skins = 3", r"skins = 3 has no finger's table; write \[skins.left\]"),
        ("[skins]\nleft = 3", r"skins = .* has no finger's table"),
        ("[skins.Left]\n", r"\[skins.'Left'\] is not a finger's name; use up to 8"),
        ('[skins."left\\n"]\n', r"\[skins.'left\\n'\] is not a finger's name; use up to 8"),
        ('[skins."../x"]\n', r"\[skins.'../x'\] is not a finger's name; use up to 8"),
        ('[skins."a,b"]\n', r"\[skins.'a,b'\] is not a finger's name; use up to 8"),
        ("[skins.left]\nprot = 'x'", r"skins.left.prot is unknown; did you mean port\?"),
        ('[skins.left]\n"\\u0001" = 2', r"'skins.left.\\x01' is unknown; known are profile"),
        ("[skins.left]\ntare = 2", "skins.left.tare = 2 is not allowed; use true or false"),
        ("[skins.left]\npart = '3/2 rows'", "skins.left.part = '3/2 rows' is not allowed; use a"),
        ('[skins.left]\npart = "1/2 rows\\n"', r"left.part = '1/2 rows\\n' is not allowed; use a"),
        (
            "[skins.left]\n[skins.right]\ntare = true",
            "skins.left and skins.right are the same skin; give each its own port",
        ),
    ],
)
def test_what_is_not_a_hand_is_refused(tmp_path: Path, text: str, match: str):
    """Each message names the value and what to write."""
    with pytest.raises(ConfigError, match=match):
        loaded(tmp_path, text)


def test_parts_of_a_hub():
    """A part is an index, the number of parts, and the axis along which they lie."""
    assert fingers.cut("2/3 rows") == (1, 3, 0)
    assert fingers.cut("1/2 columns") == (0, 2, 1)
    assert fingers.part("") == ""
    assert fingers.part(5) is None
