"""A box with several fingers on simulated devices."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace

import numpy as np

from palpate.bundle import bundle
from palpate.bundle.bundle import Bundle
from palpate.core.config import Config
from palpate.core.observer import Observer
from palpate.core.types import Sweep, SweepFormat
from palpate.io.robot_link import SerialSink
from palpate.runtime import assembly
from palpate.sim import devices, rig, script, skin
from palpate.tools import pseudo_terminal
from tests.factories.settings import load
from tests.factories.simulated_box import OnSweep, Rigged

TWO = ("left", "right")


def of(*fingers: str) -> list[str]:
    """Settings of a hand with these fingers, each with a board of its own."""
    return [f"skins.{finger}.usb=1209:7ac7:{finger}" for finger in fingers]


def acts(seed: int, sweeps: int, fingers: int = 2, only: str = "") -> list[rig.Act]:
    """Sweeps over tubes that all fingers touch."""
    return [*script.tubes(seed, sweeps, only=only, fingers=fingers)]


def lifted(act: rig.Act, finger: int) -> rig.Act:
    """The same act, in which this finger does not touch."""
    each = [act.frames, *act.others]
    each[finger] = np.repeat(each[finger][:1], len(act.frames), axis=0)
    return replace(act, frames=each[0], others=tuple(each[1:]))


def build(
    stack: ExitStack,
    played: Iterable[rig.Act],
    fingers: Sequence[str] = TWO,
    sets: Sequence[str] = (),
    formats: Mapping[str, SweepFormat] | None = None,
    settings: Config | None = None,
    model: Bundle | None = None,
    bundles: Mapping[str, Bundle] | None = None,
    observers: Sequence[Observer] = (),
) -> Rigged:
    """The box, with the packaged bundle. formats: of each board's frames."""
    model = model or bundle.load(bundle.DEFAULT)
    settings = settings or load([*of(*fingers), *sets])
    formats = formats or dict.fromkeys(fingers, skin.FORMAT)
    simulated = devices.build(skin.FORMAT, played, rig.VirtualClock(), "sim", fingers=formats)
    far_end, name = stack.enter_context(pseudo_terminal.pair())
    port = SerialSink(replace(settings.serial, port=name), simulated.clock, simulated.source)
    kept: list[Sweep] = []
    box = assembly.box(
        settings,
        model,
        simulated,
        port,
        stack,
        bundles=bundles or dict.fromkeys(settings.skins, model),
        observers=[OnSweep(lambda sweep, verdict: kept.append(sweep)), *observers],
    )
    return Rigged(box, simulated, far_end, port, kept=kept)


def idle(settings: Config) -> devices.SimDevices:
    """Devices of the fingers of these settings, on which nothing happens."""
    formats = dict.fromkeys(settings.skins, skin.FORMAT)
    return devices.build(skin.FORMAT, [], rig.VirtualClock(), "sim", fingers=formats)
