"""The picture of a sweep for every grid and length, the same in every run."""

import re
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from palpate.core.errors import FormatError
from palpate.core.sweep_file import load, save
from palpate.core.types import Frames, Status, Sweep, SweepFormat
from palpate_train.data import sets
from palpate_train.reports import sweep_plot
from tests.factories.recordings import record
from tests.factories.sweep_sets import easy

SVG = "{http://www.w3.org/2000/svg}"
SHARES = 0.98765, 0.01235
ABOUT = {
    "tare": [[1.5] * 4] * 4,
    "verdict": dict(status="unsure", label="cork", probability=SHARES[0], scores=[*SHARES]),
    "bundle": "9f3c2a1b",
    "device": {"board": "readout", "serial": "A4", "firmware": [1, 4, 2]},
    "clock": {"jitter_us": 41.23456},
}


def sweep(path: Path, format: SweepFormat, about: dict | None = None, seq=None, **more) -> str:
    """A recording of noise, a second after its start edge, with a silent last taxel."""
    seq = np.arange(format.window) if seq is None else seq
    counts = np.random.default_rng(0).integers(0, 99, (len(seq), *format.shape))
    taxels = counts.astype(format.numpy_type)
    taxels[:, -1, -1] = 0
    t_ns = (1e9 + seq * format.period_ns).astype(np.int64)
    frames, given = Frames(t_ns, seq, taxels), {"material": "cork"} | more
    save(path, Sweep(7, 0, int(t_ns[-1]) + 1, Status.OK, frames, **given), format, about or {})
    return str(path)


def words(svg: str) -> str:
    """All texts of a picture, one a line."""
    return "\n".join(node.text or "" for node in ElementTree.fromstring(svg).iter(f"{SVG}text"))


def drawn(path: Path, *more, **also) -> str:
    """The picture of `sweep`."""
    return sweep_plot.draw(sweep_plot.load(sweep(path, *more, **also)))


@pytest.fixture
def small(tmp_path: Path) -> str:
    """A picture of the paper's skin with every field of a sidecar."""
    format = SweepFormat(4, 4, 750.0, 1500, "uint8")
    return drawn(tmp_path / "sweep-000017.npy", format, ABOUT, position="3", session="mon", lost=2)


def test_the_picture_says_what_is_known(small: str):
    """Label, places, file, losses, verdict, bundle, device, clock; fields have units."""
    shown = words(small)
    for text in (
        "cork, position 3, session mon",
        "sweep-000017.npy, sweep 7: ok",
        "4x4 uint8 at 750 Hz, window 1500",
        "2 frames lost, filled in from their neighbours",
        "verdict: status unsure, label cork, probability 0.9877",
        "bundle: 9f3c2a1b",
        "device: board readout, serial A4, firmware 1.4.2",
        "clock: jitter us 41.23",
        "grey: the skin at rest",
        "raw counts over seconds after the start edge",
        "raw counts per √Hz over Hz",
        "the noise of rounding to whole counts; without 1 constant taxel",
    ):
        assert text in shown, text
    places = {f"{row},{column}" for row in range(1, 5) for column in range(1, 5)}
    assert places <= set(shown.split("\n"))


@pytest.mark.slow
def test_a_sweep_that_was_recorded_without_a_bundle(tmp_path: Path):
    """A recording without a bundle shows the status alone, the trigger, and the unloaded skin."""
    about = {
        "verdict": {"status": "recorded", "label": "", "probability": 0.0, "detail": ""},
        "source": "usb",
        "trigger": {"mode": "key", "times": "arrival of the key"},
        "unloaded": {"level": [[1.5] * 4] * 4, "noise": [[0.5] * 4] * 4},
    }
    shown = words(drawn(tmp_path / "a.npy", SweepFormat(4, 4, 100.0, 200, "uint8"), about))
    assert "status recorded · " in shown
    assert "mode key" in shown
    assert "at rest" in shown
    found = drawn(
        tmp_path / "b.npy", SweepFormat(4, 4, 100.0, 200, "uint8"), about | {"unloaded": None}
    )
    assert "grey" not in words(found)


@pytest.mark.parametrize("side", [4, 12])
def test_the_picture_is_whole_and_needs_nothing(tmp_path: Path, side: int):
    """It has a title, plain colours, one image, and is the same when drawn twice."""
    format = SweepFormat(side, side, 50.0, 90, "float32")
    svg = drawn(tmp_path / "a.npy", format)
    assert ElementTree.fromstring(svg).find(f"{SVG}title").text == "one sweep: cork"
    links = re.findall(r'href="([^"]*)"', svg)
    assert all(link.startswith(("#", "data:image/png;base64,")) for link in links)
    assert "<style" not in svg
    assert "var(" not in svg
    assert drawn(tmp_path / "a.npy", format) == svg


@pytest.mark.slow
def test_offsets_do_not_flatten_the_lines(monkeypatch: pytest.MonkeyPatch):
    """Each about its own level, which stands beside it; the tare, if it is known."""
    limits = []
    monkeypatch.setattr(sweep_plot, "_taxel", lambda axes, *_: limits.append(axes.get_ylim()))
    samples = np.random.default_rng(0).integers(0, 20, (2, 64, 2, 2)).astype(np.int16)
    samples += np.array([[0, 1000], [2000, 5000]], np.int16)
    made = sets.Dataset(samples, np.arange(2), ("a", "b"), 100.0, {}, "offsets")
    shown = sweep_plot.of_set(made, 0)
    texts = words(sweep_plot.draw(shown))
    assert "about its median" in texts
    assert any(f"{level}" in texts for level in range(1000, 1020))
    tared = replace(shown, tare=np.median(samples[0], axis=0))
    assert "about the skin" in words(sweep_plot.draw(tared))
    assert all(up - low < 60 for low, up in limits)


def test_a_tone_stands_at_its_frequency(monkeypatch: pytest.MonkeyPatch):
    """A sine of 100 Hz has its peak there, with its height as a density."""
    format = SweepFormat(1, 1, 750.0, 1500, "float32")
    tone = 8 * np.sin(2 * np.pi * 100 * np.arange(1500) / 750)[:, None]
    axes = sweep_plot.add_axes(sweep_plot.Figure((5, 5)), 0, 1, 1, 0)
    sweep_plot._spectrum(axes, tone, format)
    hz, density = axes.lines[0].get_data()
    assert hz[0] == 1
    assert hz[-1] == 375
    assert hz[density.argmax()] == 100
    # Hann's noise width is 1.5 bins
    assert density.max() == pytest.approx(8 / np.sqrt(2) / np.sqrt(1.5), rel=0.01)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rows", "cols", "window", "dtype"),
    [
        (1, 1, 1, "uint8"),
        (1, 1, 7, "float32"),
        (1, 64, 8, "int16"),
        (9, 1, 9, "uint16"),
        (8, 8, 30, "uint8"),
        (5, 13, 3, "int16"),
        (255, 1, 40, "uint8"),
        (1, 255, 40, "float32"),
        (255, 255, 24, "uint8"),
    ],
)
def test_every_grid_can_be_drawn(tmp_path: Path, rows: int, cols: int, window: int, dtype: str):
    """From one taxel and one frame to the largest skin, in a small file."""
    svg = drawn(tmp_path / "a.npy", SweepFormat(rows, cols, 0.5, window, dtype))
    ElementTree.fromstring(svg)
    assert len(svg) < 2_000_000
    assert ("no spectrum" in words(svg)) == (window < 8 or rows * cols == 1)
    assert ("1,1" in words(svg).split("\n")) == (rows <= 8 and cols <= 8)


@pytest.mark.parametrize("grid", [(2, 3), (9, 2)])
def test_axes_share_the_plot_of_their_taxel(tmp_path: Path, grid: tuple[int, int]):
    """A line for each axis, or an image; a tare of another shape is refused."""
    format = SweepFormat(*grid, 100.0, 100, "int16", 3)
    shown = words(drawn(tmp_path / "a.npy", format, {"tare": np.ones(format.shape).tolist()}))
    small = max(grid) <= 8
    wanted = (
        "; 3 axes, the normal one dark" if small else "in each row its 2 taxels, of each its 3 axes"
    )
    assert wanted in shown
    assert str(format) in shown
    seen = sweep_plot.load(sweep(tmp_path / "b.npy", format))
    figure = sweep_plot.Figure((5, 5))
    if small:
        sweep_plot._skin(figure, seen, seen.taxels.reshape(100, -1).astype(float))
        assert [len(axes.lines) for axes in figure.axes] == [3] * 6
        normal = seen.taxels[:, 0, 1, 2]
        drawn_counts = figure.axes[1].lines[2].get_ydata()
        np.testing.assert_array_equal(drawn_counts, normal - np.median(normal))
    with pytest.raises(FormatError, match=f"no {grid[0]} x {grid[1]} x 3 numbers"):
        sweep_plot.load(sweep(tmp_path / "c.npy", format, {"tare": np.ones(grid).tolist()}))


@pytest.mark.parametrize("count", [0, 255])
def test_a_silent_skin_can_be_drawn(tmp_path: Path, count: int):
    """In a constant sweep no frequency has power, and no axis has length zero."""
    format = SweepFormat(2, 2, 100.0, 300, "uint8")
    still = np.full((300, 2, 2), count, np.uint8)
    frames = Frames(np.arange(300) * 10**7, np.arange(300), still)
    save(tmp_path / "a.npy", Sweep(1, 0, 1, Status.OK, frames), format)
    shown = words(sweep_plot.draw(sweep_plot.load(str(tmp_path / "a.npy"))))
    assert "no material" in shown
    assert "no spectrum" in shown


@pytest.mark.slow
@pytest.mark.parametrize("grid", [(2, 2), (9, 9)])
def test_missing_frames_are_marked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, grid: tuple[int, int]
):
    """A bar as wide as the gap; the spectrum is of the longest part without one."""
    format = SweepFormat(*grid, 100.0, 400, "uint8")
    whole = drawn(tmp_path / "a.npy", format)
    seen = sweep_plot.load(sweep(tmp_path / "b.npy", format, seq=np.r_[0:300, 350:400]))
    assert list(seen.gaps) == [299]
    axes = sweep_plot.add_axes(sweep_plot.Figure((5, 5)), 0, 1, 1, 0)
    seen.span(axes)
    (bar,) = axes.patches
    assert (bar.get_x(), bar.get_width()) == (pytest.approx(3.99), pytest.approx(0.51))
    heard, spectrum = [], sweep_plot._spectrum
    monkeypatch.setattr(
        sweep_plot, "_spectrum", lambda *given: (heard.append(len(given[1])), spectrum(*given))
    )
    assert "grey bars" in words(sweep_plot.draw(seen))
    assert heard == [300]
    assert "no spectrogram" not in words(whole)
    assert "grey bars" not in words(whole)


@pytest.mark.slow
def test_texts_are_shown_as_they_are(tmp_path: Path):
    """No formulas, no markup, long texts end with …, unknown characters become �."""
    format = SweepFormat(1, 1, 50.0, 9, "uint8")
    assert "$a_b$ <&>" in words(drawn(tmp_path / "a.npy", format, material="$a_b$ <&>"))
    first = words(drawn(tmp_path / "a.npy", format, material="x" * 300)).split("\n")[0]
    assert (len(first), first[-1]) == (80, "…")
    s = easy(2)
    object.__setattr__(s, "materials", ("a\x01b", "c", "d"))
    s.save(tmp_path / "a.npz")
    assert words(sweep_plot.draw(sweep_plot.load(str(tmp_path / "a.npz"), 0))).startswith(
        "a�b, recording 0"
    )


def test_a_sweep_of_a_set_is_chosen_by_number(tmp_path: Path):
    """Of a file, a simulated set or a folder, counted as in training."""
    s = easy(4)
    s.save(tmp_path / "s.npz")
    seen = sweep_plot.load(str(tmp_path / "s.npz"), 11)
    np.testing.assert_array_equal(seen.taxels, s.samples[11])
    assert seen.title.split(", ") == ["high", "recording 11", "speed 3"]
    assert seen.since == "seconds"
    assert sweep_plot.load("sim:T-HARD:1001:1", 5).title.startswith("foam, position 0, world")
    record(tmp_path / "box" / "0.npy", status=Status.GAP, frames=0)
    record(tmp_path / "box" / "1.npy", "a", id=50)
    assert sweep_plot.load(str(tmp_path / "box"), 0).taxels[0, 0, 0] == 50


@pytest.mark.parametrize(
    ("what", "number"),
    [
        ("box/1.npy", 0),
        ("box", None),
        ("box", 1),
        ("box", -1),
        ("s.npz", 12),
        ("box/0.npy", None),
        ("box/2.npy", None),
        ("box/4.npy", None),
        ("box/5.npy", None),
        ("box/3.npy", None),
        ("gone.npz", 0),
    ],
)
def test_what_cannot_be_drawn_is_refused(tmp_path: Path, what: str, number: int | None):
    """Other numbers, no frames, another tare, no sweep: the file is named."""
    easy(4).save(tmp_path / "s.npz")
    record(tmp_path / "box" / "0.npy", status=Status.GAP, frames=0)
    record(tmp_path / "box" / "1.npy")
    for name, tare in (("2", [[1, 2]]), ("4", "x"), ("5", [[1, 2, None]] * 2)):
        file = tmp_path / "box" / f"{name}.npy"
        if what.endswith(file.name):
            record(file)
            save(file, *load(file), {"tare": tare})
    with pytest.raises(FormatError, match=what):
        sweep_plot.load(str(tmp_path / what), number)


@pytest.mark.slow
def test_the_spectrogram_shows_when_a_tone_sounds(monkeypatch: pytest.MonkeyPatch):
    """25 Hz in the second half alone: weak before and strong after."""
    rate = 100.0
    t = np.arange(400) / rate
    tone = np.where(t >= 2, 40 * np.sin(2 * np.pi * 25 * t), 0)
    noise = np.random.default_rng(0).normal(0, 1, (400, 2, 2))
    counts = (100 + tone[:, None, None] + noise).astype(np.float32)
    form = SweepFormat(2, 2, rate, 400, "float32")
    shown = sweep_plot.ShownSweep(counts, t, form, "", (), "seconds", None, np.empty(0, int))
    seen = []
    monkeypatch.setattr(
        sweep_plot.Axes, "imshow", lambda axes, db, **more: seen.append((db, more["extent"]))
    )
    sweep_plot.draw(shown)
    ((db, (start, end, low, high)),) = seen
    band = round((25 - low) / (high - low) * len(db) - 0.5)
    columns = start + (np.arange(db.shape[1]) + 0.5) / db.shape[1] * (end - start)
    assert db[band, columns > 2.7].min() > db[band, columns < 1.3].max() + 20
    assert 0 <= start < end <= 4
