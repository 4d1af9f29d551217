"""The skins of several fingers as one sensor."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.core.errors import SensorError
from palpate.core.fingers import cut
from palpate.core.types import Frames
from palpate.io import packets
from palpate.io.sensor import SensorCounters
from palpate.io.usb_sensor import LinkSensor

TIMEOUT_MS = 20
"""A read of one skin waits this long, while frames of the others wait in their boards."""


@dataclass(frozen=True, slots=True)
class HandSkin:
    """A skin, or a hub. fingers: the finger it belongs to; of a hub each finger, in the order of
    their parts. axis: of a frame, along which the parts lie. part: the only part that is used, for
    a hub with one finger; "" for all."""

    sensor: LinkSensor
    fingers: tuple[str, ...]
    axis: int = 0
    part: str = ""

    def split(self, frames: Frames) -> list[Frames]:
        """The frames of each finger."""
        parts: list[NDArray[Any]] = [frames.taxels]
        if len(self.fingers) > 1:
            parts = np.split(frames.taxels, len(self.fingers), axis=1 + self.axis)
        elif self.part:
            index, n, axis = cut(self.part)
            parts = [np.split(frames.taxels, n, axis=1 + axis)[index]]
        return [
            Frames(frames.t_ns, frames.seq, part, finger)
            for finger, part in zip(self.fingers, parts, strict=True)
        ]


class HandSensor:
    """Each `read` reads one skin, in turn, and gives the frames of one finger.

    It streams as long as one skin does; `trouble` then names the others. A skin that is away is not
    waited for while another streams.
    """

    def __init__(self, skins: Sequence[HandSkin]) -> None:
        self._skins = skins
        self._turns = cycle(skins)
        self._waiting: deque[Frames] = deque()  # of the other fingers of a hub
        self._of: Mapping[str, LinkSensor] = {f: s.sensor for s in skins for f in s.fingers}

    def streams(self, finger: str) -> bool:
        """Whether the finger's skin streams."""
        return self._of[finger].state == "streaming"

    @property
    def away(self) -> str:
        """The fingers whose skins do not stream, with their states: "left absent"; "" for none."""
        states = {finger: sensor.state for finger, sensor in self._of.items()}
        return ", ".join(f"{f} {state}" for f, state in states.items() if state != "streaming")

    @property
    def state(self) -> str:
        """As of the first finger that streams, or of the first finger."""
        states = [skin.sensor.state for skin in self._skins]
        return "streaming" if "streaming" in states else states[0]

    @property
    def trouble(self) -> SensorError | None:
        """The troubles of all fingers, with their names."""
        found = [
            f"{finger}: {sensor.trouble}" if finger else str(sensor.trouble)
            for finger, sensor in self._of.items()
            if sensor.trouble
        ]
        return SensorError("; ".join(found)) if found else None

    @property
    def identity(self) -> packets.Identity | None:
        """The boards that were asked, as one: names and serial numbers side by side."""
        found = [skin.sensor.identity for skin in self._skins if skin.sensor.identity]
        if not found:
            return None
        boards, serials = (
            "+".join(dict.fromkeys(getattr(who, name) for who in found if getattr(who, name)))
            for name in ("board", "serial")
        )
        return packets.Identity(found[0].protocol, found[0].firmware, boards, serials)

    @property
    def clock(self) -> dict[str, float] | None:
        """Accuracy of the times of the first skin that has frames."""
        return next((c for skin in self._skins if (c := skin.sensor.clock)), None)

    @property
    def loss_known(self) -> bool:
        """Whether every lost frame of every skin is seen."""
        return all(skin.sensor.loss_known for skin in self._skins)

    @property
    def counters(self) -> SensorCounters:
        """Sums over the skins."""
        names = SensorCounters.__slots__
        each = [skin.sensor.counters for skin in self._skins]
        return SensorCounters(**{name: sum(getattr(c, name) for c in each) for name in names})

    def read(self) -> Frames:
        """The frames of one finger since its last turn."""
        if self._waiting:
            return self._waiting.popleft()
        skin = next(self._turns)
        skin.sensor.waits = self.state != "streaming"
        frames = skin.sensor.read()
        first, *others = skin.split(frames)
        if len(frames):
            self._waiting.extend(others)
        return first

    def close(self) -> None:
        """Release all skins."""
        for skin in self._skins:
            skin.sensor.close()
