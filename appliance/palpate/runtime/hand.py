"""Assembles the parts of a box with several fingers: one sensor, one cutter, one answerer, each for
all of them, so that the loop is that of a box with one skin."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial

from palpate.bundle.bundle import Bundle
from palpate.core import fingers
from palpate.core.clock import Clock
from palpate.core.config import ClassifierConfig, Config, FingerConfig
from palpate.core.devices import Devices
from palpate.core.errors import ConfigError
from palpate.core.types import SweepFormat
from palpate.inference.classifier import Classifier
from palpate.inference.hand_classifier import HandClassifier
from palpate.inference.objects import ObjectRule
from palpate.io import skins
from palpate.io.hand_sensor import TIMEOUT_MS, HandSensor, HandSkin
from palpate.sweeps.hand_window import HandCutter


@dataclass(frozen=True, slots=True)
class HandParts:
    """The parts of the loop for all fingers."""

    sensor: HandSensor
    cutter: HandCutter
    answerer: HandClassifier


def classifier(
    settings: Config, bundles: Mapping[str, Bundle], clock: Clock, away: Callable[[], str] = str
) -> HandClassifier:
    """The classifier of all fingers. bundles: by finger. away: as in HandClassifier. Raises
    ConfigError, BundleError."""
    if settings.classifier.early:
        fingers.refuse(settings.skins, "classifier.early")
    own = {
        finger: Classifier(bundle, clock, "none", settings.classifier.min_probability)
        for finger, bundle in bundles.items()
    }
    rule: ClassifierConfig = settings.classifier
    ends = ObjectRule(rule.max_sweeps, rule.conflict, rule.object_s)
    return HandClassifier(own, clock, away, rule.fuse, ends)


def assembled(settings: Config, bundles: Mapping[str, Bundle], devices: Devices) -> HandParts:
    """The parts for the fingers of the settings. Raises ConfigError, BundleError."""
    formats = {finger: bundles[finger].format for finger in settings.skins}
    sensor = HandSensor([_skin(settings, group, formats, devices) for group in groups(settings)])
    streams = {finger: partial(sensor.streams, finger) for finger in formats}
    answerer = classifier(settings, bundles, devices.clock, lambda: sensor.away)
    return HandParts(sensor, HandCutter(formats, settings.sweep, streams), answerer)


def groups(settings: Config) -> list[tuple[str, ...]]:
    """Fingers by skin: those of one hub together, in the order of their parts."""
    found: dict[FingerConfig | str, list[str]] = {}
    for finger, own in settings.skins.items():
        hub = replace(own, part="hub", bundle="", fingertip="")
        found.setdefault(hub if own.part else finger, []).append(finger)
    return [tuple(sorted(group, key=lambda f: settings.skins[f].part)) for group in found.values()]


def _skin(
    settings: Config, group: tuple[str, ...], formats: Mapping[str, SweepFormat], devices: Devices
) -> HandSkin:
    """The skin of a finger, or the hub of several. Raises ConfigError."""
    format, axis = whole(settings, group, formats)
    there = devices.finger(group[0])
    own = there.wire(settings.finger(group[0]))
    own = replace(own, skin=replace(own.skin, timeout_ms=TIMEOUT_MS))
    return HandSkin(skins.sensor(own, format, there), group, axis)


def whole(
    settings: Config, group: tuple[str, ...], formats: Mapping[str, SweepFormat]
) -> tuple[SweepFormat, int]:
    """Format of the frames of a finger's skin, or of the hub of several, and the axis along which
    its parts lie. Raises ConfigError if the parts are not one whole of equal forms."""
    if not settings.skins[group[0]].part:
        return formats[group[0]], 0
    names = ", ".join(f"skins.{finger}" for finger in group)
    parts = [fingers.cut(settings.skins[finger].part) for finger in group]
    n, axis = len(group), parts[0][2]
    if parts != [(i, n, axis) for i in range(n)]:
        given = ", ".join(f'"{settings.skins[finger].part}"' for finger in group)
        raise ConfigError(
            f'the parts of {names} are {given}, not one whole; give them "1/{n} rows" and so on, '
            "all of rows or all of columns"
        )
    own = formats[group[0]]
    if len({formats[finger].skin for finger in group}) > 1:
        raise ConfigError(
            f"{names} are parts of one hub, but their bundles are for different skins"
        )
    return skins.hub_format(own, settings.skins[group[0]].part), axis
