"""Runs firmware_config/pico under MicroPython's unix port with mocked pins, converter and timer.

Arguments: the firmware's folder, and a JSON object with SETTINGS and `OPTIONS` by name. The
firmware serves standard input and output instead of its port, once it has reported so on standard
error. Taxel k of the n-th scanned frame reads (n % 97 + k) % 256 in its upper 8 bits and n in its
lower bits, so wrong wiring shows.
"""

import _thread
import json
import sys
import time

OPTIONS = {
    "seq": [0, 0],
    "t_us": [0, 0],
    "ticks": 0,
    "late_ms": 0,
    "late_every": 100,
    "serial": "e6614c311b4c7a2e",
}
"""seq, t_us: first frame number and time (low, high). ticks: first result of `ticks_us`. late_ms:
delay of every `late_every`th interrupt.
"""
PERIOD = 1 << 30
"""A Pico's ticks wrap here."""


class PicoMachine:
    """Replaces `machine`: two multiplexers with a matrix of taxels between them."""

    def __init__(self, config, options):
        self.lock, self.levels, self.scans = _thread.allocate_lock(), {}, -1
        self.unique_id = lambda: bytes.fromhex(options["serial"])
        machine = self

        class Pin:
            """A pin. Calling it with a level sets it."""

            IN, OUT, PULL_UP, PULL_DOWN = 0, 1, 2, 3

            def __init__(self, number, mode=0, pull=0, value=0):
                self.number = number
                machine.levels[number] = value

            def __call__(self, *level):
                if level:
                    machine.levels[self.number] = level[0]
                return machine.levels[self.number]

            value = __call__

        class ADC:
            """The converter."""

            def __init__(self, pin):
                assert pin.number == config.ADC_PIN

            def read_u16(self):
                row, col = machine.selected(config.ROW_PINS), machine.selected(config.COL_PINS)
                assert row < config.ROWS
                assert col < config.COLS
                if row == col == 0:
                    machine.scans += 1
                return ((machine.scans % 97 + row * config.COLS + col) % 256) << 8 | (
                    machine.scans & 255
                )

        class Timer:
            """A thread that interrupts anywhere, as a hard timer does."""

            PERIODIC = 1

            def __init__(self):
                self._run = 0

            def init(self, mode, period, tick_hz, callback, **hard):
                assert (mode, tick_hz) == (self.PERIODIC, 1000000)
                assert hard == ({"hard": True} if config.HARD_TIMER else {})
                self._run += 1
                _thread.start_new_thread(self._fire, (self._run, period, callback))

            def deinit(self):
                with machine.lock:
                    self._run += 1

            def _fire(self, run, period, callback):
                due, fired = time.ticks_us(), 0
                while True:
                    due += period
                    fired += 1
                    at = due + (
                        options["late_ms"] * 1000 if fired % options["late_every"] == 0 else 0
                    )
                    while time.ticks_us() < at:
                        time.sleep_us(max(0, at - time.ticks_us()))
                    with machine.lock:
                        if run != self._run:
                            return
                        callback(self)

        self.Pin, self.ADC, self.Timer = Pin, ADC, Timer

    def selected(self, pins):
        """The channel that the select pins choose."""
        return sum(self.levels[pin] << bit for bit, pin in enumerate(pins))

    def disable_irq(self):
        self.lock.acquire()

    def enable_irq(self, state):
        self.lock.release()


class PicoTicks:
    """Replaces `time`: its ticks wrap as a Pico's do and do not start at 0."""

    def __init__(self, first):
        self._first = first - time.ticks_us()
        self.sleep_us = lambda us: None

    def ticks_us(self):
        """Microseconds, wrapped."""
        return (time.ticks_us() + self._first) % PERIOD

    def ticks_add(self, ticks, delta):
        """Add as MicroPython does."""
        return (ticks + delta) % PERIOD

    def ticks_diff(self, later, earlier):
        """Subtract as MicroPython does."""
        return (later - earlier + PERIOD // 2) % PERIOD - PERIOD // 2


def main(folder, text):
    """Run the firmware until standard input ends."""
    sys.path.insert(0, folder)
    import settings

    options = dict(OPTIONS)
    for name, value in json.loads(text).items():
        if name in options:
            options[name] = value
        else:
            setattr(settings, name, value)
    sys.modules["machine"] = PicoMachine(settings, options)
    sys.modules["time"] = PicoTicks(options["ticks"])
    firmware = __import__("main")
    sys.stderr.write("serves\n")
    firmware.run(settings, seq=tuple(options["seq"]), t_us=tuple(options["t_us"]))


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2])
