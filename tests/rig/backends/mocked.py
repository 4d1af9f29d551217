"""umockdev as a backend, in real time, under umockdev-wrapper: skins, a GPIO chip, a port."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace

from palpate.core import config
from tests.factories.paths import NO_SITE
from tests.rig import backends
from tests.rig.backends import Skin, mocked_gpio, mocked_usb, mocks, real, skins, tty

BOARD = "rpi5"


class Mocked(real.Real):
    """The GPIO lines have the names of a Raspberry Pi 5."""

    name = "mocked"
    can = backends.ALL

    def __init__(self, stack: ExitStack, bench: mocks.MockedDevices) -> None:
        super().__init__(stack)
        settings = config.load(BOARD, site=NO_SITE)
        self.sensor, self.trigger, self.output = settings.skin, settings.trigger, settings.output
        self._inputs = [self.trigger.start, self.trigger.stop, self.trigger.new_object]
        self._bench, self._socket = bench, mocked_usb.Socket(bench)
        self._chip = mocked_gpio.Chip(bench, [f"GPIO{i}" for i in range(28)])
        self._far = tty.PseudoTerminalEnd(stack)
        self.serial = replace(settings.serial, port=str(self._far.path))
        self.put, self.pull = self._far.put, self._far.pull
        self.say, self.hear = self._far.say, self._far.hear
        self.drive, self.unplug = self._chip.drive, self._socket.unplug

    def reset(self) -> None:
        self.settle()
        self.deny(False)
        self.plug(Skin())
        for line in self._inputs:
            self.drive(line, False)
        self.pull()
        self.put()

    def plug(self, what: Skin) -> None:
        self._socket.plug(skins.board(what, self.clock))

    def garble(self, on: bool) -> None:
        assert self._socket.device
        self._socket.device.mangle = skins.garbler() if on else lambda data: data

    def silence(self) -> None:
        assert self._socket.device
        self._socket.device.board.running = False

    def unbind(self, on: bool) -> None:
        self._socket.unbind(on)

    def deny(self, on: bool) -> None:
        self._bench.close_to_all(self._socket.name, on)

    def storm(self, line: str, edges: int) -> None:
        for i in range(edges):
            self.drive(line, i % 2 == 0)

    def level(self, line: str) -> bool:
        return self._chip.level(line)


@contextmanager
def opened() -> Iterator[Mocked]:
    """A mocked machine. Raises BackendMissing without umockdev, or if it wraps no ioctls here."""
    with ExitStack() as stack:
        bench = mocks.MockedDevices()
        stack.callback(bench.close)
        yield Mocked(stack, bench)
