"""The readout board without its pins: format, order of reading, FIFO, packets, requests
(PROTOCOL.md, part 1).

Settings, a scan function and a clock with MicroPython's ticks_us, ticks_add and ticks_diff are
passed in. `Readout.tick` runs in a timer interrupt and must not allocate memory. So buffers are
made beforehand, and counters of 32 bits are kept as two halves: on a Pico, an integer of more than
30 bits is an object on the heap.
"""

import struct
from binascii import crc32

VERSION = 1
FIRMWARE = (1, 0, 0)
IDENTITY, FORMAT, START, STOP = 1, 2, 3, 4
TRIGGER, OVERFLOW = 1, 2
HEADER_BYTES, CRC_BYTES = 20, 4
MAX_PAYLOAD, MAX_FRAMES, PACKET_US = 4096, 255, 8000
DATA_TYPES = {"uint8": (0, 1), "uint16": (2, 2)}  # name -> code in packets, bytes
FRAMES, REPLY = 0, 1
MOST = 16
"""Most rows and columns of one multiplexer."""
NO_TAXEL = 0xFFFF
"""In an order of reading: only a line is switched, and nothing is read."""


class Format:
    """The format of frames. Raises ValueError naming the setting, its value and the allowed
    values."""

    def __init__(self, rows, cols, rate_hz, dtype="uint8", fifo_s=1, board="palpate-pico"):
        for name, value in (("ROWS", rows), ("COLS", cols)):
            if not 1 <= value <= MOST:
                raise ValueError(f"{name} = {value} is out of range; use 1 to {MOST}")
        if not 1 <= rate_hz <= 10000:
            raise ValueError(f"RATE_HZ = {rate_hz} is out of range; use 1 to 10000")
        if dtype not in DATA_TYPES:
            raise ValueError(
                f"DTYPE = {dtype!r} is unknown; use one of {', '.join(sorted(DATA_TYPES))}"
            )
        if not 0.25 <= fifo_s <= 60:
            raise ValueError(f"FIFO_S = {fifo_s} is out of range; use 0.25 to 60")
        if not 1 <= len(board) <= 16:
            raise ValueError(f"BOARD = {board!r} is out of range; use 1 to 16 characters")
        self.rows, self.cols, self.board = rows, cols, board
        self.code, self.item_bytes = DATA_TYPES[dtype]
        self.frame_bytes = rows * cols * self.item_bytes
        # timers count whole microseconds, and the announced rate must be exact
        self.period_us = int(1000000 / rate_hz + 0.5)
        self.packet_frames = max(
            1, min(MAX_FRAMES, MAX_PAYLOAD // self.frame_bytes, PACKET_US // self.period_us)
        )
        self.packets = -int(-fifo_s * 1000000 // (self.period_us * self.packet_frames))

    def format_payload(self):
        """Payload of the reply to FORMAT."""
        rate_mhz = (1000000000 + self.period_us // 2) // self.period_us
        fifo = self.packets * self.packet_frames
        return struct.pack(
            "<BBBBIII", self.rows, self.cols, self.code, 0, rate_mhz, fifo, self.packet_frames
        )

    def identity_payload(self, serial):
        """Payload of the reply to IDENTITY. serial: at most 16 ASCII characters."""
        return struct.pack("<BBBB16s16s", VERSION, *FIRMWARE, self.board.encode(), serial.encode())


def reply(request, payload):
    """The packet that answers a request."""
    packet = bytearray(HEADER_BYTES + len(payload) + CRC_BYTES)
    struct.pack_into("<BBBBHBB", packet, 0, 0x50, 0xC1, VERSION, REPLY, len(payload), 0, request)
    packet[HEADER_BYTES : HEADER_BYTES + len(payload)] = payload
    seal(packet, len(payload))
    return packet


def seal(packet, length):
    """Write the CRC after a payload of so many bytes."""
    end = HEADER_BYTES + length
    struct.pack_into("<I", packet, end, crc32(memoryview(packet)[:end]))


def put32(buffer, at, low, high):
    """Write an integer of 32 bits, little-endian, from its two halves; nothing is allocated."""
    buffer[at] = low & 0xFF
    buffer[at + 1] = low >> 8
    buffer[at + 2] = high & 0xFF
    buffer[at + 3] = high >> 8


def gray(count):
    """The numbers below `count` in the order of a Gray code: for 4, 8 and 16 each differs from the
    next in one bit."""
    return [code for code in (i ^ (i >> 1) for i in range(MOST)) if code < count]


def reading_order(rows, cols):
    """The reading order of a frame with the fewest switches: lists (lines, levels, taxels),
    item by item.

    Set select line `lines[i]` (0 to 3: rows, 4 to 7: columns, lowest bit first) to `levels[i]`,
    then read taxel `taxels[i]`, its index in the frame, row by row; read nothing if that is
    NO_TAXEL. All lines are low at first, and low again after the last item.
    """
    lines, levels, taxels = [], [], []
    at, forwards = 0, gray(cols)
    for row in gray(rows):
        for col in forwards:
            changed = at ^ (row | col << 4)
            at ^= changed
            bits = [bit for bit in range(8) if changed >> bit & 1] or [0]
            for bit in bits:
                lines.append(bit)
                levels.append(at >> bit & 1)
                taxels.append(row * cols + col if bit == bits[-1] else NO_TAXEL)
        forwards.reverse()
    for bit in range(8):
        if at >> bit & 1:
            lines.append(bit)
            levels.append(0)
            taxels.append(NO_TAXEL)
    return lines, levels, taxels


class Fifo:
    """A ring of packets. The interrupt fills a packet frame by frame; the main program takes the
    oldest full packet.

    lock, unlock: `machine.disable_irq` and `enable_irq`, around the few statements that must not be
    interrupted. Raises MemoryError if the memory is too small.
    """

    def __init__(self, format, lock, unlock):
        self._format, self._lock, self._unlock = format, lock, unlock
        self._slots = [
            self._blank() for _ in range(format.packets + 1)
        ]  # one more for the packet that is being filled
        self._counts = bytearray(format.packets + 1)
        self._spare = self._blank()
        self._oldest = self._full = self._filled = 0
        self._overflowed = False
        self.filling = self._slots[0]

    def _blank(self):
        format = self._format
        packet = bytearray(HEADER_BYTES + format.packet_frames * format.frame_bytes + CRC_BYTES)
        packet[:4] = bytes((0x50, 0xC1, VERSION, FRAMES))
        packet[8:11] = bytes((format.rows, format.cols, format.code))
        return packet

    def clear(self):
        """Drop all frames."""
        state = self._lock()
        self._full = self._filled = 0
        self._overflowed = False
        self.filling = self._slots[self._oldest]
        self._unlock(state)

    def room(self, seq_low, seq_high, t_low, t_high, level):
        """In the interrupt: the offset of the next frame in `filling`. The other arguments describe
        it: number, time, trigger line."""
        if self._filled == 0:
            put32(self.filling, 12, seq_low, seq_high)
            put32(self.filling, 16, t_low, t_high)
            self.filling[6] = TRIGGER if level else 0
        return HEADER_BYTES + self._filled * self._format.frame_bytes

    def filled(self):
        """In the interrupt: the frame is complete."""
        self._filled += 1
        if self._filled == self._format.packet_frames:
            self.finish()

    def finish(self):
        """In the interrupt: end the packet, since it is full or the next number does not follow.
        Drops the oldest packet if the queue is full."""
        if self._filled == 0:
            return
        size = len(self._slots)
        self._counts[(self._oldest + self._full) % size] = self._filled
        self._filled = 0
        self._full += 1
        if self._full == size:
            self._oldest = (self._oldest + 1) % size
            self._full -= 1
            self._overflowed = True
        self.filling = self._slots[(self._oldest + self._full) % size]

    def take(self):
        """The oldest packet with its CRC, and its size; (None, 0) if there is none. It stays valid
        until the next call."""
        state = self._lock()
        if self._full == 0:
            self._unlock(state)
            return None, 0
        at = self._oldest
        packet, frames = self._slots[at], self._counts[at]
        self._slots[at], self._spare = self._spare, packet
        self._oldest = (at + 1) % len(self._slots)
        self._full -= 1
        overflowed, self._overflowed = self._overflowed, False
        self._unlock(state)
        length = frames * self._format.frame_bytes
        struct.pack_into(
            "<HBB", packet, 4, length, packet[6] | (OVERFLOW if overflowed else 0), frames
        )
        seal(packet, length)
        return packet, HEADER_BYTES + length + CRC_BYTES


class Readout:
    """The readout board: numbers and times of frames, replies and packets.

    scan: called with a buffer and an offset, writes one frame there. level: reads the trigger line.
    clock: `time`. timer: its start(period_us, callback) and stop() control the calls of `tick`.
    lock, unlock: as for Fifo. seq, t_us: the first number and time, as (low, high).
    """

    def __init__(
        self, format, serial, scan, level, clock, timer, lock, unlock, seq=(0, 0), t_us=(0, 0)
    ):
        self._scan, self._level, self._clock, self._timer = scan, level, clock, timer
        self._period, self._half = format.period_us, format.period_us // 2
        self._fifo = Fifo(format, lock, unlock)
        self._replies = {
            IDENTITY: reply(IDENTITY, format.identity_payload(serial)),
            FORMAT: reply(FORMAT, format.format_payload()),
        }
        self._reply = None
        self._seq_low, self._seq_high = seq
        self._t_low, self._t_high = t_us
        self._last = self._due = 0
        self.running = False

    def tick(self, _timer=None):
        """In the interrupt, once a period: take the frame that is due.

        Its number comes from the clock. If the interrupt was late by more than half a period, the
        missed frames keep their numbers, so that the count and the clock agree and the loss is
        visible.
        """
        if not self.running:
            return  # an interrupt of a soft timer that was pending at STOP
        clock, period = self._clock, self._period
        now = clock.ticks_us()
        late = clock.ticks_diff(now, self._due) + self._half
        if late < 0:
            return  # a pending interrupt whose frame was taken already
        missed = late // period
        self._due = clock.ticks_add(self._due, (missed + 1) * period)
        passed = clock.ticks_diff(now, self._last)
        self._last = now
        low = self._t_low + (passed & 0xFFFF)
        self._t_low = low & 0xFFFF
        self._t_high = (self._t_high + (passed >> 16) + (low >> 16)) & 0xFFFF
        fifo = self._fifo
        if missed:
            fifo.finish()
            self._count(missed)
        at = fifo.room(self._seq_low, self._seq_high, self._t_low, self._t_high, self._level())
        self._scan(fifo.filling, at)
        fifo.filled()
        self._count(1)

    def _count(self, frames):
        low = self._seq_low + frames
        self._seq_low = low & 0xFFFF
        self._seq_high = (self._seq_high + (low >> 16)) & 0xFFFF

    def request(self, number):
        """Carry out a request byte. Other bytes are ignored, since a modem manager may send
        anything."""
        if number in self._replies:
            self._reply = self._replies[number]
        elif number == START and not self.running:
            self._fifo.clear()
            self._last = self._clock.ticks_us()
            self._due = self._clock.ticks_add(self._last, self._period)
            self.running = True
            self._timer.start(self._period, self.tick)
        elif number == STOP and self.running:
            self.running = False
            self._timer.stop()
            self._fifo.clear()

    @property
    def replying(self):
        """Whether a reply waits to be sent; until then no other request is read."""
        return self._reply is not None

    def next(self):
        """The next bytes to send, a reply before frames: a buffer and the number of its bytes;
        (None, 0) for nothing."""
        answer, self._reply = self._reply, None
        return (answer, len(answer)) if answer else self._fifo.take()


def serve(readout, stdin, stdout, readable):
    """Answer requests and send packets until `stdin` ends, which never happens on a Pico.

    readable: called with milliseconds; whether a byte can be read from `stdin`, after waiting so
    long at most. `stdout.write` may accept a part, or nothing while the host does not read; the
    rest is sent later.
    """
    byte = bytearray(1)
    packet, sent, size = None, 0, 0
    while True:
        if packet is None:
            packet, size = readout.next()
            sent = 0
        if not readout.replying and readable(0 if packet else 1):
            if not stdin.readinto(byte):
                return
            readout.request(byte[0])
        if packet:
            sent += stdout.write(packet, sent, size - sent) or 0
            if sent == size:
                packet = None
