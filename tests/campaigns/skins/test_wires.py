"""The bytes of the emulated skins against bytes put together by hand from layouts."""

import numpy as np

from palpate.io import skin_profile
from palpate.io.skin_codecs import Rest, codec
from tests.factories.paths import ROOT
from tests.factories.skins import wires

PREVIEW = bytes.fromhex(
    "556677880201001b0003002700040029020500630206000f0307002b0300004efa320031aa768f0000000002002d002b01"
    "090041005b0075008f00a900c300dd"
)
"""The first bytes that a real PapillArray controller (v2.0, two sensors) sent to a user, published
in the tests of the project langxin11/parallel_gripper_tactile."""


def test_papillarray_as_a_controller_sends_it() -> None:
    """Two sensors, to the byte; sum and end marker follow from the layout."""
    sent = wires.PapillArray(counter=0x32FA4E).frame(np.zeros((6, 3, 3), np.float32), 0x8F76AA31)
    assert sent.startswith(PREVIEW)
    body = sent[4:-6]
    assert sent[-6:] == (sum(body) % 65536).to_bytes(2, "little") + bytes.fromhex("aabbccdd")


def test_a_zero_that_is_missing_makes_no_frame() -> None:
    """Wherever a zero byte is missing, the box reads the frame as sent, or none."""
    profile = skin_profile.load("papillarray", [ROOT / "firmware_config" / "skins"])
    force = np.arange(27, dtype=np.float32).reshape(3, 3, 3)
    sent = wires.PapillArray().frame(force, 1000)
    taken = 0
    for at in (i for i, byte in enumerate(sent) if not byte):
        for taxels in codec(profile)(Rest(), sent[:at] + sent[at + 1 :]).taxels:
            assert (taxels == force).all()
            taken += 1
    assert taken > 0  # the bytes after the forces do not matter
