"""The lines room: GPIO by name. In: line names and the module gpiod. Out: requests, and READY, BUSY, FAULT, DECIDED,
class bits, RESULT VALID as levels.

Everything goes through libgpiod v2; the module itself (`import gpiod`, or the simulator's double) is passed in.
"""

from __future__ import annotations

import errno
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Any, Self

from appliance.core.errors import LineError
from appliance.core.schema import closest

if TYPE_CHECKING:
    from gpiod import LineRequest

    from appliance.core.clock import Clock
    from appliance.core.config import OutputConfig

MAX_CHIPS = 256
"""The kernel makes no more GPIO devices (GPIO_DEV_MAX)."""
QUEUE = 1024
"""Events that the kernel may hold for one request; it grants no more. Then it drops the oldest."""
_ADVICE = {
    errno.EACCES: "add the user to group gpio, and in a unit set DeviceAllow=char-gpiochip",
    errno.EPERM: "add the user to group gpio, and in a unit set DeviceAllow=char-gpiochip",
    errno.EBUSY: "another program or driver holds one of them; gpioinfo tells which",
    errno.ENXIO: "one of them cannot raise interrupts; choose another line",
    errno.EINVAL: "the chip may not know this bias; try bias = 'as-is'",
    errno.ENODEV: "the chip is gone; plug it in and start again",
}


def check_binding(gpio: Any) -> None:
    """Raise LineError unless `gpio` is the libgpiod v2 binding or does as it does."""
    if not (hasattr(gpio, "request_lines") and hasattr(gpio, "LineSettings")):
        raise LineError(
            f"module gpiod {getattr(gpio, '__version__', 'of unknown version')} is not the libgpiod v2 binding; "
            "pip install 'gpiod>=2' (Debian's python3-libgpiod 1.6 shadows it: remove it or use a virtual environment)"
        )


def find_lines(gpio: Any, names: Sequence[str]) -> dict[str, tuple[str, int]]:
    """Name -> (path of its chip, offset there), over all chips of this machine.

    Raises LineError for a name given twice, missing or ambiguous, for chips that may not be opened, and for no chip.
    """
    if len(set(names)) < len(names):
        raise LineError(f"a gpio line is given two roles in {', '.join(names)}; give each role its own line")
    places, denied = _catalogue(gpio) if names else ({}, [])
    found = {}
    for name in names:
        match places.get(name, []):
            case [place]:
                found[name] = place
            case []:
                if denied:
                    what, advice = f"may not open {', '.join(denied)} (errno 13)", _ADVICE[errno.EACCES]
                    raise LineError(f"{what}, where gpio line {name!r} might be; {advice}")
                near = closest(name, places, 3) or sorted(places)[:3]
                raise LineError(f"no gpio line is named {name!r}; nearest: {', '.join(near)}; gpioinfo lists them all")
            case several:
                where = " and ".join(f"{path} line {offset}" for path, offset in several)
                raise LineError(f"gpio line {name!r} is ambiguous: {where}; choose a line whose name is unique")
    return found


def _catalogue(gpio: Any) -> tuple[dict[str, list[tuple[str, int]]], list[str]]:
    """All named lines with their places, and the chips that may not be opened."""
    places: dict[str, list[tuple[str, int]]] = {}
    denied = []
    chips = set()
    for path in filter(gpio.is_gpiochip_device, (f"/dev/gpiochip{n}" for n in range(MAX_CHIPS))):
        try:
            with gpio.Chip(path) as chip:
                info = chip.get_info()
                if info.name in chips:  # a link to a chip that was seen already, as Raspberry Pi OS has
                    continue
                chips.add(info.name)
                for offset in range(info.num_lines):
                    if name := chip.get_line_info(offset).name:
                        places.setdefault(name, []).append((path, offset))
        except PermissionError:
            denied.append(path)
        except OSError as e:
            raise LineError(f"cannot list the gpio lines of {path}: {e}; see the kernel log (dmesg)") from e
    if not chips and not denied:
        raise LineError("this machine has no /dev/gpiochip*; load the driver of its gpio chip or plug in one on USB")
    return places, denied


def line_error(doing: str, names: Iterable[str], e: OSError) -> LineError:
    """What an errno means to a person, with the lines that it befell."""
    advice = _ADVICE.get(e.errno or 0, "see the kernel log (dmesg)")
    return LineError(f"cannot {doing} gpio lines {', '.join(names)}: {e.strerror} (errno {e.errno}); {advice}")


@contextmanager
def naming(doing: str, names: Iterable[str]) -> Iterator[None]:
    """Make a LineError that names the lines of any OSError."""
    try:
        yield
    except OSError as e:
        raise line_error(doing, names, e) from e


def request_lines(
    gpio: Any, names: Sequence[str], settings: Any, stack: ExitStack, *, apart: bool = False
) -> list[tuple[LineRequest, dict[int, str]]]:
    """One request per chip, or with `apart` one per line, each with {offset: name}; `stack` releases them."""
    groups: dict[tuple[str, str], dict[int, str]] = {}
    for name, (path, offset) in find_lines(gpio, names).items():
        groups.setdefault((path, name if apart else ""), {})[offset] = name
    requests = []
    for (path, _), lines in groups.items():
        with naming("request", lines.values()):
            request = gpio.request_lines(path, {tuple(lines): settings}, consumer="palpate", event_buffer_size=QUEUE)
        stack.callback(request.release)
        requests.append((request, lines))
    return requests


class Lines:
    """The box's answer on GPIO; all lines are low at first. An empty name is a line that is not wired.

    Raises LineError where lines cannot be found, requested or written.
    """

    def __init__(self, config: OutputConfig, gpio: Any, clock: Clock) -> None:
        check_binding(gpio)
        self._panel = config.ready, config.busy, config.fault, config.decided
        self._valid, self._bits = config.result_valid, config.class_bits
        self._settle_ns = config.settle_us * 1000
        self._clock, self._value = clock, gpio.line.Value
        names = [name for name in (*self._panel, self._valid, *self._bits) if name]
        self._levels = dict.fromkeys(names, False)
        self._shown = False, False, False, False
        settings = gpio.LineSettings(direction=gpio.line.Direction.OUTPUT, output_value=self._value.INACTIVE)
        with ExitStack() as stack:
            self._requests = request_lines(gpio, names, settings, stack)
            self._open = stack.pop_all()

    @property
    def capacity(self) -> int:
        """How many codes the class bits can tell apart: 2 to the number of bits."""
        return 1 << len(self._bits)

    def show(self, *, ready: bool, busy: bool, fault: bool, decided: bool = False) -> None:
        """Drive READY, BUSY, FAULT, DECIDED; writes only what has changed. RESULT VALID falls when a sweep begins."""
        if (ready, busy, fault, decided) == self._shown:
            return
        if busy and not self._shown[1]:
            self.result(None)
        self._shown = ready, busy, fault, decided
        self._write(dict(zip(self._panel, self._shown, strict=True)))

    def result(self, code: int | None) -> None:
        """Show a class: RESULT VALID falls, the class bits change, and `settle_us` later RESULT VALID rises.

        None only lets it fall. A code outside 0..capacity-1 does the same and raises LineError.
        """
        self._write({self._valid: False})
        if code is None:
            return
        if not 0 <= code < self.capacity:
            raise LineError(
                f"code {code} does not fit {len(self._bits)} class bits; wire more lines in output.class_bits"
            )
        self._write({name: bool(code >> i & 1) for i, name in enumerate(self._bits)})
        self._clock.sleep_until(self._clock.now_ns() + self._settle_ns)
        self._write({self._valid: True})

    def close(self) -> None:
        """All low, then give the lines back: what a chip does with a line that nobody holds is its own affair."""
        try:
            self._write(dict.fromkeys(self._levels, False))
        finally:
            self._requests = []
            self._open.close()

    def _write(self, wanted: dict[str, bool]) -> None:
        new = {name: level for name, level in wanted.items() if self._levels.get(name, level) != level}
        for request, names in self._requests:
            mine = {offset: name for offset, name in names.items() if name in new}
            if mine:
                with naming("write", mine.values()):
                    request.set_values(
                        {o: self._value.ACTIVE if new[n] else self._value.INACTIVE for o, n in mine.items()}
                    )
                self._levels.update({name: new[name] for name in mine.values()})

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
