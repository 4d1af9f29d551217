"""The time of a frame, calculated and measured: `mpremote run budget.py` on a Pico, `micropython
budget.py` anywhere.

Calculated from data sheets (see README.md): the part of a reading's time that is left for
MicroPython. Measured on this machine: the part without pins, and on a Pico the reading of a frame.
"""

import math
import time

import readout
import settings

CONVERSION_US = 2
"""RP2040 and RP2350: 96 cycles of 48 MHz."""
PULL_DOWN_OHM, FARAD = 4700, 150e-12
"""The resistor at the converter; 45 pF and 5 pF of the multiplexer, 100 pF assumed for the
wires."""
FORMS = ((4, 4, 750, "uint8"), (16, 16, 100, "uint8"), (16, 16, 100, "uint16"))


def settle_us(bits):
    """Microseconds until the voltage is within half a step of its end."""
    return PULL_DOWN_OHM * FARAD * math.log(2 ** (bits + 1)) * 1e6


def calculated(rows, cols, rate_hz, dtype):
    """(us a reading, us of them that settling takes, us left for MicroPython, bytes a second, bytes
    of memory)."""
    format = readout.Format(rows, cols, rate_hz, dtype)
    reading_us = format.period_us / (rows * cols)
    settling_us = settle_us(12 if format.item_bytes == 2 else 8)
    packet = readout.HEADER_BYTES + format.packet_frames * format.frame_bytes + readout.CRC_BYTES
    rate = packet * 1000000 / (format.period_us * format.packet_frames)
    return (
        reading_us,
        settling_us,
        reading_us - settling_us - CONVERSION_US,
        rate,
        packet * (format.packets + 2),
    )


class Ticks:
    """A clock that advances only by hand."""

    def __init__(self):
        self.now = 0

    def ticks_us(self):
        return self.now

    def ticks_add(self, ticks, delta):
        """As of `time`."""
        return ticks + delta

    def ticks_diff(self, later, earlier):
        """As of `time`."""
        return later - earlier

    def start(self, period_us, callback):
        """Does nothing: no timer exists."""


def pure_us(rows, cols, rate_hz, dtype):
    """Microseconds of a frame without its reading: number, time, FIFO, header, CRC; the best of 40
    times 60 frames."""
    format, clock = readout.Format(rows, cols, rate_hz, dtype), Ticks()
    board = readout.Readout(
        format, "", lambda buffer, at: None, lambda: 0, clock, clock, lambda: 0, lambda state: None
    )
    board.request(readout.START)
    best = 1000000
    for _ in range(40):
        began = time.ticks_us()
        for _ in range(60):
            clock.now += format.period_us
            board.tick()
            board.next()
        best = min(best, time.ticks_diff(time.ticks_us(), began))
    return best / 60


def reading_us():
    """Microseconds of one reading with settings.py; None without pins."""
    try:
        import main
    except ImportError:
        return None
    format = readout.Format(settings.ROWS, settings.COLS, settings.RATE_HZ, settings.DTYPE)
    scanner = main.Scanner(
        format, settings.ROW_PINS, settings.COL_PINS, settings.ADC_PIN, settings.SETTLE_US
    )
    buffer = bytearray(format.frame_bytes)
    began = time.ticks_us()
    for _ in range(100):
        scanner.scan(buffer, 0)
    return time.ticks_diff(time.ticks_us(), began) / 100 / (format.rows * format.cols)


def table():
    """The lines of the page's table."""
    for given in FORMS:
        reading, settling, left, rate, memory = calculated(*given)
        rows, cols, rate_hz, dtype = given
        yield (
            f"| {rows}x{cols} at {rate_hz} Hz, {dtype} | {reading:.1f} | {CONVERSION_US} | "
            f"{settling:.1f} | {left:.1f} "
            f"| {rate / 1000:.1f} | {memory / 1000:.1f} |"
        )


if __name__ == "__main__":
    if not hasattr(time, "ticks_us"):
        raise SystemExit("this Python is not MicroPython; use micropython budget.py")
    for line in table():
        print(line)
    for given in FORMS:
        print(
            f"measured here: {pure_us(*given):.1f} us a frame of {given[0]}x{given[1]} {given[3]} "
            "without its reading"
        )
    measured = reading_us()
    if measured is None:
        print("a reading is measured on a Pico alone")
    else:
        print(
            f"measured here: {measured:.1f} us a reading, as settings.py has it, settling included"
        )
