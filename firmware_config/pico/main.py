"""The readout board on a Raspberry Pi Pico: pins, converter, timer and the port, around
`readout`."""

import select
import sys
import time
from array import array

import micropython
import readout
import settings
from machine import ADC, Pin, Timer, disable_irq, enable_irq, unique_id


class Scanner:
    """Reads the taxels one by one, in an interrupt, where nothing may be allocated. So it is a
    class: a closure allocates when it is called with more than five names. It assigns at most three
    names at once, since four make a tuple."""

    def __init__(self, format, row_pins, col_pins, adc_pin, settle_us):
        lines, levels, taxels = readout.reading_order(format.rows, format.cols)
        self._lines, self._levels, self._taxels = (
            bytearray(lines),
            bytearray(levels),
            array("H", taxels),
        )
        self._pins = [Pin(number, Pin.OUT, value=0) for number in tuple(row_pins) + tuple(col_pins)]
        self._read, self._settle_us = ADC(Pin(adc_pin)).read_u16, settle_us
        # (buffer, at): writes a frame there
        self.scan = self._scan8 if format.item_bytes == 1 else self._scan16

    @micropython.native
    def _scan8(self, buffer, at):
        lines, levels, taxels = self._lines, self._levels, self._taxels
        pins, settle_us = self._pins, self._settle_us
        read, sleep_us = self._read, time.sleep_us
        for i in range(len(lines)):
            pins[lines[i]](levels[i])
            taxel = taxels[i]
            if taxel != 0xFFFF:  # readout.NO_TAXEL
                sleep_us(settle_us)
                buffer[at + taxel] = read() >> 8

    @micropython.native
    def _scan16(self, buffer, at):
        lines, levels, taxels = self._lines, self._levels, self._taxels
        pins, settle_us = self._pins, self._settle_us
        read, sleep_us = self._read, time.sleep_us
        for i in range(len(lines)):
            pins[lines[i]](levels[i])
            taxel = taxels[i]
            if taxel != 0xFFFF:  # readout.NO_TAXEL
                sleep_us(settle_us)
                value = read()
                taxel = at + taxel + taxel
                buffer[taxel] = value & 255
                buffer[taxel + 1] = value >> 8


class Ticker:
    """The timer for `readout.Readout`."""

    def __init__(self, hard):
        self._timer = Timer()
        self._options = {"hard": True} if hard else {}  # older versions do not have this option

    def start(self, period_us, callback):
        """Call `callback` once a period."""
        self._timer.init(
            mode=Timer.PERIODIC,
            period=period_us,
            tick_hz=1000000,
            callback=callback,
            **self._options,
        )

    def stop(self):
        self._timer.deinit()


def board(config, **counters):
    """The readout board with these settings. counters: see `readout.Readout`."""
    format = readout.Format(
        config.ROWS, config.COLS, config.RATE_HZ, config.DTYPE, config.FIFO_S, config.BOARD
    )
    scan = Scanner(format, config.ROW_PINS, config.COL_PINS, config.ADC_PIN, config.SETTLE_US).scan
    level = (
        (lambda: 0)
        if config.TRIGGER_PIN is None
        else Pin(config.TRIGGER_PIN, Pin.IN, Pin.PULL_DOWN)
    )
    serial = "".join(f"{byte:02x}" for byte in unique_id())[-16:]
    ticker = Ticker(config.HARD_TIMER)
    try:
        return readout.Readout(
            format, serial, scan, level, time, ticker, disable_irq, enable_irq, **counters
        )
    except MemoryError:
        raise ValueError(
            f"FIFO_S = {config.FIFO_S} does not fit the memory; use less, at least 0.25"
        ) from None


def run(config=settings, **counters):
    """Serve the port. Ctrl-C is disabled, since its byte is the number of START."""
    made = board(config, **counters)
    poll = select.poll()
    poll.register(sys.stdin, select.POLLIN)

    def readable(ms):
        for _ in poll.ipoll(ms):  # without allocation
            return True
        return False

    micropython.kbd_intr(-1)
    try:
        readout.serve(made, sys.stdin.buffer, sys.stdout.buffer, readable)
    finally:
        made.request(readout.STOP)
        micropython.kbd_intr(3)


if __name__ == "__main__" and Pin(settings.SERVICE_PIN, Pin.IN, Pin.PULL_UP).value():
    # an interrupt cannot allocate the message of its failure
    micropython.alloc_emergency_exception_buf(100)
    run()
