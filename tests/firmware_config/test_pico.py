"""The Pico's firmware as a whole, under MicroPython, at a terminal that the box reads."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from dataclasses import replace
from textwrap import dedent
from typing import Any

import numpy as np
import pytest

from palpate.core import config
from palpate.core.clock import SystemClock
from palpate.core.types import EPOCH_BITS, Frames, SweepFormat
from palpate.io import packets
from palpate.io.serial_link import ReadoutLink
from palpate.io.usb_sensor import UsbSensor
from tests.factories import pico
from tests.factories.paths import NO_SITE

pytestmark = pytest.mark.slow
LIMIT_S = 60
"""Time limit on a busy machine."""
FORM = {"ROWS": 3, "COLS": 5, "RATE_HZ": 200}


class PortReader:
    """The box's sensor at the port of a readout board."""

    def __init__(
        self, port: str, rows: int = 3, cols: int = 5, rate_hz: float = 200, dtype: str = "uint8"
    ) -> None:
        sensor = config.load(None, site=NO_SITE).skin
        self.format = SweepFormat(rows, cols, rate_hz, 100, dtype)
        # silence: on a busy machine the interpreter may not run for a while
        settings = replace(sensor, link="serial", port=port, silence_ms=20_000)
        self.sensor = UsbSensor(settings, self.format, SystemClock())

    def frames(self, n: int) -> Frames:
        """At least `n` frames."""
        end_s, parts = time.monotonic() + LIMIT_S, [self.sensor.read()]
        while sum(map(len, parts)) < n:
            assert time.monotonic() < end_s, f"{self.sensor.state}: {self.sensor.trouble}"
            parts.append(self.sensor.read())
        return Frames.joined(parts)

    def __enter__(self) -> PortReader:
        return self

    def __exit__(self, *_: object) -> None:
        self.sensor.close()


def scans(frames: Frames) -> np.ndarray:
    """Number of the scan of each frame, modulo 97; fails unless each taxel stands at its index."""
    taxels = frames.taxels.astype(int) >> (8 if frames.taxels.itemsize == 2 else 0)
    flat = taxels.reshape(len(taxels), -1)
    assert ((flat - flat[:, :1]) % 256 == np.arange(flat.shape[1])).all()
    return flat[:, 0]


def check_all_there(frames: Frames) -> None:
    """No frame is missing, but those whose interrupt came late, which the numbers show."""
    assert (np.diff(scans(frames)) % 97 == 1).all()
    assert (np.diff(frames.seq) >= 1).all()


@pytest.mark.parametrize(
    "format",
    [
        {"ROWS": 4, "COLS": 4, "RATE_HZ": 750},
        {"ROWS": 16, "COLS": 16, "RATE_HZ": 50, "DTYPE": "uint16"},
        {"ROWS": 3, "COLS": 5, "RATE_HZ": 100, "HARD_TIMER": False, "TRIGGER_PIN": 15},
    ],
)
def test_the_box_reads_it(format: dict[str, Any]) -> None:
    """Identity, format, and each taxel at its index, through switched multiplexers."""
    given = {
        name.lower(): format[name]
        for name in ("ROWS", "COLS", "RATE_HZ", "DTYPE")
        if name in format
    }
    with pico.plugged_in(**format) as port, PortReader(port, **given) as reader:
        check_all_there(reader.frames(100))
        who, counters = reader.sensor.identity, reader.sensor.counters
        assert who == packets.Identity(1, (1, 0, 0), "palpate-pico", "e6614c311b4c7a2e")
        assert (counters.garbage_bytes, counters.stale_frames, counters.fifo_overflows) == (0, 0, 0)
        assert counters.enumerations == 1


def test_it_is_taken_up_again() -> None:
    """A program that ended, with STOP or without, leaves a board that the next can use."""
    with pico.plugged_in(**FORM) as port:
        with PortReader(port) as reader:
            reader.frames(20)
        died = ReadoutLink(port, 115200, SystemClock())
        died.request(packets.Request.START, 0)
        assert died.read(4096, LIMIT_S * 1000)
        died._port.close()  # without STOP
        with PortReader(port) as reader:
            check_all_there(reader.frames(50))
            assert reader.sensor.counters.enumerations == 1


def test_counters_wrap() -> None:
    """Number, device time and ticks wrap while the box reads: nothing is lost or repeated."""
    near = {
        "seq": [65536 - 50, 65535],
        "t_us": [65536 - 30_000, 65535 - 3],
        "ticks": (1 << 30) - 400_000,
    }
    with pico.plugged_in(**FORM, **near) as port, PortReader(port) as reader:
        frames = reader.frames(200)
        check_all_there(frames)
        assert frames.seq[0] & ((1 << EPOCH_BITS) - 1) >= (1 << 32) - 50
        assert frames.seq[-1] & ((1 << EPOCH_BITS) - 1) >= 1 << 32
        assert (np.diff(frames.t_ns) > 0).all()
        assert (reader.sensor.counters.stale_frames, reader.sensor.counters.enumerations) == (0, 1)


@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
def test_an_interrupt_allocates_nothing(dtype: str) -> None:
    """3000 frames with gaps and an overflow, with the heap locked; one allocation fails."""
    allocates = dedent("""
    import sys
    sys.path.append({folder!r})  # after the folder of the firmware, which has settings, too
    import pico_shell, settings, micropython, gc
    sys.modules["machine"] = machine = pico_shell.PicoMachine(settings, pico_shell.OPTIONS)
    sys.modules["time"] = clock = pico_shell.PicoTicks(0)
    machine.Pin.__call__ = lambda self, level: None  # the doubles may allocate nothing either
    machine.ADC.read_u16 = lambda self: 0x1234
    import main
    {change}
    made = main.board(settings)
    made.running = True  # as START makes it, without the thread
    now = 0
    clock.ticks_us = lambda: now
    def frames(n):
        global now
        for i in range(n):
            now += 1333 if i % 50 else 9000
            micropython.heap_lock()
            made.tick()
            micropython.heap_unlock()
    frames(3000)
    print("nothing", made._fifo._overflowed)
    """)

    def allocating(change: str) -> subprocess.CompletedProcess[str]:
        """Ticks with the heap locked, after a change of the settings."""
        return pico.run("-c", allocates.format(folder=str(pico.SHELL.parent), change=change))

    done = allocating(f"settings.DTYPE = {dtype!r}; settings.FIFO_S = 0.5")
    assert done.stdout == "nothing True\n", done.stderr
    worse = allocating("main.readout.Fifo.filled = lambda self: [0] * 100")
    assert "MemoryError: memory allocation failed, heap is locked" in worse.stdout + worse.stderr


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"COLS": 40}, "ValueError: COLS = 40 is out of range; use 1 to 16"),
        (
            {"ROWS": 16, "COLS": 16, "FIFO_S": 60},
            "ValueError: FIFO_S = 60 does not fit the memory; use less, at least 0.25",
        ),
    ],
)
def test_settings_that_cannot_be(options: dict[str, Any], message: str) -> None:
    """The last line of what MicroPython prints names the setting, its value and what to do."""
    command = [
        pico.interpreter(),
        str(pico.SHELL),
        str(pico.FIRMWARE),
        json.dumps({"RATE_HZ": 750} | options),
    ]
    ended = subprocess.run(command, input=b"\1", capture_output=True, timeout=LIMIT_S)
    # MicroPython prints an error on either
    said = (ended.stderr + ended.stdout).decode().splitlines()
    assert [line for line in said if line != "serves"][-1] == message
    assert ended.returncode == 1


def test_ctrl_c_is_a_byte_while_it_serves() -> None:
    """The number of START must not interrupt it; after an error Ctrl-C works again."""
    ctrl_c = dedent("""
    import sys
    sys.path.append({folder!r})  # after the folder of the firmware, which has settings, too
    import pico_shell, settings
    sys.modules["machine"] = pico_shell.PicoMachine(settings, pico_shell.OPTIONS)
    import main
    class Recorded:
        def kbd_intr(self, char):
            print("kbd_intr", char)
    served = []
    def serve(board, *streams):
        print("serving")
        served.append(board)
        board.request(3)
        raise OSError(5)
    main.micropython, main.readout.serve = Recorded(), serve
    try:
        main.run(settings)
    except OSError:
        print("still running", served[0].running)
    """)
    done = pico.run("-c", ctrl_c.format(folder=str(pico.SHELL.parent)))
    assert done.stdout.splitlines() == [
        "kbd_intr -1",
        "serving",
        "kbd_intr 3",
        "still running False",
    ], done.stderr


def test_the_budget_says_which_python_it_needs() -> None:
    """Another Python than MicroPython gets one line."""
    budget = [sys.executable, pico.FIRMWARE / "budget.py"]
    done = subprocess.run(budget, capture_output=True, text=True, timeout=LIMIT_S, check=False)
    assert "micropython budget.py" in done.stderr.splitlines()[0]
