"""The simulator as a backend: a clock that skips waits, a pseudo-terminal as serial line."""

import errno
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace

from palpate.core import config
from palpate.sim import devices, rig, skin
from tests.factories.paths import NO_SITE
from tests.rig import backends
from tests.rig.backends import Skin, skins, tty


class Simulated:
    """It has all capabilities, and its controls act at once."""

    name = "simulated"
    can = backends.ALL
    slack_s = 0.0
    pulse_s = 0.02
    format = skin.FORMAT

    def __init__(self, stack: ExitStack) -> None:
        self.clock = rig.VirtualClock()
        sim = devices.build(self.format, [], self.clock, "sim")
        settings = sim.wire(config.load(None, site=NO_SITE))
        self.gpio, self.backend = sim.gpio, sim.backend
        self.sensor, self.trigger, self.output = settings.skin, settings.trigger, settings.output
        self._far = tty.PseudoTerminalEnd(stack)
        self.serial = replace(settings.serial, port=str(self._far.path))
        self.put, self.pull = self._far.put, self._far.pull
        self.say, self.hear = self._far.say, self._far.hear

    def reset(self) -> None:
        self.backend.errors.clear()
        self.garble(False)
        self.plug(Skin())
        for line in filter(None, (self.trigger.start, self.trigger.stop, self.trigger.new_object)):
            self.drive(line, False)
        self.pull()
        self.put()

    def wait(self, seconds: float) -> None:
        self.clock.sleep_until(self.clock.now_ns() + round(seconds * 1e9))

    def after(self, seconds: float, control: Callable[[], None]) -> None:
        """Plan it: the bus looks at the agenda at each request."""
        self.backend.at(self.clock.now_ns() + round(seconds * 1e9), control)

    def plug(self, what: Skin) -> None:
        self.backend.board = skins.board(what, self.clock)

    def unplug(self) -> None:
        self.backend.unplug()

    def garble(self, on: bool) -> None:
        self.backend.mangle = skins.garbler() if on else lambda data: data

    def silence(self) -> None:
        self.backend.board.running = False

    def unbind(self, on: bool) -> None:
        """Fail all requests, as if the skin was unplugged."""
        self.backend.errors = dict.fromkeys(("open", "read", "control"), errno.ENODEV) if on else {}

    def hold(self, on: bool) -> None:
        """Let claiming fail."""
        self._fail("claim", errno.EBUSY, on)

    def deny(self, on: bool) -> None:
        """Let opening fail."""
        self._fail("open", errno.EACCES, on)

    def _fail(self, call: str, code: int, on: bool) -> None:
        self.backend.errors = {call: code} if on else {}

    def drive(self, line: str, level: bool) -> None:
        self.gpio.drive(line, level, self.clock.now_ns())

    def storm(self, line: str, edges: int) -> None:
        """One edge each microsecond."""
        for i in range(edges):
            self.wait(1e-6)
            self.drive(line, i % 2 == 0)

    def level(self, line: str) -> bool:
        """The level that the box wrote last."""
        return {name: level for _, name, level in self.gpio.written}.get(line, False)


@contextmanager
def opened() -> Iterator[Simulated]:
    with ExitStack() as stack:
        yield Simulated(stack)
