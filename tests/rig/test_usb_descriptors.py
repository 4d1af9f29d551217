"""Devices with false descriptors under the skin's ids: none is mistaken for a skin."""

import struct
from dataclasses import dataclass

from tests.rig.cell import Cell
from tests.rig.notes import HOW, Note
from tests.rig.sound import check_recovers, state, until_state
from tests.rig.usbredir import Descriptors

SOUND = Descriptors()
FACE, END = SOUND.configuration[9:18], SOUND.configuration[18:]
"""The interface's descriptor and the endpoint's."""


def whole(*parts: bytes, total: int | None = None, faces: int = 1) -> Descriptors:
    """A device with this configuration of `total` bytes and `faces` interfaces."""
    body = b"".join(parts)
    total = 9 + len(body) if total is None else total
    return Descriptors(
        configuration=struct.pack("<BBHBBBBB", 9, 2, total, faces, 1, 0, 0x80, 50) + body
    )


def put(data: bytes, at: int, *new: int) -> bytes:
    """The descriptor with other bytes at a place."""
    return data[:at] + bytes(new) + data[at + len(new) :]


@dataclass
class Spoken(Descriptors):
    """A device whose string descriptors are these bytes."""

    raw: bytes = b""

    def reply(self, kind: int, index: int) -> bytes | None:
        """As the right descriptors, except for the strings; the list of languages is right."""
        return self.raw if kind == 3 and index else super().reply(kind, index)


LIARS = {
    "no endpoint": whole(put(FACE, 4, 0)),
    "255 interfaces": whole(*(put(FACE, 2, i) + END for i in range(255)), faces=255),
    "an endpoint of length 0": whole(FACE, put(END, 0, 0)),
    "a total length of 9": whole(FACE, END, total=9),
    "a total length of 65535": whole(FACE, END, total=0xFFFF),
    "an interface of length 255": whole(put(FACE, 0, 255), END),
    "255 endpoints claimed": whole(put(FACE, 4, 255), END),
    "255 interfaces claimed": whole(FACE, END, faces=255),
    "interface number 200": whole(put(FACE, 2, 200), END),
    "class 8, mass storage": whole(put(FACE, 5, 8), END),
    "class 3, keyboard": whole(put(FACE, 5, 3), END),
    "an interrupt endpoint": whole(FACE, put(END, 3, 3)),
    "an endpoint OUT": whole(FACE, put(END, 2, 1)),
    "packets of 0 bytes": whole(FACE, put(END, 4, 0, 0)),
    "packets of 65535 bytes": whole(FACE, put(END, 4, 0xFF, 0xFF)),
    "no configuration": Descriptors(device=put(SOUND.device, 17, 0)),
    "255 configurations": Descriptors(device=put(SOUND.device, 17, 255)),
    "a device descriptor of length 8": Descriptors(device=put(SOUND.device, 0, 8)),
    "requests of 0 bytes": Descriptors(device=put(SOUND.device, 7, 0)),
    "an empty configuration": Descriptors(configuration=b""),
    "a configuration of noise": Descriptors(
        configuration=bytes((i * 37 + 11) & 255 for i in range(300))
    ),
    "strings of odd length": Spoken(raw=b"\x05\x03a\0b"),
    "strings that claim 255 bytes": Spoken(raw=b"\xff\x03a\0"),
    "strings of no bytes": Spoken(raw=b""),
    "strings that are no UTF-16": Spoken(raw=b"\x06\x03\x00\xd8\x00\xd8"),
}
QUICK = list(LIARS)[:3]
HARMLESS = {
    *("255 endpoints claimed", "255 interfaces claimed", "a total length of 65535"),
    *("packets of 65535 bytes", "255 configurations", "a device descriptor of length 8"),
    *("strings of odd length", "strings that claim 255 bytes"),
    *("strings of no bytes", "strings that are no UTF-16"),
}
"""Faults that the kernel or libusb corrects, or that nobody reads: such a device may stream."""
OPINIONS = {"streaming", "mismatch", "lost", "silent", "busy"}
QUIET_S, LOOK_S = 1.0, 30
"""The kernel has done with a device when it has asked it nothing for so long; the longest wait for
that."""


def service(cell: Cell) -> str:
    """Process and restarts of the service."""
    return cell.machine.out("systemctl show -p MainPID -p NRestarts palpate")


def looked_at(cell: Cell) -> set[str]:
    """The skin's states until the box judges it, or the kernel gives it up."""
    seen, asked, since = set[str](), cell.cable.asked, cell.clock.now_s()
    end = since + LOOK_S
    while not seen & OPINIONS and (cell.cable.asked == 0 or cell.clock.now_s() < since + QUIET_S):
        assert cell.clock.now_s() < end, (
            f"the kernel goes on asking; the box says: {cell.journal()}"
        )
        seen.add(state(cell)["state"])
        if cell.cable.asked != asked:
            asked, since = cell.cable.asked, cell.clock.now_s()
    return seen


def test_hostile_descriptors(cell: Cell, note: Note):
    """Each liar is refused or works; commands are answered, the sound skin streams."""
    running = service(cell)
    for what in LIARS if HOW == "full" else QUICK:
        cell.unplug()
        until_state(cell, "absent")
        cell.cable.asked = 0
        cell.cable.plug(cell.board(), LIARS[what])
        seen = looked_at(cell)
        assert "streaming" not in seen or what in HARMLESS, seen
        note(f"descriptor with {what}", " or ".join(sorted(seen)), 1)
    cell.plug()
    check_recovers(cell)
    assert service(cell) == running
    assert "Traceback" not in cell.journal(400)
