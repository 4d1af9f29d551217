"""The bytes of the emulated skins, compared with bytes put together by hand from the published
layouts. None of the skins was available."""

import struct

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


def test_papillarray_commands() -> None:
    """f sets a rate, in parts too; z makes two seconds' mean the zero; no answers."""
    skin = wires.PapillArray(1000)
    assert skin.receive(b"f2") == b""
    assert skin.period_ns == 1e6
    assert skin.receive(b"50\nf300\nf\nfast\n") == b""
    assert skin.period_ns == 4e6
    skin.receive(b"f100\nz\n")
    forces = []
    for i in range(202):
        sent = skin.frame(np.full((3, 3, 3), 1.0 + i % 2), 0)
        table = dict(struct.unpack_from("<HH", sent[4:], 1 + 4 * i) for i in range(6))
        (total,) = struct.unpack_from("<xxxxH", sent[4:], table[4] - 2)
        forces.append(struct.unpack_from("<f", sent[4:], total + 2)[0] / 9)
    assert forces[:199] == [1.0 + i % 2 for i in range(199)]
    assert forces[-2:] == [-0.5, 0.5]


def test_slcan() -> None:
    """As Lawicel's; the sensor is quiet until the channel is open and started."""
    skin = wires.Slcan(100)
    taxels = np.arange(48).reshape(4, 4, 3).astype(np.uint16) + 0x1234
    assert skin.receive(b"t20120700\rO\rS9\r") == b"\a\a\a"
    assert skin.receive(b"S6\rO\rt20120700\rC\r") == b"\r\r\a\r"
    assert skin.receive(b"S8\rO\rO\rS8\r") == b"\r\r\a\a"
    assert not skin.streaming
    assert skin.receive(b"t20220700\rt20110") == b"z\r"  # another CAN board
    assert not skin.streaming
    assert skin.receive(b"7\rt20120700\r\rV\rX\r") == b"z\rz\r\rV1013\r\a"
    assert skin.streaming
    first, *_, last, empty = skin.frame(taxels, 0).split(b"\r")
    assert first == b"t71080012341235123600"
    assert last == b"t71F80012611262126300"
    assert empty == b""
    skin.invalid = frozenset({0})
    assert skin.frame(taxels, 0).startswith(b"t710800FA34")
    assert skin.receive(b"C\r") == b"\r"
    assert not skin.streaming


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
