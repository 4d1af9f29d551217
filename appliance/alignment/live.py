"""The room of placing the skin: frames of the finger at rest in, a View of where it is touched out, five times a second.

`palpate align` runs it. A View goes to the terminal (place_screen) and, where asked for, to a page (place_web).
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from typing import Any, TextIO

import numpy as np
from numpy.typing import NDArray

from appliance.bundle.bundle import Bundle
from appliance.core.config import SensorConfig
from appliance.core.devices import Devices
from appliance.core.types import Frames
from appliance.io.usb_sensor import UsbSensor
from appliance.signal.contact import IN_PLACE, ContactPositions, Point, advice, centre

LOOK_NS = 200_000_000
"""From one View to the next."""
SPAN_S = 0.3
"""So much of the latest signal is looked at: long against what a pulse or a robot's controller shakes."""
SHOWN = 10
"""Thresholds of contact that are shown as full load, until there is more."""


@dataclass(frozen=True, slots=True)
class View:
    """What there is to see at one moment.

    turn: counts Views. source: as sentences name it ("usb", "sim"). skin: its state (PROTOCOL.md).
    state: "no-skin", "wait", "lift", "no-contact", "no-positions", "off" or "in-place". said: that in words. todo: what
    the person may do. load: digits above the unloaded skin, a list a row; empty before there are any. full: load
    that is shown as the strongest. centre: of the contact, and nearest: the trained position nearest to it, mm
    from the centre of taxel 1.1 (taxels where there is no `place`).
    """

    turn: int
    source: str
    bundle: str
    skin: str
    state: str
    said: str
    todo: str
    shape: tuple[int, int]
    load: tuple[tuple[float, ...], ...] = ()
    full: float = 1.0
    centre: Point | None = None
    nearest: Point | None = None
    place: ContactPositions | None = None

    def json(self) -> dict[str, Any]:
        """The View as a page reads it."""
        return asdict(self)


class Placing:
    """Looks at the skin. The unloaded skin is the lowest that each taxel has been since the skin came: so nobody has to
    press a key for it, and a finger that lay on the skin at the start is noticed when it is lifted."""

    def __init__(self, settings: SensorConfig, model: Bundle, world: Devices) -> None:
        self._sensor = UsbSensor(settings, model.format, world.clock, world.backend)
        self._model, self._source = model, world.source
        self._shape = model.format.rows, model.format.cols
        self._span = max(1, round(SPAN_S * model.format.rate_hz))
        self._turn = 0
        self._forget()

    def _forget(self) -> None:
        """Another skin may come: nothing of the last one counts."""
        self._latest = Frames.empty(self._model.format).taxels
        self._lowest = np.full(self._shape, np.inf)
        self._full = SHOWN * abs(self._model.manifest.thresholds.contact)
        self._enumerations = self._sensor.tally.enumerations

    def read(self) -> None:
        """Take what the skin sends; waits at most `sensor.timeout_ms`."""
        frames = self._sensor.read()
        if self._sensor.tally.enumerations != self._enumerations:
            self._forget()
        self._latest = np.concatenate([self._latest, frames.taxels])[-self._span :]

    def close(self) -> None:
        """Let the skin go."""
        self._sensor.close()

    def view(self) -> View:
        """What there is to see now."""
        self._turn += 1
        if self._sensor.state != "streaming":
            return self._view("no-skin", f"no skin: {self._sensor.state}", str(self._sensor.trouble or ""))
        if len(self._latest) < self._span:
            return self._view("wait", "reading the unloaded skin", "keep the finger off")
        self._lowest = np.fmin(self._lowest, self._latest.mean(axis=0, dtype=np.float64))
        load = self._latest.mean(axis=0, dtype=np.float64) - self._lowest
        load = np.where(np.isfinite(load), load, 0)  # a taxel of a floating-point skin may give no number
        self._full = max(self._full, float(load.max()))
        return self._judged(load, centre(self._latest, self._lowest, self._model.manifest.thresholds.contact))

    def _judged(self, load: NDArray[np.float64], found: Point | None) -> View:
        """The View of a skin that streams, with this load [R, C] and contact."""
        place = self._model.manifest.place
        shown: dict[str, Any] = {"load": tuple(map(tuple, load.round(1).tolist())), "full": self._full}
        least = self._lowest[np.isfinite(self._lowest)].max(initial=-np.inf)
        if least >= self._model.manifest.thresholds.contact:
            todo = f"a taxel has not read less than {least:.0f} digits yet: something lies on the skin"
            return self._view("lift", "lift the finger off the skin once", todo, **shown)
        if found is None:
            return self._view("no-contact", "nothing touches the skin", "rest the finger on the tube", **shown)
        if place is None:
            todo = "this bundle does not say where the skin sat in training; export it again"
            return self._view("no-positions", "the contact's centre alone", todo, **shown, centre=found)
        offset = place.offset(found)
        at = found[0] * place.pitch_mm, found[1] * place.pitch_mm
        shown |= {"centre": at, "nearest": (at[0] - offset[0], at[1] - offset[1])}
        if place.within(offset):
            away = f"{np.hypot(*offset):.1f} mm from the nearest trained position"
            return self._view("in-place", IN_PLACE, f"{away}; up to {place.limit_mm:.1f} mm is fine", **shown)
        todo = "move the skin on the finger as far the same way, then look again"
        return self._view("off", advice(offset, self._shape), todo, **shown)

    def _view(self, state: str, said: str, todo: str, **shown: Any) -> View:
        m = self._model.manifest
        bundle = f"{m.name} {m.version}, {self._model.id}"
        return View(self._turn, self._source, bundle, self._sensor.state, state, said, todo, self._shape,
                    place=m.place, **shown)  # fmt: skip


def run(
    settings: SensorConfig, model: Bundle, world: Devices, out: TextIO, stopped: Callable[[], bool],
    port: int | None = None,
) -> None:  # fmt: skip
    """Show on `out`, and on a page at `port` where one is given, how the skin is placed, until `stopped()`.

    Raises ConfigError where the port cannot be used. A terminal that is slow makes frames late, which does no harm here.
    """
    from appliance.alignment.terminal import Screen
    from appliance.alignment.web import Page

    with ExitStack() as stack:
        placing = Placing(settings, model, world)
        stack.callback(placing.close)
        page = stack.enter_context(Page(port, world.clock)) if port is not None else None
        screen = stack.enter_context(Screen(out, page.address if page else ""))
        next_ns = world.clock.now_ns()
        while not stopped():
            placing.read()
            if (now := world.clock.now_ns()) >= next_ns:
                next_ns = now + LOOK_NS
                view = placing.view()
                screen.show(view, now)
                if page:
                    page.show(view)
