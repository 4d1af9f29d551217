"""The View of the contact on the skin, and its line for a terminal."""

from __future__ import annotations

import io
import math
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from palpate.alignment import live
from palpate.alignment.live import ContactTracker, Expected, LinePrinter, View, line
from palpate.answer.contact import ContactPositions
from palpate.bundle import bundle
from palpate.bundle.bundle import Bundle, Manifest
from palpate.cli.main import main
from palpate.core import config
from palpate.core.interrupts import StopFlag
from palpate.io import skins
from palpate.sim import devices, rig, script, skin
from tests.factories.paths import NO_SITE
from tests.factories.simulated_box import SECOND

MIDDLE = ContactPositions(4.0, (6.0, 6.4), (6.0, 5.8), 0.6)


@pytest.fixture
def model(default_bundle: Bundle) -> Bundle:
    """The default bundle, with trained positions."""
    return replace(default_bundle, manifest=replace(default_bundle.manifest, contact=MIDDLE))


def views_of(
    simulated: devices.SimDevices, model: Bundle | Expected
) -> Callable[[float], list[View]]:
    """A function that reads the skin of `simulated` for some seconds and returns the Views."""
    settings = simulated.wire(config.load(None, [], site=NO_SITE))
    expected = model if isinstance(model, Expected) else Expected.by(model)
    sensor = skins.sensor(settings, expected.format, simulated)
    tracker = ContactTracker(expected, simulated.source)

    def views(seconds: float) -> list[View]:
        seen: list[View] = []
        end_ns = simulated.clock.now_ns() + round(seconds * SECOND)
        display = SimpleNamespace(show=seen.append)
        live.run(
            sensor, tracker, [display], simulated.clock, lambda: simulated.clock.now_ns() >= end_ns
        )
        return seen

    return views


def resting(seed: int = 1) -> devices.SimDevices:
    """The simulated finger that rests on the tube while a person aligns the skin."""
    return devices.build(
        skin.FORMAT, script.named("rest", skin.FORMAT, seed)[0], rig.VirtualClock(), "sim"
    )


def states(views: list[View]) -> list[str]:
    """The states in order, without repetitions."""
    return [v.state for i, v in enumerate(views) if i == 0 or v.state != views[i - 1].state]


def test_views_follow_the_touches(model):
    """Finger off, then four touches, each nearer: the message follows; the last is in place."""
    views = views_of(resting(), model)
    seen = views(17)
    assert states(seen)[:4] == ["wait", "no-contact", "off", "no-contact"]
    assert states(seen)[-3:] == ["no-contact", "in-place", "no-contact"]
    off = [v for v in seen if v.state == "off"]
    assert re.match(r"2\.5 mm .*column 1 .*row 1", off[3].message)
    last = [v for v in seen if v.state == "in-place"][-4]
    assert last.message == "in place"
    assert last.centre == pytest.approx((6, 6), abs=0.6)
    assert math.dist(last.centre, last.nearest) < MIDDLE.limit_mm
    assert last.full == pytest.approx(max(max(row) for v in seen for row in v.load), abs=0.1)
    assert [v.number for v in seen] == list(range(1, len(seen) + 1))


def test_a_finger_is_noticed_above_any_unloaded_skin(model):
    """Above the bundle's counts; one that lay there at the start, once each taxel was free."""

    def pressed(*loads: float) -> devices.SimDevices:
        """A skin with these loads on all taxels except the last, for a second each."""
        on = np.concatenate([np.full((750, 4, 4), load, np.uint8) for load in loads])
        on[:, 3, 3] = 3
        return devices.build(
            skin.FORMAT, [rig.Act(on, 0, len(on) - 1, "")], rig.VirtualClock(), "sim"
        )

    rest = replace(model, manifest=replace(model.manifest, unloaded=(50.0,) * 16))
    seen = views_of(pressed(130, 145, 52, 130), rest)(4)
    assert states(seen) == ["wait", "lift", "no-contact", "in-place"]
    assert "unloaded" in next(v for v in seen if v.state == "lift").hint
    assert states(views_of(pressed(130, 145, 52, 130), model)(4)) == ["wait", "lift"]
    views = views_of(pressed(80, 95, 2, 80), model)
    seen = views(4)
    assert states(seen) == ["wait", "lift", "no-contact", "in-place"]
    assert "counts" in next(v for v in seen if v.state == "lift").hint
    assert seen[-1].load[0][0] == pytest.approx(78)
    assert seen[-1].load[3][3] == 0


@pytest.mark.parametrize("lacks", ["a threshold", "positions", "a bundle"])
def test_without_trained_positions_the_centre_alone_is_shown(model, lacks):
    """The threshold is that of the present skin; the centre is in taxels."""

    def known(model: Bundle, **changes: object) -> Expected:
        """The skin as a bundle with another manifest describes it."""
        return Expected.by(replace(model, manifest=replace(model.manifest, **changes)))

    bare = {"contact": None, "displacement": None}
    limits = replace(model.manifest.thresholds, contact=None)
    expected, hint = {
        "a threshold": (known(model, **bare, thresholds=limits), "cannot detect contact"),
        "positions": (known(model, **bare), "export it again"),
        "a bundle": (Expected(model.format), "no bundle fits"),
    }[lacks]
    seen = views_of(resting(), expected)(14.5)
    assert {*states(seen)} == {"wait", "no-contact", "no-positions"}
    last = [v for v in seen if v.centre][-1]
    assert last.centre == pytest.approx((1.5, 1.5), abs=0.15)
    assert (last.nearest, last.contact, last.unit) == (None, None, "taxels")
    assert hint in last.hint


def test_an_unplugged_skin_is_shown_and_waited_for(model):
    """State and advice, no old picture; afterwards the tare is measured anew."""
    simulated = resting()
    views = views_of(simulated, model)
    views(2)
    simulated.backend.unplug()
    gone = views(0.6)[-1]
    assert gone.state == "no-skin"
    assert gone.message in ("no skin: absent", "no skin: lost")
    assert gone.hint
    assert gone.load == ()
    simulated.backend.plug()
    assert states(views(4)) == ["no-skin", "wait", "lift", "no-contact", "off"]


@pytest.mark.parametrize(
    ("source", "word"), [("usb", ""), ("sim", "SIMULATED  "), ("replay", "REPLAYED  ")]
)
def test_a_line_says_what_it_is_of(source, word):
    """A replayed set is not called simulated; a View without a contact has no centre."""
    assert line(replace(VIEW, source=source, centre=None)) == f"{word}too far  (move it)"
    assert "row 3.8 column 6.0 mm" in line(replace(VIEW, source=source))


@pytest.mark.slow
@pytest.mark.parametrize(("which", "want"), [("skin", "SIMULATED"), ("replay", "REPLAYED")])
def test_align_with_what_is_simulated(which, want, tmp_path, default_bundle, capsys, monkeypatch):
    """`align --sim skin` and `--sim replay:SET` find a contact and say their source."""
    np.savez(
        tmp_path / "s.npz",
        samples=default_bundle.golden,
        labels=[0, 1],
        materials=["a", "b"],
        rate_hz=750.0,
    )
    turns = iter(range(1200))
    monkeypatch.setattr(StopFlag, "__call__", lambda flag: next(turns, None) is None)
    name = which if which == "skin" else f"replay:{tmp_path / 's.npz'}"
    assert main(["skin", "align", "--sim", name, "--virtual"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert all(text.startswith(want) for text in lines)
    assert any("centre" in text for text in lines)


def test_other_skins_are_looked_at_along_the_normal(model):
    """With shear, which is not shown; of 2 x 3 taxels in floats, some of them NaN."""
    world = skin.World(shear=True)
    other = replace(model, manifest=replace(model.manifest, format=world.format))
    script_of = script.named("rest", world.format, 1)[0]
    seen = views_of(devices.build(world.format, script_of, rig.VirtualClock(), "sim"), other)(17)
    assert states(seen)[-2:] == ["in-place", "no-contact"]
    last = [v for v in seen if v.state == "in-place"][-4]
    assert (last.shape, len(last.load), len(last.load[0])) == ((4, 4), 4, 4)
    assert last.centre == pytest.approx((6, 6), abs=0.6)
    format = replace(model.format, rows=2, cols=3, dtype="float32")
    other = replace(
        model,
        manifest=replace(
            model.manifest,
            format=format,
            contact=replace(MIDDLE, rows_mm=(2.0, 2.0), cols_mm=(4.0, 4.0)),
        ),
    )
    load = np.zeros((3000, 2, 3), np.float32)
    load[1000:, :, 1:] = 60.0
    load[:, 0, 0] = np.nan
    simulated = devices.build(format, [rig.Act(load, 0, 2999, "")], rig.VirtualClock(), "sim")
    seen = views_of(simulated, other)(3)
    assert re.match(r"2\.0 mm .*column 3", seen[-1].message)
    assert seen[-1].load[0][0] == 0


VIEW = View(
    *(7, "sim", "default 3, 9f3c2a1b", "streaming", "off", "too far", "move it", (4, 4)),
    centre=(3.8, 6.0),
    contact=MIDDLE,
)


def test_a_view_is_shown_five_times_a_second_and_printed_once(model, monkeypatch):
    """A View every VIEW_NS, a line a second; `stopped` ends it all."""
    for line_ns, lines in ((0, range(24, 27)), (SECOND, range(5, 7))):
        simulated, out = resting(), io.StringIO()
        end_ns = simulated.clock.now_ns() + 5 * SECOND
        monkeypatch.setattr("palpate.alignment.live.LINE_NS", line_ns)
        settings = simulated.wire(config.load(None, [], site=NO_SITE))
        printer = LinePrinter(out, simulated.clock, line)
        stopped = lambda: simulated.clock.now_ns() >= end_ns  # noqa: B023, E731
        tracker = ContactTracker(Expected.by(model), simulated.source)
        with closing(skins.sensor(settings, model.format, simulated)) as sensor:
            live.run(sensor, tracker, [printer], simulated.clock, stopped)
        assert len(out.getvalue().splitlines()) in lines
        assert not simulated.backend.board.running


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bundle with trained positions, on disk."""
    target = tmp_path_factory.mktemp("bundle")
    for name in bundle.load(bundle.DEFAULT).manifest.files:
        (target / name).write_bytes((bundle.DEFAULT / name).read_bytes())
    manifest = Manifest.parse((bundle.DEFAULT / bundle.MANIFEST).read_bytes())
    (target / bundle.MANIFEST).write_bytes(replace(manifest, contact=MIDDLE).json())
    return target


@pytest.mark.slow
def test_ctrl_c_ends_it(folder):
    """The command prints plain lines until Ctrl-C."""
    command = [sys.executable, "-m", "palpate", "skin", "align", "--sim", "rest"]
    command += ["--set", f"classifier.bundle={folder}"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as run:
        first = run.stdout.readline()
        run.send_signal(signal.SIGINT)
        assert run.wait(60) == 130
        assert (first + run.stdout.read()).count("reading the unloaded skin") >= 1
    assert "\033" not in first
