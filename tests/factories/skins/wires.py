"""The bytes that emulated skins send for frames of raw counts, and their answers to commands of the
box.

Sources are the readers and firmware published by makers and users, named at each skin. None of the
skins was available.
"""

import re
import struct
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

Taxels = NDArray[Any]
TEMPERATURE = 25.0


class Wire:
    """The skin's side of its serial line. Plain skins stream from power-on, take no commands, and
    number no frames.

    encode: the bytes of a frame [R, C] or [R, C, A]. period_ns: time between two frames. streaming:
    whether frames are sent; for some skins commands decide.
    """

    def __init__(self, encode: Callable[[Taxels], bytes], rate_hz: float) -> None:
        self.encode, self.period_ns = encode, 1e9 / rate_hz

    @property
    def streaming(self) -> bool:
        """Always."""
        return True

    def frame(self, taxels: Taxels, t_us: int) -> bytes:
        """The bytes of one frame. t_us: the skin's own time."""
        return self.encode(taxels)

    def receive(self, data: bytes) -> bytes:
        """The skin's answer to bytes from the box."""
        return b""

    def skip(self, frames: int) -> None:
        """This many frames are taken and never sent; a skin that counts frames counts them."""


def marked(taxels: Taxels) -> bytes:
    """FlexiTac and most self-made matrices: a marker, then all taxels row by row as bytes.

    Source: flexitac 0.3.1, firmware/template.ino.
    """
    return b"\xaa\x55" + taxels.astype("u1").tobytes()


def _magnets(taxels: Taxels) -> NDArray[np.float64]:
    """Temperature and three axes of each chip, [S, 4]."""
    axes = taxels.reshape(-1, 3).astype(np.float64)
    return np.column_stack([np.full(len(axes), TEMPERATURE), axes])


def floats(taxels: Taxels) -> bytes:
    """AnySkin: five chips as float32, then CR LF: 82 bytes.

    Source: anyskin 1.0.0, sensor.py, `burst_mode`.
    """
    return _magnets(taxels).astype("<f4").tobytes() + b"\r\n"


def decimals(taxels: Taxels) -> bytes:
    """ReSkin: the same numbers as a line of decimal text with two digits after the point.

    Source: anyskin 1.0.0, sensor.py, without `burst_mode`; Arduino's Serial.print(float) gives two
    digits.
    """
    return "\t".join(f"{value:.2f}" for value in _magnets(taxels).ravel()).encode() + b"\r\n"


def rows(taxels: Taxels) -> bytes:
    """3D-ViTac and matrices of sketches for Arduino: R lines of C numbers, and an empty line.

    Source: the firmware notes of 3D-ViTac's 16 x 16 matrix.
    """
    lines = [" ".join(map(str, row.tolist())) for row in taxels]
    return ("\r\n".join(lines) + "\r\n\r\n").encode()


class Polled(Wire):
    """A skin that answers requests with its newest frame. request: the bytes that ask for it."""

    def __init__(self, encode: Callable[[Taxels], bytes], request: bytes, rate_hz: float) -> None:
        super().__init__(encode, rate_hz)
        self._request, self._rest, self._newest, self._owed = request, b"", b"", 0

    def frame(self, taxels: Taxels, t_us: int) -> bytes:
        """The answers to requests before the first frame; else the frame is kept."""
        self._newest = self.encode(taxels)
        owed, self._owed = self._owed, 0
        return self._newest * owed

    def receive(self, data: bytes) -> bytes:
        """The newest frame for each whole request."""
        *asked, self._rest = (self._rest + data).split(self._request)
        self._owed += 0 if self._newest else len(asked)
        return self._newest * len(asked)


def paxini(taxels: Taxels) -> bytes:
    """PaXini's serial converter. Source: paxini-sdk 0.1.0, protocol.py; its board sets the state to
    1 in good answers, too."""
    force = taxels.reshape(-1).astype("i2").astype("u1").tobytes()
    head = struct.pack("<HBBBIHB", len(force) + 10, 1, 0, 0xFB, 0x40E, len(force), 1)
    data = b"\xaa\x55" + head + force
    return data + bytes([-sum(data) & 0xFF])


def crc16(data: bytes) -> bytes:
    """The checksum of Modbus RTU, bit by bit."""
    value = 0xFFFF
    for byte in data:
        value ^= byte
        for _ in range(8):
            value = value >> 1 ^ 0xA001 * (value & 1)
    return value.to_bytes(2, "little")


def synria(taxels: Taxels) -> bytes:
    """Synria's answer to function 42. Source: tactile-pressure-sdk 2.0.0, modbus_rtu.py."""
    counts = taxels.astype("<u2").tobytes()
    data = struct.pack("<BBH", 1, 0x42, len(counts)) + counts
    return data + crc16(data)


def dfrobot(taxels: Taxels) -> bytes:
    """DFRobot's array: all input registers from 7 on; its own library turns the rows around.

    Source: DFRobot_Tactile, python/raspberrypi.
    """
    counts = taxels.astype(">u2").tobytes()
    data = struct.pack("BBB", 1, 4, len(counts)) + counts
    return data + crc16(data)


def bota(taxels: Taxels) -> bytes:
    """Bota's frame: state, six floats, time, temperature. Source: the maker's serial driver."""
    data = struct.pack("<H6fIf", 0, *taxels.reshape(-1).astype(float), 0, 0, 0, 7, 25.0)
    value = 0xFFFF
    for byte in data:
        value ^= byte
        for _ in range(8):
            value = value >> 1 ^ 0x8408 * (value & 1)
    return b"\xaa" + data + (value ^ 0xFFFF).to_bytes(2, "little")


class PapillArray(Wire):
    """Contactile's PapillArray controller (PTS 2.0). Frames [3 S, 3, 3]: S sensors of 3 x 3 pillars
    with Fx, Fy, Fz in N.

    Source: published recordings of a controller's first bytes and readers written by users. Offsets
    count from the byte that holds their size; the controller pads its table with two zero bytes.
    """

    START, END = b"\x55\x66\x77\x88", b"\xaa\xbb\xcc\xdd"
    RATES = (100, 250, 500, 1000)
    TARE_S = 2.0
    PILLARS = 9

    def __init__(self, rate_hz: float = 1000, counter: int = 0) -> None:
        self.period_ns, self.counter = 1e9 / rate_hz, counter
        self._rest = b""
        self._zero: NDArray[np.float64] | float = 0.0
        self._unloaded: list[NDArray[np.float64]] = []
        self._tare_left = 0

    def receive(self, data: bytes) -> bytes:
        """`f1000\\n` sets the rate, `z\\n` takes the mean of the next two seconds as zero; other
        lines do nothing."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        for line in lines:
            if line == b"z":
                self._tare_left, self._unloaded = round(self.TARE_S * 1e9 / self.period_ns), []
            elif line[:1] == b"f" and line[1:].isdigit() and int(line[1:]) in self.RATES:
                self.period_ns = 1e9 / int(line[1:])
        return b""

    def frame(self, taxels: Taxels, t_us: int) -> bytes:
        """A packet with forces, displacements, sums, and blocks of unknown meaning."""
        force = taxels.reshape(-1, self.PILLARS, 3).astype(np.float64)
        if self._tare_left:
            self._unloaded.append(force)
            self._tare_left -= 1
            if not self._tare_left:
                self._zero = np.mean(self._unloaded, axis=0)
        force = force - self._zero
        body = self._blocks(force, t_us)
        self.counter += 1
        return self.START + body + struct.pack("<H", sum(body) & 0xFFFF) + self.END

    def skip(self, frames: int) -> None:
        """The counter of the next packet shows the gap."""
        self.counter += frames

    def _blocks(self, force: NDArray[np.float64], t_us: int) -> bytes:
        table, payload = b"", b""
        kinds = 1, 3, 4, 5, 6, 7
        first = 1 + 4 * len(kinds) + 2
        for kind in kinds:
            at = first + len(payload)
            table += struct.pack("<HH", kind, at)
            payload += self._block(kind, force, t_us, at)
        return b"\x02" + table + b"\0\0" + payload

    def _block(self, kind: int, force: NDArray[np.float64], t_us: int, at: int) -> bytes:
        """The block of this type that begins at offset `at`."""
        if kind == 1:
            return struct.pack("<IQ", self.counter % (1 << 32), t_us)
        if kind == 7:
            return b"\0"
        sums = force.sum(axis=1)
        if kind == 4:
            return _listed([struct.pack("<H6f", 2, *f, *(0.01 * f)) for f in sums], at)
        if kind == 6:
            return _listed([struct.pack("<HB2f", 1, 0, 0.5, 1.0)] * len(sums), at)
        inner = [[struct.pack("<Hbf", 1, 0, 0.5)] * self.PILLARS] * len(force)
        if kind == 3:
            inner = [[struct.pack("<H6f", 2, *f, *(0.1 * f)) for f in one] for one in force]
        sizes = [2 + 2 * len(items) + sum(map(len, items)) for items in inner]
        begins = at + 2 + 2 * len(inner) + np.cumsum([0, *sizes[:-1]])
        head = struct.pack(f"<H{len(inner)}H", len(inner), *begins)
        return head + b"".join(
            _listed(items, int(begin)) for items, begin in zip(inner, begins, strict=True)
        )


def _listed(items: Sequence[bytes], at: int) -> bytes:
    """Their number, their offsets, and the items, for a list that begins at offset `at`."""
    begins = at + 2 + 2 * len(items) + np.cumsum([0, *map(len, items[:-1])])
    return struct.pack(f"<H{len(items)}H", len(items), *begins) + b"".join(items)


class Slcan(Wire):
    """XELA's uSkin on CAN, behind a USB adapter that speaks slcan. Frames [R, C, 3] uint16: X, Y,
    Z.

    Sources: Lawicel's slcan as github.com/mac-can/SLCAN describes it (commands end with CR, answers
    are CR or BEL, `z` CR to a transmission); the start command 07 00 to id 0x200 + board, and
    replies of 0x710 + taxel with big-endian numbers in bytes 1 to 6, from users' readers over
    socketcan.
    """

    OK, ERROR = b"\r", b"\a"
    BUS_SPEED = b"S8"  # 1 Mbit/s, at which the sensors speak
    FIRST_ID = 0x710

    def __init__(self, rate_hz: float) -> None:
        self.period_ns = 1e9 / rate_hz
        self.invalid: frozenset[int] = frozenset()
        self._start = b"t20120700"
        self._speed, self._open, self._started = b"", False, False
        self._rest = b""

    @property
    def streaming(self) -> bool:
        """Whether the channel is open at the sensors' speed and the start command was sent."""
        return self._open and self._started

    def receive(self, data: bytes) -> bytes:
        """The adapter's answers."""
        *lines, self._rest = (self._rest + data).split(b"\r")
        return b"".join(map(self._command, lines))

    def _command(self, line: bytes) -> bytes:
        match line[:1]:
            case b"":
                return self.OK
            case b"S" if not self._open and line[1:] in map(b"%d".__mod__, range(9)):
                self._speed = line
            case b"O" if line == b"O" and not self._open and self._speed:
                self._open = True
            case b"C" if line == b"C" and self._open:
                # the sensors go on sending, but the closed channel does not pass it on
                self._open = False
            case b"V" if line == b"V":
                return b"V1013\r"
            case b"t" if self._open and self._speed == self.BUS_SPEED:
                self._started = self._started or line.upper().replace(b"T", b"t", 1) == self._start
                return b"z\r"
            case _:
                return self.ERROR
        return self.OK

    def frame(self, taxels: Taxels, t_us: int) -> bytes:
        """One CAN message for each taxel. invalid: taxels without a value now; their X begins with
        FA."""
        words = taxels.reshape(-1, 3).astype(">u2").copy()
        if self.invalid:
            words[list(self.invalid), 0] |= 0xFA00
        messages = (b"\0" + row.tobytes() + b"\0" for row in words)
        return b"".join(
            b"t%03X8%b\r" % (self.FIRST_ID + i, m.hex().upper().encode())
            for i, m in enumerate(messages)
        )


class Robotiq(Wire):
    """Robotiq's TSF-85 fingertips. Frames [7 F, 4] uint16: F fingers of 7 x 4 taxels.

    Source: Robotiq's reader for Python (tactile_sensors, sensor_quickstart) as packages repeat it:
    9A, a byte reserved for a checksum, command, length, data; fields begin with type << 4 | finger
    << 2; numbers are big-endian.
    """

    READ, AUTOSEND, AUTOSEND_ASYNC, VERSION = 0x61, 0x58, 0x59, 0xE3
    FIRMWARE = b"2.0.1"
    STATIC, DYNAMIC, ACCELEROMETER, TIMESTAMP = 0x10, 0x20, 0x30, 0x70
    UPRIGHT = 0, 0, 16384  # 1 g

    def __init__(self, rate_hz: float) -> None:
        self.period_ns, self._sends, self._rest = 1e9 / rate_hz, False, b""
        self._last: NDArray[np.int64] | None = None

    @property
    def streaming(self) -> bool:
        """Whether it was told to send."""
        return self._sends

    def receive(self, data: bytes) -> bytes:
        """Commands: start sending with a period in ms, 0 to stop; ask for the version."""
        self._rest += data
        answer = b""
        while found := re.search(rb"(?s)\x9a.(.)(.)", self._rest):
            (command,), (length,) = found.groups()
            if len(self._rest) < (end := found.end() + length):
                break
            content, self._rest = self._rest[found.end() : end], self._rest[end:]
            if command in (self.AUTOSEND, self.AUTOSEND_ASYNC) and length == 1:
                self._sends = content[0] > 0
                self.period_ns = content[0] * 1e6 or self.period_ns
            elif command == self.VERSION:
                answer += self._packet(self.VERSION, self.FIRMWARE)
        return answer

    def frame(self, taxels: Taxels, t_us: int) -> bytes:
        """All fields of all fingers in one packet."""
        fingers = taxels.reshape(-1, 28).astype(np.int64)
        change = (
            np.zeros(len(fingers)) if self._last is None else (fingers - self._last).mean(axis=1)
        )
        self._last = fingers
        data = b""
        for i, (static, dynamic) in enumerate(zip(fingers, change, strict=True)):
            finger = i << 2
            data += bytes([self.STATIC | finger]) + static.astype(">u2").tobytes()
            dynamic = int(np.clip(round(dynamic), -32768, 32767))
            data += struct.pack(">Bh", self.DYNAMIC | finger, dynamic)
            data += struct.pack(">B3h", self.ACCELEROMETER | finger, *self.UPRIGHT)
            data += struct.pack(">BQ", self.TIMESTAMP | finger, t_us)
        return self._packet(self.AUTOSEND, data)

    @staticmethod
    def _packet(command: int, data: bytes) -> bytes:
        return bytes([0x9A, 0, command, len(data)]) + data


WIRES: Mapping[str, Callable[[float], Wire]] = {
    "flexitac": partial(Wire, marked),
    "matrix": partial(Wire, marked),
    "anyskin": partial(Wire, floats),
    "reskin": partial(Wire, decimals),
    "3d-vitac": partial(Wire, rows),
    "papillarray": PapillArray,
    "xela-can": Slcan,
    "robotiq-tsf": Robotiq,
    "paxini": partial(Polled, paxini, bytes.fromhex("55aa09000100fb0e0400001b00cf")),
    "synria": partial(Polled, synria, b"\x01\x42\x80\x11"),
    "dfrobot-tactile": partial(Polled, dfrobot, bytes.fromhex("0104000700204013")),
    "bota-serial": partial(Wire, bota),
}
"""The wire of each skin, by the name of its profile, for a rate in frames per second."""


def wire(name: str, rate_hz: float) -> Wire:
    """The wire of the skin with this name."""
    return WIRES[name](rate_hz)
