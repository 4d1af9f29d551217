"""`palpate skin show`: a skin live, in the terminal and on a page, five times a second."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from palpate.alignment.live import VIEW_NS
from palpate.core.clock import Clock
from palpate.core.types import SweepFormat
from palpate.io.sensor import Sensor
from palpate.tools.skin_monitor import LiveView, SkinDisplay, SkinMonitor


def run(
    sensor: Sensor,
    format: SweepFormat,
    name: str,
    source: str,
    clock: Clock,
    displays: Iterable[SkinDisplay],
    stopped: Callable[[], bool],
    unit: str = "",
) -> None:
    """Show the frames of `sensor` on `displays` until `stopped()`. name, unit: of the skin's
    profile."""
    shown_on, monitor, number = tuple(displays), SkinMonitor(format), 0
    enumerations, next_ns = sensor.counters.enumerations, clock.now_ns()
    while not stopped():
        frames = sensor.read()
        if sensor.counters.enumerations != enumerations:
            enumerations = sensor.counters.enumerations
            monitor.reset()
        monitor.put(frames)
        if (now := clock.now_ns()) >= next_ns:
            next_ns, number = now + VIEW_NS, number + 1
            counters = sensor.counters
            view = LiveView(
                number,
                source,
                f"{name} {format}",
                sensor.state,
                str(sensor.trouble or ""),
                (format.rows, format.cols, format.axes),
                frames=counters.frames,
                lost=counters.lost_frames if sensor.loss_known else None,
                unit=unit,
                **monitor.measured(),
            )
            for display in shown_on:
                display.show(view)
