"""Fixtures that several test files share: the default bundle, boxes on simulated devices.

Numerical libraries use one thread in tests. Their models are small: with two threads a fit took 2.5
times the processor time, and four times as long beside another test.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before numpy and PyTorch are imported
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from typing import Any

import pytest

from palpate.bundle import bundle
from palpate.core.types import Sweep
from palpate.io.robot_link import SerialSink
from palpate.runtime import assembly
from palpate.sim import devices, rig, script, skin
from palpate.tools import pseudo_terminal
from tests.factories import browser as browsers
from tests.factories import log_lines
from tests.factories.settings import load as load_settings
from tests.factories.simulated_box import OnSweep, Rigged


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """A browser, for the tests of pages. Not for the whole session: while it is open, asyncio.run
    of another test would fail."""
    with browsers.launched() as one:
        yield one


@pytest.fixture(scope="session")
def default_bundle() -> bundle.Bundle:
    """The bundle that the box comes with."""
    return bundle.load(bundle.DEFAULT)


@pytest.fixture
def rigged(default_bundle: bundle.Bundle) -> Iterator[Callable[..., Rigged]]:
    """Builds boxes on simulated devices; closes them after the test."""
    with ExitStack() as stack:

        def make(
            simulated: devices.SimDevices | None = None,
            sets: tuple[str, ...] = (),
            model=default_bundle,
            observers=(),
            commands=None,
            capture=None,
        ) -> Rigged:
            simulated = simulated or devices.build(
                skin.FORMAT, script.tubes(1), rig.VirtualClock(), "sim"
            )
            settings = load_settings(sets)
            far_end, name = stack.enter_context(pseudo_terminal.pair())
            port = SerialSink(
                replace(settings.serial, port=name), simulated.clock, simulated.source
            )
            kept: list[Sweep] = []
            watching = [OnSweep(lambda sweep, verdict: kept.append(sweep)), *observers]
            if commands is None:
                box = assembly.box(
                    settings, model, simulated, port, stack, observers=watching, capture=capture
                )
            else:  # a box that records
                box = assembly.recorder(
                    settings,
                    simulated.format,
                    simulated,
                    port,
                    stack,
                    observers=watching,
                    commands=commands,
                )
            return Rigged(box, simulated, far_end, port, kept=kept)

        yield make


@pytest.fixture
def logged() -> Iterator[list[str]]:
    """The lines that the box logs during the test; a warning has `<4>` before it."""
    with log_lines.collected() as lines:
        yield lines
