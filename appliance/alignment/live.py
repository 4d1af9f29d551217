"""Where the skin is touched, for `palpate align`. In: frames of a finger at rest. Out: a View, five times a second, to
displays."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import closing
from typing import Any

import numpy as np
from numpy.typing import NDArray

from appliance.alignment.view import Display, View
from appliance.bundle.bundle import Bundle
from appliance.core.config import SensorConfig
from appliance.core.devices import Devices
from appliance.core.types import Frames, normal
from appliance.io.usb_sensor import UsbSensor
from appliance.signal.contact import IN_PLACE, Point, advice, centre

VIEW_NS = 200_000_000
"""From one View to the next."""
SPAN_S = 0.3
"""How much of the latest signal is averaged: long compared with the vibrations of a pulse or a robot's controller."""
SHOWN = 10
"""The strongest load shown is at first so many times the contact threshold."""


class Alignment:
    """Reads the skin and makes Views of it.

    Of a skin with several axes it looks at the normal one alone. The unloaded value of a taxel is the lowest it has been since the skin was connected: so nobody has to press a key,
    and a finger that lay on the skin at the start is noticed when it is lifted.
    """

    def __init__(self, settings: SensorConfig, model: Bundle, devices: Devices) -> None:
        self._sensor = UsbSensor(settings, model.format, devices.clock, devices.backend)
        self._model, self._source = model, devices.source
        self._shape = model.format.rows, model.format.cols
        self._span = max(1, round(SPAN_S * model.format.rate_hz))
        self._number = 0
        self._reset()

    def _reset(self) -> None:
        """Start anew: this may be another skin than before."""
        self._latest = normal(Frames.empty(self._model.format).taxels, 1)
        self._lowest = np.full(self._shape, np.inf)
        self._full = SHOWN * abs(self._model.manifest.thresholds.contact)
        self._enumerations = self._sensor.counters.enumerations

    def read(self) -> None:
        """Read frames from the skin; waits at most `sensor.timeout_ms`."""
        frames = self._sensor.read()
        if self._sensor.counters.enumerations != self._enumerations:
            self._reset()
        self._latest = np.concatenate([self._latest, normal(frames.taxels, 1)])[-self._span :]

    def close(self) -> None:
        """Release the skin."""
        self._sensor.close()

    def view(self) -> View:
        """The View of this moment."""
        self._number += 1
        if self._sensor.state != "streaming":
            return self._view("no-skin", f"no skin: {self._sensor.state}", str(self._sensor.trouble or ""))
        if len(self._latest) < self._span:
            return self._view("wait", "reading the unloaded skin", "keep the finger off")
        self._lowest = np.fmin(self._lowest, self._latest.mean(axis=0, dtype=np.float64))
        load = self._latest.mean(axis=0, dtype=np.float64) - self._lowest
        load = np.where(np.isfinite(load), load, 0)  # a taxel of a floating-point skin may give NaN
        self._full = max(self._full, float(load.max()))
        return self._touched(load, centre(self._latest, self._lowest, self._model.manifest.thresholds.contact))

    def _touched(self, load: NDArray[np.float64], found: Point | None) -> View:
        """The View of a streaming skin with this load [R, C], raw counts, and centre of contact (None: no contact)."""
        place = self._model.manifest.place
        shown: dict[str, Any] = {"load": tuple(map(tuple, load.round(1).tolist())), "full": self._full}
        least = self._lowest[np.isfinite(self._lowest)].max(initial=-np.inf)
        if least >= self._model.manifest.thresholds.contact:
            hint = f"a taxel has not read less than {least:.0f} raw counts yet: something lies on the skin"
            return self._view("lift", "lift the finger off the skin once", hint, **shown)
        if found is None:
            return self._view("no-contact", "nothing touches the skin", "rest the finger on the tube", **shown)
        if place is None:
            hint = "this bundle does not say where the skin sat in training; export it again"
            return self._view("no-positions", "the contact's centre alone", hint, **shown, centre=found)
        offset = place.offset(found)
        at = found[0] * place.pitch_mm, found[1] * place.pitch_mm
        shown |= {"centre": at, "nearest": (at[0] - offset[0], at[1] - offset[1])}
        if place.within(offset):
            away = f"{np.hypot(*offset):.1f} mm from the nearest trained position"
            return self._view("in-place", IN_PLACE, f"{away}; up to {place.limit_mm:.1f} mm is fine", **shown)
        hint = "move the skin on the finger as far the same way, then look again"
        return self._view("off", advice(offset, self._shape), hint, **shown)

    def _view(self, state: str, message: str, hint: str, **shown: Any) -> View:
        m = self._model.manifest
        bundle = f"{m.name} {m.version}, {self._model.id}"
        return View(self._number, self._source, bundle, self._sensor.state, state, message, hint, self._shape,
                    place=m.place, **shown)  # fmt: skip


def run(
    settings: SensorConfig, model: Bundle, devices: Devices, displays: Iterable[Display], stopped: Callable[[], bool]
) -> None:
    """Show on `displays` where the skin is touched, until `stopped()`. A slow display makes frames late, which does no
    harm."""
    shown_on = tuple(displays)
    with closing(Alignment(settings, model, devices)) as alignment:
        next_ns = devices.clock.now_ns()
        while not stopped():
            alignment.read()
            if (now := devices.clock.now_ns()) >= next_ns:
                next_ns = now + VIEW_NS
                view = alignment.view()
                for display in shown_on:
                    display.show(view)
