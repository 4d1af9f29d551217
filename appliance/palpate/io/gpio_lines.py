"""Finds GPIO lines by name, requests them and drives the outputs READY, BUSY, FAULT, DECIDED, class
bits and RESULT VALID, which hold a verdict as a code (`robot_link.LineSink`).

All access is through libgpiod v2. The module (`import gpiod`, or the simulator's double) is passed
in. numpy is not imported, since `cli.lower_outputs` needs to start fast.
"""

from __future__ import annotations

import errno
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Any

from palpate.core.errors import LineError
from palpate.core.text import closest

if TYPE_CHECKING:
    from gpiod import LineRequest

    from palpate.core.clock import Clock
    from palpate.core.config import OutputConfig

MAX_CHIPS = 256
"""Largest number of GPIO devices in the kernel (GPIO_DEV_MAX)."""
QUEUE = 1024
"""Length of the kernel's event queue of a request, the largest; a full one drops the oldest."""
_PLACE = re.compile(r"(?:/dev/)?(gpiochip[0-9]{1,3})[: ]([0-9]{1,4})")
_ADVICE = {
    errno.EACCES: "add the user to group gpio, and in a unit set DeviceAllow=char-gpiochip",
    errno.EPERM: "add the user to group gpio, and in a unit set DeviceAllow=char-gpiochip",
    errno.EBUSY: "another program or driver holds one of them; gpioinfo shows which",
    errno.ENXIO: "one of them cannot raise interrupts; choose another line",
    errno.EINVAL: "the chip refuses a resistor or edges on one of them; choose another line",
    errno.ENODEV: "the chip is gone; plug it in and start again",
}


def check_binding(gpio: Any) -> None:
    """Raises LineError unless `gpio` is the libgpiod v2 binding or a double of it."""
    if not (hasattr(gpio, "request_lines") and hasattr(gpio, "LineSettings")):
        version = getattr(gpio, "__version__", "of unknown version")
        raise LineError(
            f"module gpiod {version} is not the libgpiod v2 binding; pip install 'gpiod>=2' in a"
            " virtual environment (Debian's python3-libgpiod 1.6 shadows it)"
        )


def find_lines(gpio: Any, names: Sequence[str]) -> dict[str, tuple[str, int]]:
    """Map each name to (path of its chip, offset), searching all chips of this machine. A line
    without a name is given as chip and offset, such as "gpiochip0:17". Raises LineError if a line
    is given twice, missing or ambiguous, if a chip may not be opened, or without any chip."""
    if len(set(names)) < len(names):
        raise LineError(f"one of {', '.join(names)} has two roles; give each role its own line")
    found = {name: _at_offset(gpio, *place) for name in names if (place := _place(name))}
    named = [name for name in names if name not in found]
    places, denied = _catalogue(gpio) if named else ({}, [])
    for name in named:
        found[name] = _only(name, places, denied)
    twice = [name for name in names if list(found.values()).count(found[name]) > 1]
    if twice:
        both = " and ".join(twice)
        raise LineError(f"{both} are the same gpio line; give each role its own line")
    return {name: found[name] for name in names}


def _only(
    name: str, places: dict[str, list[tuple[str, int]]], denied: list[str]
) -> tuple[str, int]:
    """The place of a name. Raises LineError if it has none or several."""
    match places.get(name, []):
        case [place]:
            return place
        case []:
            if denied:
                what = f"may not open {', '.join(denied)} (errno 13)"
                advice = _ADVICE[errno.EACCES]
                raise LineError(f"{what}, where gpio line {name!r} might be; {advice}")
            near = closest(name, places, 3) or sorted(places)[:3]
            hint = f"nearest: {', '.join(near)}" if near else "give one such as gpiochip0:17"
            raise LineError(f"no gpio line is named {name!r}; {hint}; gpioinfo lists them all")
        case several:
            where = " and ".join(f"{path} line {offset}" for path, offset in several)
            raise LineError(f"gpio line {name!r} is ambiguous: {where}; use gpiochip0:17 or alike")


def _place(name: str) -> tuple[str, int] | None:
    """Path of the chip, and offset, of a line that is given by them; None for a name."""
    match = _PLACE.fullmatch(name)
    return (f"/dev/{match[1]}", int(match[2])) if match else None


def _at_offset(gpio: Any, path: str, offset: int) -> tuple[str, int]:
    """A place, checked. Raises LineError."""
    if not gpio.is_gpiochip_device(path):
        raise LineError(f"{path} is not a gpio chip of this machine; gpiodetect lists them")
    with naming("look at", [f"{path}:{offset}"]), gpio.Chip(path) as chip:
        lines = chip.get_info().num_lines
    if offset >= lines:
        raise LineError(f"{path} has no line {offset}; use 0 to {lines - 1}")
    return path, offset


def _catalogue(gpio: Any) -> tuple[dict[str, list[tuple[str, int]]], list[str]]:
    """All named GPIO lines with their places, and the paths of chips that are denied."""
    places: dict[str, list[tuple[str, int]]] = {}
    denied = []
    chips = set()
    for path in filter(gpio.is_gpiochip_device, (f"/dev/gpiochip{n}" for n in range(MAX_CHIPS))):
        try:
            with gpio.Chip(path) as chip:
                info = chip.get_info()
                # a second device name of the same chip, as on Raspberry Pi OS
                if info.name in chips:
                    continue
                chips.add(info.name)
                for offset in range(info.num_lines):
                    if name := chip.get_line_info(offset).name:
                        places.setdefault(name, []).append((path, offset))
        except PermissionError:
            denied.append(path)
        except OSError as e:
            raise LineError(f"cannot list the gpio lines of {path}: {e}; see dmesg") from e
    if not chips and not denied:
        raise LineError(
            "this machine has no /dev/gpiochip*; load the driver of its gpio chip, or leave `board`"
            " out and set trigger.mode to serial, key or timed"
        )
    return places, denied


def line_error(doing: str, names: Iterable[str], e: OSError) -> LineError:
    """A LineError that explains an errno and lists the GPIO lines."""
    advice = _ADVICE.get(e.errno or 0, "see the kernel log (dmesg)")
    return LineError(
        f"cannot {doing} gpio lines {', '.join(names)}: {e.strerror} (errno {e.errno}); {advice}"
    )


@contextmanager
def naming(doing: str, names: Iterable[str]) -> Iterator[None]:
    """Turn an OSError into a LineError that lists the GPIO lines."""
    try:
        yield
    except OSError as e:
        raise line_error(doing, names, e) from e


def request_lines(
    gpio: Any, names: Sequence[str], settings: Any, stack: ExitStack, *, separate: bool = False
) -> list[tuple[LineRequest, dict[int, str]]]:
    """A request for each chip, or `separate` for each line, with its {offset: name}."""
    groups: dict[tuple[str, str], dict[int, str]] = {}
    for name, (path, offset) in find_lines(gpio, names).items():
        groups.setdefault((path, name if separate else ""), {})[offset] = name
    requests = []
    for (path, _), lines in groups.items():
        with naming("request", lines.values()):
            request = gpio.request_lines(
                path, {tuple(lines): settings}, consumer="palpate", event_buffer_size=QUEUE
            )
        stack.callback(request.release)
        requests.append((request, lines))
    return requests


class Lines:
    """The output GPIO lines of the box, all low at first. An empty name means that the line is not
    wired. Raises LineError if lines cannot be found, requested or written."""

    def __init__(self, config: OutputConfig, gpio: Any, clock: Clock) -> None:
        check_binding(gpio)
        self._status_lines = config.ready, config.busy, config.fault, config.decided
        self._valid, self._bits = config.result_valid, config.class_bits
        self._settle_ns = config.settle_us * 1000
        self._clock, self._value = clock, gpio.line.Value
        names = [name for name in (*self._status_lines, self._valid, *self._bits) if name]
        self._levels = dict.fromkeys(names, False)
        self._status = False, False, False, False
        settings = gpio.LineSettings(
            direction=gpio.line.Direction.OUTPUT, output_value=self._value.INACTIVE
        )
        with ExitStack() as stack:
            self._requests = request_lines(gpio, names, settings, stack)
            self._open = stack.pop_all()

    @property
    def capacity(self) -> int:
        """Number of codes that the class bits can represent: 2 to the number of bits."""
        return 1 << len(self._bits)

    def show(self, *, ready: bool, busy: bool, fault: bool, decided: bool = False) -> None:
        """Set READY, BUSY, FAULT and DECIDED. RESULT VALID falls when BUSY rises."""
        if (ready, busy, fault, decided) == self._status:
            return
        if busy and not self._status[1]:
            self.result(None)
        self._status = ready, busy, fault, decided
        self._write(dict(zip(self._status_lines, self._status, strict=True)))

    def result(self, code: int | None) -> None:
        """Output a class code: RESULT VALID falls, the class bits change, and RESULT VALID rises
        `settle_us` later. With None, RESULT VALID only falls. With a code outside 0..capacity-1 it
        falls as well, and LineError is raised."""
        self._write({self._valid: False})
        if code is None:
            return
        if not 0 <= code < self.capacity:
            bits = f"{len(self._bits)} class bits"
            raise LineError(f"code {code} does not fit {bits}; wire more in output.class_bits")
        self._write({name: bool(code >> i & 1) for i, name in enumerate(self._bits)})
        self._clock.sleep_until(self._clock.now_ns() + self._settle_ns)
        self._write({self._valid: True})

    def close(self) -> None:
        """Set all GPIO lines low, then release them."""
        try:
            self._write(dict.fromkeys(self._levels, False))
        finally:
            self._requests = []
            self._open.close()

    def _write(self, wanted: dict[str, bool]) -> None:
        new = {name: on for name, on in wanted.items() if self._levels.get(name, on) != on}
        level = {True: self._value.ACTIVE, False: self._value.INACTIVE}
        for request, names in self._requests:
            changed = {offset: name for offset, name in names.items() if name in new}
            if changed:
                with naming("write", changed.values()):
                    request.set_values({o: level[new[n]] for o, n in changed.items()})
                self._levels.update({name: new[name] for name in changed.values()})
