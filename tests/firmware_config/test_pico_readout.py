"""The Pico's readout without pins: bytes, order of reading, counters, FIFO, requests."""

import io
import itertools

import numpy as np
import pytest

from palpate.io import packets
from tests.factories import pico

readout = pico.module()
SMALL = 1 << 30
"""From here on an integer is an object on the heap of a Pico."""


class DrivenBoard:
    """A Readout with time and interrupts of a test; each taxel has the number of the scan."""

    def __init__(self, ticks=0, wrap=SMALL, level=0, **settings):
        counters = {name: settings.pop(name) for name in ("seq", "t_us") if name in settings}
        self.ticks, self.wrap, self.level, self.scans = ticks, wrap, level, 0
        self.format = readout.Format(
            **{"rows": 2, "cols": 3, "rate_hz": 1000, "fifo_s": 0.25} | settings
        )
        self.board = readout.Readout(
            self.format,
            "0123456789abcdef",
            self.scan,
            lambda: self.level,
            self,
            self,
            lambda: 0,
            lambda state: None,
            **counters,
        )
        self.callback = None

    def scan(self, buffer, at):
        """The firmware's scan function."""
        for k in range(self.format.frame_bytes):
            buffer[at + k] = self.scans % 256
        self.scans += 1

    def ticks_us(self):
        """As of MicroPython's `time`; the same below."""
        return self.ticks

    def ticks_add(self, ticks, delta):
        """Wraps."""
        assert abs(delta) < self.wrap // 2
        return (ticks + delta) % self.wrap

    def ticks_diff(self, later, earlier):
        """Wraps."""
        return (later - earlier + self.wrap // 2) % self.wrap - self.wrap // 2

    def start(self, period_us, callback):
        """The timer starts."""
        assert period_us == self.format.period_us
        self.callback = callback

    def stop(self):
        """The timer stops."""
        self.callback = None

    def ask(self, *requests):
        """Request bytes come."""
        for number in requests:
            self.board.request(number)

    def tick(self, times=1, us=None):
        """Let time pass by a period, or `us`, and interrupt; so many times."""
        for _ in range(times):
            self.ticks = (self.ticks + (self.format.period_us if us is None else us)) % self.wrap
            self.board.tick()
            held = [
                v
                for part in (self.board, self.board._fifo)
                for v in vars(part).values()
                if isinstance(v, int)
            ]
            assert all(abs(v) < SMALL for v in held), "an integer that a Pico allocates"

    def sent(self):
        """All bytes that the readout board sends now."""
        data = b""
        while True:
            packet, size = self.board.next()
            if packet is None:
                return data
            data += bytes(packet[:size])

    def packets(self):
        """Its bytes as read by the box; nothing is damaged."""
        read = packets.unpack(self.sent())
        assert read.garbage == 0
        assert read.leftover == b""
        return read.packets


@pytest.mark.parametrize(
    ("settings", "named"),
    [
        ({"rows": 0}, "ROWS = 0"),
        ({"cols": 17}, "COLS = 17"),
        ({"rate_hz": 0}, "RATE_HZ = 0"),
        ({"rate_hz": 20000}, "RATE_HZ = 20000"),
        ({"dtype": "int16"}, "DTYPE = 'int16'"),
        ({"fifo_s": 0.1}, "FIFO_S = 0.1"),
        ({"board": ""}, "BOARD = ''"),
        ({"board": "seventeen letters"}, "BOARD = 'seventeen letters'"),
    ],
)
def test_a_setting_that_cannot_be_is_named(settings, named):
    """The error gives its value and the allowed values."""
    with pytest.raises(ValueError, match=f"^{named} is (out of range|unknown); use "):
        DrivenBoard(**settings)


@pytest.mark.parametrize(
    ("settings", "format"),
    [
        ({"rows": 4, "cols": 4, "rate_hz": 750, "fifo_s": 1}, (4, 4, "uint8", 750.188, 756, 6)),
        (
            {"rows": 16, "cols": 16, "rate_hz": 100, "fifo_s": 1, "dtype": "uint16"},
            (16, 16, "uint16", 100, 100, 1),
        ),
        (
            {"rows": 16, "cols": 16, "rate_hz": 10000, "dtype": "uint16"},
            (16, 16, "uint16", 10000, 2504, 8),
        ),
    ],
)
def test_replies_are_those_of_the_protocol(settings, format):
    """Byte by byte as from the box's encoder; FIFO and rate are at least the setting's."""
    made = DrivenBoard(**settings)
    made.ask(readout.IDENTITY)
    who = packets.Identity(packets.VERSION, (1, 0, 0), "palpate-pico", "0123456789abcdef")
    assert made.sent() == packets.pack_reply(packets.Request.IDENTITY, packets.pack_identity(who))
    made.ask(readout.FORMAT)
    said = packets.SkinFormat(*format)
    assert made.sent() == packets.pack_reply(packets.Request.FORMAT, packets.pack_format(said))
    assert said.fifo_frames >= 0.25 * said.rate_hz - 1


@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
@pytest.mark.parametrize("level", [0, 1])
def test_packets_are_those_of_the_protocol(dtype, level):
    """Byte by byte as from the box's encoder, with the trigger line of the first frame."""
    made = DrivenBoard(dtype=dtype, level=level, seq=(65534, 7))
    made.ask(readout.START)
    made.tick(8)
    numbers = np.arange(8, dtype=np.uint8).repeat(made.format.frame_bytes)
    taxels = numbers.view("<u2" if dtype == "uint16" else "u1").reshape(8, 2, 3)
    assert made.sent() == packets.pack(7 << 16 | 65534, 1000, taxels, level * packets.Flag.TRIGGER)


@pytest.mark.parametrize("rows", range(1, 17))
def test_every_taxel_is_read_once_at_its_place(rows):
    """The select lines stand at its row and column when it is read, and end low."""

    def check_order(rows, cols):
        """The order in which the taxels of a skin are read."""
        at, seen, order = 0, [], readout.reading_order(rows, cols)
        for line, level, taxel in zip(*order, strict=True):
            at = at & ~(1 << line) | level << line
            if taxel != readout.NO_TAXEL:
                assert divmod(taxel, cols) == (at & 15, at >> 4), (rows, cols)
                seen.append(taxel)
        assert sorted(seen) == list(range(rows * cols)), (rows, cols)
        assert at == 0, (rows, cols)
        if {rows, cols} <= {2, 4, 8, 16}:
            assert len(order[0]) <= rows * cols + 2, (rows, cols)

    for cols in range(1, 17):
        check_order(rows, cols)


def test_numbers_and_times_follow_one_another():
    """Frames are numbered one by one, and stamped with the time at which they were taken."""
    made = DrivenBoard(ticks=5)
    made.ask(readout.START)
    made.tick(24)
    got = made.packets()
    assert [(p.seq, p.t_us, len(p.taxels)) for p in got] == [
        (0, 1000, 8),
        (8, 9000, 8),
        (16, 17000, 8),
    ]
    assert (np.concatenate([p.taxels[:, 1, 2] for p in got]) == np.arange(24)).all()


def test_counters_wrap_where_the_protocol_says():
    """Number and time go on after 2^32, and do not notice where the ticks wrap."""
    made = DrivenBoard(ticks=SMALL - 20_500, seq=(65536 - 20, 65535), t_us=(65536 - 20_000, 65535))
    made.ask(readout.START)
    made.tick(48)
    got = made.packets()
    assert [p.seq for p in got] == [(2**32 - 20 + 8 * i) % 2**32 for i in range(6)]
    assert [p.t_us for p in got] == [(2**32 - 20_000 + 1000 + 8000 * i) % 2**32 for i in range(6)]
    _, position, lost, stale = packets.follow(got, packets.StreamPosition(0))
    assert (position.epoch, lost, stale) == (0, 0, 0)


@pytest.mark.parametrize(("late_us", "missed"), [(400, 0), (600, 1), (2400, 2), (100_600, 101)])
def test_a_late_interrupt_keeps_count_and_clock_together(late_us, missed):
    """Missed frames keep their numbers; pending interrupts take no frame twice."""
    made = DrivenBoard()
    made.ask(readout.START)
    made.tick(8)
    made.tick(us=1000 + late_us)
    made.tick(times=missed, us=0)
    made.tick(us=1000 * (missed + 1) - late_us)
    made.tick(6)
    got = made.packets()
    assert [len(p.taxels) for p in got] == [8, 8]
    assert got[1].seq == 8 + missed
    assert got[1].t_us == 9000 + late_us
    assert (np.concatenate([p.taxels[:, 0, 0] for p in got]) == np.arange(16)).all()


def test_a_packet_ends_where_numbers_do_not_follow():
    """Frame i of a packet was taken i periods after the first, so a gap begins another packet."""
    made = DrivenBoard()
    made.ask(readout.START)
    made.tick(3)
    made.tick(us=5000)
    made.tick(7)
    assert [(p.seq, len(p.taxels)) for p in made.packets()] == [(0, 3), (7, 8)]


def test_a_full_fifo_drops_the_oldest_and_says_so_once():
    """The announced depth is kept; only the packet after the loss carries the flag."""
    made = DrivenBoard()
    made.ask(readout.START)
    depth = made.format.packets * made.format.packet_frames
    assert depth >= 250
    made.tick(depth + 24)
    got = made.packets()
    assert sum(len(p.taxels) for p in got) == depth
    assert got[0].seq == 24
    assert [p.flags for p in got] == [packets.Flag.OVERFLOW] + [0] * (len(got) - 1)
    assert (got[-1].taxels == (depth + 23) % 256).all(axis=(1, 2))[-1]
    made.tick(8)
    assert [(p.seq, p.flags) for p in made.packets()] == [(depth + 24, 0)]


def test_what_is_being_sent_is_not_overwritten():
    """A packet that was taken does not change while the FIFO overflows behind it."""
    made = DrivenBoard()
    made.ask(readout.START)
    made.tick(8)
    packet, size = made.board.next()
    before = bytes(packet[:size])
    made.tick(2 * made.format.packets * made.format.packet_frames)
    assert bytes(packet[:size]) == before


def test_start_and_stop():
    """START while it runs changes nothing, STOP drops unsent frames, numbers go on."""
    made = DrivenBoard()
    made.ask(readout.STOP)
    assert made.callback is None
    made.ask(readout.START)
    made.tick(12)
    made.ask(readout.START)
    made.tick(4)
    assert [(p.seq, len(p.taxels)) for p in made.packets()] == [(0, 8), (8, 8)]
    made.tick(12)
    made.ask(readout.STOP)
    assert made.callback is None
    made.tick(3)  # a soft timer's interrupts that had waited
    assert made.sent() == b""
    made.ask(readout.START)
    made.tick(8)
    (only,) = made.packets()
    assert (only.seq, only.flags) == (28, 0)


def test_other_bytes_are_left_alone():
    """A modem manager sends AT commands; the readout board goes on as if no bytes had come."""
    made = DrivenBoard()
    made.ask(*b"AT+CGMI\r\n\xff\x00\x05")
    assert not made.board.running
    assert not made.board.replying
    assert made.sent() == b""


@pytest.mark.parametrize("chunks", [(1000,), (7,), (64, 0, 0, 3)])
def test_replies_wait_for_the_end_of_a_packet(chunks):
    """However few bytes the port takes at a time, no request tears a packet apart."""

    class SlowPort:
        """A port that accepts a few bytes at a time, or none, and gives requests at set turns."""

        def __init__(self, made, requests, chunks):
            self.made, self.requests, self.chunks = made, dict(requests), itertools.cycle(chunks)
            self.turn, self.taken = 0, b""

        def readable(self, ms):
            """Time passes with each look."""
            assert ms in (0, 1)
            self.turn += 1
            if self.made.board.running:
                self.made.tick()
            return self.turn in self.requests or self.turn > 400

        def readinto(self, buffer):
            """The request of this turn."""
            if self.turn > 400:
                return 0
            buffer[0] = self.requests.pop(self.turn)
            return 1

        def write(self, buffer, at, length):
            """Accepts a random part."""
            n = min(next(self.chunks), length)
            self.taken += bytes(buffer[at : at + n])
            return n or None

    made = DrivenBoard()
    asked = {
        2: readout.START,
        90: readout.IDENTITY,
        111: readout.FORMAT,
        112: readout.IDENTITY,
        113: 77,
        200: readout.IDENTITY,
    }
    port = SlowPort(made, asked, chunks)
    readout.serve(made.board, port, port, port.readable)
    read = packets.unpack(port.taken)
    assert read.garbage == 0
    assert [r.request for r in read.replies] == [1, 2, 1, 1]
    _, _, lost, stale = packets.follow(read.packets, packets.StreamPosition(0))
    assert (lost, stale) == (0, 0)
    assert len(read.packets) > 20


def test_serving_ends_with_its_input():
    """Standard input of the unix port ends; a port never does."""
    made = DrivenBoard()
    taken = io.BytesIO()
    readout.serve(made.board, io.BytesIO(b""), taken, lambda ms: True)
    assert taken.getvalue() == b""
