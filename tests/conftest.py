"""Fixtures that several test files share: the default bundle, boxes on simulated devices.

Numerical libraries use one thread in tests. Their models are small: with two threads a fit took 2.5
times the processor time, and four times as long beside another test.

No test can hang: pytest-timeout fails a test after `timeout` of pyproject.toml or of its own mark,
and a process that is stuck in C even then shows where and ends.
"""

import faulthandler
import gc
import os
import sys

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before numpy and PyTorch are imported
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from collections.abc import Callable, Generator, Iterator
from contextlib import ExitStack, suppress
from dataclasses import replace
from typing import Any

import pytest

from palpate.bundle import bundle
from palpate.core.types import Sweep
from palpate.io.robot_link import SerialSink
from palpate.runtime import assembly
from palpate.sim import devices
from palpate.sweeps.sweep_check import SweepCheck
from palpate.tools import pseudo_terminal
from tests.factories import browser as browsers
from tests.factories import log_lines
from tests.factories.paths import ROOT
from tests.factories.settings import load as load_settings
from tests.factories.simulated_box import OnSweep, Rigged, tubes

LIMIT_S = 300
"""Longest time of a test, as in pyproject.toml. One takes seconds, on a busy machine a minute."""
BUILDING_S = 3600
"""The same where the first test builds a Debian or a virtual machine."""
THOROUGH_S = 1200
"""The same of a thorough test, which may fit a model: minutes, and several times as long on a busy
machine."""
GRACE_S = 60

with suppress(ModuleNotFoundError):  # a board has no Hypothesis
    import hypothesis

    # A busy machine may take seconds for an example that takes milliseconds.
    hypothesis.settings.register_profile("any machine", deadline=None)
    hypothesis.settings.load_profile("any machine")


HEAVY = {"torch", "sklearn", "scipy", "pandas", "zarr"}
"""Libraries that take long to import."""
COLLECTED = pytest.StashKey[set[str]]()

gc.disable()  # until all tests are collected: each import would look through all modules before it


def pytest_collection_finish(session: pytest.Session) -> None:
    """Search new objects alone for garbage: the search took a fifth of the time."""
    session.config.stash[COLLECTED] = HEAVY & sys.modules.keys()
    gc.freeze()
    gc.set_threshold(20_000, 20, 50)
    gc.enable()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Give thorough tests their time, and those in Debians and emulated machines to build them."""
    for item in items:
        if item.path.relative_to(ROOT).parts[1] in ("rig", "systemd", "campaigns"):
            item.add_marker(pytest.mark.timeout(BUILDING_S))
        elif item.get_closest_marker("thorough") and not item.get_closest_marker("timeout"):
            item.add_marker(pytest.mark.timeout(THOROUGH_S))


@pytest.fixture
def heavy(pytestconfig: pytest.Config) -> set[str]:
    """The libraries of HEAVY that this process had imported when its tests were collected."""
    return pytestconfig.stash[COLLECTED]


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """End the process if a test runs on after its limit: no signal interrupts a stuck C call."""
    mark = item.get_closest_marker("timeout")
    limit_s = mark.args[0] if mark else LIMIT_S
    faulthandler.dump_traceback_later(limit_s + GRACE_S, exit=True, file=sys.__stderr__)
    try:
        return (yield)
    finally:
        faulthandler.cancel_dump_traceback_later()


@pytest.fixture(scope="module")
def launched() -> Iterator[Any]:
    """A browser for the module; while it is open, asyncio.run of another test would fail."""
    with browsers.launched() as one:
        yield one


@pytest.fixture
def browser(launched: Any) -> Iterator[Any]:
    """The browser; pages of a test are closed at its end."""
    yield launched
    for context in launched.contexts:
        context.close()


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
            simulated = simulated or tubes(1)
            settings = load_settings(sets)
            far_end, name = stack.enter_context(pseudo_terminal.pair())
            port = SerialSink(replace(settings.serial, port=name), simulated.clock)
            kept: list[Sweep] = []
            watching = [OnSweep(lambda sweep, verdict: kept.append(sweep)), *observers]
            if commands is None:
                box = assembly.box(
                    settings, model, simulated, port, stack, observers=watching, capture=capture
                )
            else:  # a box that records
                check = SweepCheck(simulated.format, simulated.clock)
                parts = settings, check, simulated, port, stack
                box = assembly.assembled(*parts, observers=watching, commands=commands)
            return Rigged(box, simulated, far_end, port, kept=kept)

        yield make


@pytest.fixture
def logged() -> Iterator[list[str]]:
    """The lines that the box logs during the test; a warning has `<4>` before it."""
    with log_lines.collected() as lines:
        yield lines
