"""The far end of a USB cable that leads into the guest: speaks the usbredir protocol for a board of
the rig.

QEMU's usb-redir device is connected to the guest's xHCI port and passes on the requests of the
guest's kernel to a device (messages as in usbredirproto.h of usbredir 0.13). A ReadoutBoard
answers, as it does on the simulated bus.
"""

import select
import socket
import struct
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

from palpate.core.clock import Clock
from palpate.sim import rig
from palpate.sim.usb import MAX_PACKET, PRODUCT_ID, VENDOR_ID

HELLO, CONNECT, DISCONNECT, RESET, INTERFACES, ENDPOINTS = 0, 1, 2, 3, 4, 5
SET_CONFIGURATION, GET_CONFIGURATION, CONFIGURATION, SET_ALT, GET_ALT, ALT = 6, 7, 8, 9, 10, 11
CANCEL, ACK, CONTROL, BULK = 21, 24, 100, 101
DONE, CANCELLED, STALL = 0, 1, 4
IN = 0x81
CLEAR_HALT = 0x02, 1, 0
"""Request type, request and value with which a host clears a stalled endpoint."""
FULL_SPEED = 1
KEPT = 64
"""Number of replies that are remembered; a cancellation takes milliseconds to arrive."""
ABLE = 1 << 1 | 1 << 4 | 1 << 5 | 1 << 6
"""connect_device_version, ep_info_max_packet_size, 64bits_ids, 32bits_bulk_length; QEMU supports
these too."""


@dataclass(slots=True)
class Descriptors:
    """The descriptors that the device returns to the kernel; a test may put any bytes here."""

    device: bytes = struct.pack(
        *("<BBHBBBBHHHBBBB", 18, 1, 0x0200, 0, 0, 0, MAX_PACKET, VENDOR_ID, PRODUCT_ID, 0x0100),
        *(1, 2, 3, 1),
    )
    configuration: bytes = (
        struct.pack("<BBHBBBBB", 9, 2, 25, 1, 1, 0, 0x80, 50)
        + struct.pack("<BBBBBBBBB", 9, 4, 0, 0, 1, 255, 0, 0, 0)
        + struct.pack("<BBBBHB", 7, 5, IN, 2, MAX_PACKET, 0)
    )
    strings: list[str] = field(default_factory=lambda: ["\u0409", "Palpate", "tactile skin", ""])

    def reply(self, kind: int, index: int) -> bytes | None:
        """The descriptor of a kind, or None if there is none."""
        if kind == 3 and index < len(self.strings):
            text = self.strings[index].encode("utf-16-le")
            return bytes([len(text) + 2, 3]) + text
        return {1: self.device, 2: self.configuration}.get(kind)


class UsbRedirPeer:
    """A cable. `plug` connects a board to it, `unplug` removes it; both may be called from any
    thread.

    mangle: changes the data of a transfer; more bytes than requested are a babble. silent:
    transfers never end. deaf: requests are never answered. slow_s: delay of the answers to
    requests. All times are those of `clock`, the guest's. halted: the endpoint stalls until it is
    cleared. sent: number of transfers that the guest took. asked: number of its requests. opened:
    how often the guest's kernel has set up a device.
    """

    def __init__(self, connection: socket.socket, clock: Clock) -> None:
        self.board: rig.ReadoutBoard | None = None
        self.mangle: Callable[[bytes], bytes] = bytes
        self.silent = self.deaf = self.halted = False
        self.slow_s = 0.0
        self.descriptors = Descriptors()
        self.sent = self.asked = self.opened = 0
        self._socket, self._clock, self._wide = connection, clock, False
        self._waiting: deque[tuple[int, int]] = (
            deque()
        )  # (id, length) of bulk transfers that wait for data
        self._replied: dict[int, bytes] = {}
        self._again: deque[bytes] = deque()
        self._later: deque[tuple[int, bytes, int]] = (
            deque()
        )  # (ns, body, id) of answers to requests
        self._jobs: deque[Callable[[], None]] = deque()
        self._wake, self._woken = socket.socketpair()
        self._said_hello = threading.Event()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def plug(self, board: rig.ReadoutBoard, descriptors: Descriptors | None = None) -> None:
        """Connect a board to the cable; the previous board has been removed before."""
        self._said_hello.wait(10)
        self.do(lambda: self._connect(board, descriptors or Descriptors()))

    def unplug(self) -> None:
        """Pull the cable; the board loses its power."""
        self.do(self._disconnect)

    def do(self, job: Callable[[], None]) -> None:
        """Run `job` between two messages and return: a board belongs to one thread."""
        done = threading.Event()

        def noted() -> None:
            job()
            done.set()

        self._jobs.append(noted)
        self._wake.send(b".")
        if not done.wait(10):
            raise RuntimeError("the cable does not answer; has the guest gone?")

    def close(self) -> None:
        """Let go."""
        self._socket.close()
        self._wake.close()

    def _connect(self, board: rig.ReadoutBoard, descriptors: Descriptors) -> None:
        if self.board:
            self._disconnect()
        self.board, self.descriptors = board, descriptors
        descriptors.strings[3] = descriptors.strings[3] or board.identity.serial
        board.present = True
        self.opened += 1
        kinds, sizes = bytearray(b"\xff" * 32), [0] * 32
        kinds[0] = kinds[16] = 0  # endpoint 0, both ways: control
        kinds[16 + (IN & 15)] = 2  # bulk
        sizes[0] = sizes[16] = sizes[16 + (IN & 15)] = MAX_PACKET
        self._send(
            INTERFACES, 0, struct.pack("<I", 1) + bytes(32) + b"\xff" + bytes(31) + bytes(64)
        )
        self._send(ENDPOINTS, 0, bytes(kinds) + bytes(64) + struct.pack("<32H", *sizes))
        ids = struct.unpack_from("<HHH", descriptors.device, 8)
        self._send(CONNECT, 0, struct.pack("<BBBBHHH", FULL_SPEED, 0, 0, 0, *ids))

    def _disconnect(self) -> None:
        if self.board:
            self.board.present = self.board.running = False
            self.board = None
            self._forget()
            self._send(DISCONNECT, 0)

    def _forget(self) -> None:
        """Forget all transfers and answers that are on their way."""
        for what in (self._waiting, self._again, self._replied, self._later):
            what.clear()

    def _send(self, kind: int, ident: int, body: bytes = b"") -> None:
        head = "<IIQ" if self._wide and kind != HELLO else "<III"
        self._socket.sendall(struct.pack(head, kind, len(body), ident) + body)

    def _serve(self) -> None:
        self._send(HELLO, 0, b"palpate".ljust(64, b"\0") + struct.pack("<I", ABLE))
        data = b""
        try:
            while True:
                readable, _, _ = select.select(
                    [self._socket, self._woken], [], [], self._patience_s()
                )
                if self._woken in readable:
                    self._woken.recv(64)
                while self._jobs:
                    self._jobs.popleft()()
                if self._socket in readable:
                    more = self._socket.recv(65536)
                    if not more:
                        return
                    data = self._take(data + more)
                self._deliver()
        except (OSError, ValueError):
            return  # the socket was closed

    def _patience_s(self) -> float | None:
        if self._again and self._waiting:
            return 0.0
        due_ns = self.board.due_ns() if self.board and self._waiting and not self.silent else None
        due = [at_ns for at_ns, _, _ in self._later] + ([due_ns] if due_ns is not None else [])
        return max(0.0, (min(due) - self._clock.now_ns()) / 1e9) if due else None

    def _take(self, data: bytes) -> bytes:
        """Answer all whole messages; returns the remaining bytes."""
        while True:
            head = "<IIQ" if self._wide else "<III"
            size = struct.calcsize(head)
            if len(data) < size:
                return data
            kind, length, ident = struct.unpack_from(head, data)
            if len(data) < size + length:
                return data
            self._answer(kind, ident, data[size : size + length])
            data = data[size + length :]

    def _answer(self, kind: int, ident: int, body: bytes) -> None:
        match kind:
            case 0:  # HELLO
                self._wide = bool(struct.unpack_from("<I", body, 64)[0] >> 5 & 1)
                self._said_hello.set()
            case 3:  # RESET: the board starts from the beginning
                if self.board:
                    self.board.running = False
                self._forget()
            case 6 | 7:
                self._send(CONFIGURATION, ident, struct.pack("<BB", DONE, 1))
            case 9 | 10:
                self._send(ALT, ident, struct.pack("<BBB", DONE, body[0], 0))
            case 21:  # CANCEL
                for waiting in [w for w in self._waiting if w[0] == ident]:
                    self._waiting.remove(waiting)
                    self._reply(ident, CANCELLED, b"")
                if ident in self._replied:
                    # the cancellation crossed our reply, and QEMU discards the data; a real
                    # controller would have delivered it
                    self._again.append(self._replied.pop(ident))
            case 100:
                self._control(ident, body)
            case 101:
                low, high = struct.unpack_from("<2xH4xH", body)
                self._waiting.append((ident, low | high << 16))

    def _control(self, ident: int, body: bytes) -> None:
        ep, request, kind, _, value, index, length = struct.unpack_from("<BBBBHHH", body)
        self.asked += 1
        if self.deaf or not self.board:
            return
        reply: bytes | None = b""
        if kind & 0x60:
            reply = self.board.request(request)
        elif (kind, request, value) == CLEAR_HALT:
            self.halted = False
        elif request == 6:
            reply = self.descriptors.reply(value >> 8, value & 0xFF)
        elif kind & 0x80:
            reply = bytes(length)  # status and the like
        status, data = (
            (STALL, b"") if reply is None else (DONE, reply[:length] if kind & 0x80 else b"")
        )
        size = len(data) if kind & 0x80 else length
        answer = struct.pack("<BBBBHHH", ep, request, kind, status, value, index, size) + data
        self._later.append((self._clock.now_ns() + round(self.slow_s * 1e9), answer, ident))

    def _deliver(self) -> None:
        """Send the guest the data that are due."""
        while self._later and self._later[0][0] <= self._clock.now_ns():
            _, answer, ident = self._later.popleft()
            self._send(CONTROL, ident, answer)
        while self._waiting and self.halted:
            self._reply(self._waiting.popleft()[0], STALL, b"")
        while self._waiting and self.board and not self.silent:
            due_ns = self.board.due_ns()
            if not self._again and (due_ns is None or due_ns > self._clock.now_ns()):
                return
            ident, _ = self._waiting.popleft()
            data = self._again.popleft() if self._again else self.mangle(self.board.take())
            self.sent += 1
            self._replied[ident] = data
            if len(self._replied) > KEPT:
                del self._replied[next(iter(self._replied))]
            self._reply(ident, DONE, data)

    def _reply(self, ident: int, status: int, data: bytes) -> None:
        n = len(data)
        self._send(BULK, ident, struct.pack("<BBHIH", IN, status, n & 0xFFFF, 0, n >> 16) + data)
