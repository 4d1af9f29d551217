"""Shows a skin on displays, five times a second, as a page or a line a second, and makes the views
of `palpate skin align`."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any, Generic, Protocol, TextIO, TypeVar

import numpy as np
from numpy.typing import NDArray

from palpate.answer.contact import IN_PLACE, ContactPositions, Point, advice, centre
from palpate.answer.unloaded import UnloadedTracker
from palpate.bundle.bundle import Bundle
from palpate.core.clock import Clock
from palpate.core.schema import typed
from palpate.core.types import Frames, SweepFormat, normal
from palpate.io.sensor import Sensor

Shown = TypeVar("Shown")
Seen = TypeVar("Seen", covariant=True)
Given = TypeVar("Given", contravariant=True)
VIEW_NS, LINE_NS = 200_000_000, 1_000_000_000
"""Time between two Views, and between two lines."""
SPAN_S = 0.3
"""Length of the latest signal that is averaged. It is long compared with the vibrations of a pulse
or a robot's controller."""
NO_BUNDLE = "none for this skin"
SHOWN = 10
"""Initial value of the strongest load shown, in multiples of the contact threshold."""


@dataclass(frozen=True, slots=True)
class View:
    """The contact on the skin at one moment, and advice for the person.

    number: counts Views from 1.
    source: as in sentences ("usb", "sim").
    skin: its state (PROTOCOL.md).
    state: "no-skin", "wait", "lift", "no-contact", "no-positions", "off" or "in-place".
    message: the state in words.
    hint: advice for the person.
    load: raw counts above the unloaded skin, [rows][columns]; empty before the first frames.
    full: load that is shown as the strongest.
    centre: centre of the contact, mm from the centre of taxel 1.1 (in taxels without `contact`).
    nearest: the nearest trained position, in the same unit.
    contact: contact positions in training, None if unknown.
    fingertip: setting `skin.fingertip`.
    load_unit: unit of the load, "" for raw counts.
    """

    number: int
    source: str
    bundle: str
    skin: str
    state: str
    message: str
    hint: str
    shape: tuple[int, int]
    load: tuple[tuple[float, ...], ...] = ()
    full: float = 1.0
    centre: Point | None = None
    nearest: Point | None = None
    contact: ContactPositions | None = None
    fingertip: str = ""
    load_unit: str = ""

    @property
    def origin(self) -> str:
        """A note that the skin is simulated or replayed, "" for a real skin."""
        return {"usb": "", "replay": "REPLAYED"}.get(self.source, "SIMULATED")

    @property
    def unit(self) -> str:
        """Unit of centre and nearest."""
        return "mm" if self.contact else "taxels"

    def json(self) -> dict[str, Any]:
        """The View as the page reads it."""
        return asdict(self)


class Display(Protocol[Given]):
    """Shows one view after another."""

    def show(self, view: Given) -> None:
        """Show `view` instead of the view before."""


class LinePrinter(Generic[Shown]):
    """Prints what it is shown on `out`, at most once a second. line: makes the line."""

    def __init__(self, out: TextIO, clock: Clock, line: Callable[[Shown], str]) -> None:
        self._out, self._clock, self._line = out, clock, line
        self._next_ns = 0

    def show(self, view: Shown) -> None:
        """Print `view`, unless a line was printed within the last second."""
        if (now_ns := self._clock.now_ns()) >= self._next_ns:
            self._next_ns = now_ns + LINE_NS
            print(self._line(view), file=self._out, flush=True)


def line(view: View) -> str:
    """A View in one line that begins with the message."""
    at = ""
    if view.centre is not None:
        at = f"  centre row {view.centre[0]:.1f} column {view.centre[1]:.1f} {view.unit}"
    return f"{view.origin and f'{view.origin}  '}{view.message}{at}  ({view.hint})"


@dataclass(frozen=True, slots=True, eq=False)
class Expected:
    """The skin as the bundle describes it.

    bundle: name, version and id of a bundle with the skin's format, or NO_BUNDLE. threshold: of
    contact, raw counts. contact: contact positions in training. Both are None without a bundle,
    and where the bundle does not have them. unloaded: raw counts [R, C] of the unloaded skin along
    the normal; 0 without a bundle. fingertip: setting `skin.fingertip`. unit: of the counts, as in
    the skin's profile.
    """

    format: SweepFormat
    bundle: str = NO_BUNDLE
    threshold: float | None = None
    contact: ContactPositions | None = None
    unloaded: NDArray[np.float64] | float = 0.0
    fingertip: str = ""
    unit: str = ""

    @classmethod
    def by(cls, model: Bundle, fingertip: str = "", unit: str = "") -> Expected:
        """The skin as `model` describes it. fingertip: setting `skin.fingertip`. unit: of its
        profile."""
        m = model.manifest
        named = f"{m.name} {m.version}, {model.id}"
        return cls(
            m.format, named, m.thresholds.contact, m.contact, normal(m.tare, 0), fingertip, unit
        )

    def json(self) -> dict[str, Any]:
        """All but format and bundle, under the keys of the feed (PROTOCOL.md, section 4)."""
        contact = asdict(self.contact) if self.contact else None
        unloaded = np.asarray(self.unloaded).tolist()
        return {
            "contact": self.threshold,
            "place": contact,
            "unloaded": unloaded,
            "fingertip": self.fingertip,
            **({"unit": self.unit} if self.unit else {}),
        }

    @classmethod
    def read(cls, format: SweepFormat, known: Mapping[str, Any], bundle: str) -> Expected:
        """The inverse of `json`; an empty `known` means no bundle. Raises KeyError, TypeError,
        ValueError or BundleError."""
        if not known:
            return cls(format, bundle or NO_BUNDLE)
        contact = typed(ContactPositions, known["place"]) if known["place"] else None
        unloaded = np.array(known["unloaded"], np.float64)
        if unloaded.shape not in ((), (format.rows, format.cols)):
            raise ValueError(f"unloaded counts of {unloaded.shape}")
        return cls(
            format,
            bundle or NO_BUNDLE,
            known["contact"],
            contact,
            unloaded,
            str(known["fingertip"]),
            str(known.get("unit", "")),
        )


class ContactTracker:
    """Makes Views of the frames of a skin.

    For a skin with several axes it uses the normal axis alone. The unloaded value of a taxel is its
    lowest value since the skin was connected, so nobody has to press a key. A bundle's contact
    threshold is above the counts of an unloaded skin. With it, a finger that touched the skin from
    the start is noticed, and the person is asked to lift it.
    """

    def __init__(self, expected: Expected, source: str) -> None:
        self._expected, self._source = expected, source
        self._shape = expected.format.rows, expected.format.cols
        self._span = max(1, round(SPAN_S * expected.format.rate_hz))
        self._number = 0
        self._unloaded = UnloadedTracker(expected.format)
        self.reset()

    def reset(self) -> None:
        """Start anew, as for another skin."""
        self._latest = normal(Frames.empty(self._expected.format).taxels, 1)
        self._lowest = np.full(self._shape, np.inf)
        self._full = SHOWN * abs(self._expected.threshold or 0.1)
        self._unloaded.restart()

    def put(self, taxels: NDArray[Any]) -> None:
        """Add the newest frames, raw counts [n, R, C] or [n, R, C, A]."""
        self._latest = np.concatenate([self._latest, normal(taxels, 1)])[-self._span :]
        if self._expected.threshold is None:
            self._unloaded.put(taxels)

    def take(self, frames: Frames) -> None:
        """Add frames of a sensor."""
        self.put(frames.taxels)

    def look(self, sensor: Sensor) -> View:
        """The present View of a sensor."""
        return self.view(sensor.state, str(sensor.trouble or ""))

    def view(self, skin: str, trouble: str) -> View:
        """The present View. skin: its state (PROTOCOL.md). trouble: why it does not stream."""
        self._number, self._skin = self._number + 1, skin
        if skin != "streaming":
            return self._view("no-skin", f"no skin: {skin}", trouble)
        threshold = self._expected.threshold
        if threshold is None and self._unloaded.skin:
            threshold = self._unloaded.skin.contact
        if len(self._latest) < self._span or threshold is None:
            return self._view("wait", "reading the unloaded skin", "keep the finger off")
        self._lowest = np.fmin(self._lowest, self._latest.mean(axis=0, dtype=np.float64))
        load = self._latest.mean(axis=0, dtype=np.float64) - self._lowest
        load = np.where(np.isfinite(load), load, 0)  # a taxel of a floating-point skin may give NaN
        self._full = max(self._full, float(load.max()))
        return self._touched(load, centre(self._latest, self._lowest, threshold))

    def _untrained(self) -> str:
        """The reason for a missing trained position, for a person."""
        if self._expected.bundle == NO_BUNDLE:
            return (
                "no bundle fits this skin, so there is no trained position; palpate record "
                "needs no bundle"
            )
        if self._expected.threshold is None:
            return (
                "this bundle cannot detect contact, so it has no trained position; train a "
                "bundle on sweeps of palpate record"
            )
        return "this bundle does not say where the skin sat in training; export it again"

    def _touched(self, load: NDArray[np.float64], found: Point | None) -> View:
        """The View of a streaming skin with this load [R, C], raw counts, and centre of contact
        (None: no contact)."""
        trained = self._expected.contact
        shown: dict[str, Any] = {
            "load": tuple(map(tuple, load.round(2).tolist())),
            "full": self._full,
        }
        lowest = self._lowest - self._expected.unloaded
        least = lowest[np.isfinite(lowest)].max(initial=-np.inf)
        if self._expected.threshold is not None and least >= self._expected.threshold:
            above = " above the unloaded skin" if np.any(self._expected.unloaded) else ""
            unit = self._expected.unit or "raw counts"
            read = f"{least:.3g} {unit}{above}"
            hint = f"a taxel has not read less than {read} yet: something lies on the skin"
            return self._view("lift", "lift the finger off the skin once", hint, **shown)
        if found is None:
            return self._view(
                "no-contact", "nothing touches the skin", "rest the finger on the tube", **shown
            )
        if trained is None:
            title, hint = "the contact's centre alone", self._untrained()
            return self._view("no-positions", title, hint, **shown, centre=found)
        offset = trained.offset(found)
        at = found[0] * trained.pitch_mm, found[1] * trained.pitch_mm
        shown |= {"centre": at, "nearest": (at[0] - offset[0], at[1] - offset[1])}
        if trained.within(offset):
            away = f"{np.hypot(*offset):.1f} mm from the nearest trained position"
            return self._view(
                "in-place", IN_PLACE, f"{away}; up to {trained.limit_mm:.1f} mm is fine", **shown
            )
        hint = "move the skin on the finger as far that way, then look again"
        return self._view("off", advice(offset, self._shape), hint, **shown)

    def _view(self, state: str, message: str, hint: str, **shown: Any) -> View:
        known = self._expected
        return View(
            self._number,
            self._source,
            known.bundle,
            self._skin,
            state,
            message,
            hint,
            self._shape,
            contact=known.contact,
            fingertip=known.fingertip,
            load_unit=known.unit,
            **shown,
        )


class Watched(Protocol[Seen]):
    """Makes views of the frames of a sensor."""

    def reset(self) -> None:
        """Start anew, as for another skin."""

    def take(self, frames: Frames) -> None:
        """Add frames."""

    def look(self, sensor: Sensor) -> Seen:
        """The present view."""


def run(
    sensor: Sensor,
    watched: Watched[Shown],
    displays: Iterable[Display[Shown]],
    clock: Clock,
    stopped: Callable[[], bool],
) -> None:
    """Show views of a sensor on `displays` until `stopped()`. A slow display delays frames, which
    does no harm."""
    shown_on = tuple(displays)
    enumerations, next_ns = sensor.counters.enumerations, clock.now_ns()
    while not stopped():
        frames = sensor.read()
        if sensor.counters.enumerations != enumerations:
            enumerations = sensor.counters.enumerations
            watched.reset()
        watched.take(frames)
        if (now := clock.now_ns()) >= next_ns:
            next_ns, view = now + VIEW_NS, watched.look(sensor)
            for display in shown_on:
                display.show(view)
