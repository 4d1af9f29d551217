"""Cuts the windows of a sweep from the frames of several fingers."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.core.config import SweepConfig
from palpate.core.types import Frames, Status, Sweep, SweepFormat
from palpate.sweeps.frame_ring import FrameRing
from palpate.sweeps.sweep_window import OpenSweep, SweepCutter, cut, ring_s


class HandCutter(SweepCutter):
    """One trigger for all fingers, and a window of each. A sweep of the hand has no frames of its
    own; `Sweep.fingers` has a sweep of each finger, in the order of `formats`.

    A finger whose skin is away gets `sensor-lost`; the sweep goes on with the others. formats: by
    finger. streams: whether the finger's skin streams now.
    """

    def __init__(
        self,
        formats: Mapping[str, SweepFormat],
        config: SweepConfig,
        streams: Mapping[str, Callable[[], bool]],
    ) -> None:
        self._formats, self._streams = formats, streams
        self._rings = {finger: FrameRing(f, ring_s(config)) for finger, f in formats.items()}
        longest = max(formats.values(), key=lambda f: f.window * f.period_ns)
        super().__init__(longest, config, next(iter(self._rings.values())))
        self._lost_ns = dict.fromkeys(formats, -1)  # when each skin was last away

    def put(self, frames: Frames, now_ns: int) -> None:
        """Put the frames of one finger into its ring."""
        for finger, streams in self._streams.items():
            if not streams():
                self._lost_ns[finger] = now_ns
        if not len(frames):
            return
        ring = self._rings[frames.finger]
        if ring.restarted(frames):
            self._lost_ns[frames.finger] = now_ns
        ring.put(frames)

    def latest(self, n: int) -> NDArray[Any] | None:
        """The newest `n` frames of all fingers side by side [n, counts of all fingers], for a tare;
        None if frames are missing, or a skin is away."""
        frames = [ring.latest(n) for ring in self._rings.values()]
        found = [f.reshape(n, -1) for f in frames if f is not None]
        there = len(found) == len(frames) and all(streams() for streams in self._streams.values())
        return np.concatenate(found, axis=1) if there else None

    def _cut(self, sweep: OpenSweep, stop_ns: int, now_ns: int) -> Sweep | None:
        fingers: list[Sweep] = []
        for finger, format in self._formats.items():
            if self._lost_ns[finger] >= sweep.start_ns:
                none = Frames.empty(format)
                own: Sweep | None = sweep.sweep(stop_ns, Status.SENSOR_LOST, none, (), now_ns)
            else:
                own = cut(self._rings[finger], format, sweep, stop_ns, now_ns, self._late_ns)
            if own is None:
                return None
            fingers.append(replace(own, finger=finger))
        any_ok = any(own.status is Status.OK for own in fingers)
        status = Status.OK if any_ok else fingers[0].status
        return self._hand(sweep, stop_ns, status, now_ns, fingers)

    def _empty(self, sweep: OpenSweep, stop_ns: int, status: Status, now_ns: int) -> Sweep:
        fingers = [
            replace(sweep.sweep(stop_ns, status, Frames.empty(format), (), now_ns), finger=finger)
            for finger, format in self._formats.items()
        ]
        return self._hand(sweep, stop_ns, status, now_ns, fingers)

    def _hand(
        self, sweep: OpenSweep, stop_ns: int, status: Status, now_ns: int, fingers: list[Sweep]
    ) -> Sweep:
        whole = sweep.sweep(stop_ns, status, Frames.empty(self._format), (), now_ns)
        return replace(whole, lost=sum(own.lost for own in fingers), fingers=tuple(fingers))
