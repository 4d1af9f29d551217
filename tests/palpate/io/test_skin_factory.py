"""The factory: sensor and format for each profile, and a terminal with an emulated skin."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace

import pytest

from palpate.core import config
from palpate.core.clock import SystemClock
from palpate.core.config import Config
from palpate.core.devices import Devices
from palpate.core.errors import ConfigError
from palpate.core.types import SweepFormat
from palpate.io import skins
from palpate.io.serial_sensor import SerialSensor
from palpate.io.usb_sensor import UsbSensor
from palpate.sim import skin
from palpate.tools import pseudo_terminal
from tests.factories.paths import NO_SITE
from tests.factories.simulated_box import idle_devices
from tests.factories.skin_wires import NAMES, profile, taxels, wire


def settings(*sets: str) -> Config:
    """The delivered settings with these changes."""
    return config.load(None, sets, site=NO_SITE)


@pytest.mark.parametrize("name", NAMES)
def test_each_profile_has_its_sensor_and_form(name):
    """Other skins are read from a serial port, in the profile's format, without asking."""
    simulated = idle_devices()
    chosen = settings(f"skin.profile={name}")
    assert skins.announced(chosen, simulated) == profile(name).format
    assert isinstance(skins.sensor(chosen, profile(name).format, simulated), SerialSensor)


def test_the_protocol_has_the_old_sensor_and_a_wrong_profile_none():
    """Its board is asked for the format; a wrong name is not guessed."""
    simulated = idle_devices()
    chosen = simulated.wire(settings("skin.profile=flexitac", "skin.grid=3x3"))
    assert isinstance(skins.sensor(chosen, skin.FORMAT, simulated), UsbSensor)
    assert skins.announced(chosen, simulated) == skin.FORMAT
    with pytest.raises(ConfigError, match="flexitac"):
        skins.sensor(settings("skin.profile=flexitak"), skin.FORMAT, idle_devices())


def test_rate_and_form_are_the_bundles_or_a_persons():
    """250 Hz if the skin has it; the error's examples are understood, two seconds long."""
    simulated, chosen = idle_devices(), settings("skin.profile=papillarray")
    wanted = SweepFormat(3, 3, 250, 500, "float32", 3)
    assert skins.announced(chosen, simulated, wanted) == wanted
    assert skins.announced(chosen, simulated, replace(wanted, rate_hz=300)).rate_hz == 1000
    assert skins.described("5x3:float32:100") == SweepFormat(5, 3, 100.0, 200, "float32")
    assert skins.described(" 4x4x3:int16:250 ") == SweepFormat(4, 4, 250.0, 500, "int16", 3)
    with pytest.raises(ConfigError, match="5x3"):
        skins.described("5x3")
    with pytest.raises(ConfigError, match="0x3:int16:9"):
        skins.described("0x3:int16:9")


@pytest.fixture
def playing() -> Iterator[str]:
    """Path of a terminal on which a FlexiTac sends 100 frames a second."""
    with pseudo_terminal.pair() as (far, path):
        ended = threading.Event()

        def play() -> None:
            rest, i, begin = b"", 0, time.monotonic()
            while not ended.is_set():
                if not rest:
                    # 100 Hz on average, however busy the machine
                    ended.wait(max(0, begin + i / 100 - time.monotonic()))
                    rest, i = wire("flexitac", i), i + 1
                try:
                    rest = rest[os.write(far, rest) :]
                except BlockingIOError:
                    ended.wait(0.001)

        thread = threading.Thread(target=play)
        thread.start()
        yield path
        ended.set()
        thread.join()


def test_on_a_real_terminal(playing):
    """Real pyserial on a terminal: frames as they were sent, and a free port after it."""
    clock = SystemClock()
    chosen = settings("skin.profile=flexitac", f"skin.port={playing}")
    known = {taxels(profile("flexitac"), i).tobytes() for i in range(199)}
    for _ in range(2):
        with closing(
            skins.sensor(chosen, profile("flexitac").format, Devices(clock, None))
        ) as sensor:
            end_ns, n = clock.now_ns() + 20_000_000_000, 0
            while n < 50:
                assert clock.now_ns() < end_ns, f"{sensor.state}: {sensor.trouble}"
                frames = sensor.read()
                assert all(one.tobytes() in known for one in frames.taxels)
                n += len(frames)
            assert sensor.identity
            assert sensor.identity.board == "flexitac"
            assert not sensor.loss_known
