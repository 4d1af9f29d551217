"""The spectrum against its definition: its response, its invariances, its limits."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest

from palpate.core.types import SweepFormat
from palpate.sim import skin
from palpate_train.data.run import Run
from palpate_train.models.recipe import graph, recipe, spectrum
from palpate_train.models.recipe.architectures import Architecture
from palpate_train.models.recipe.sizes import SIZES
from palpate_train.onnx_tools import graph_builder
from tests.factories.later import Later
from tests.factories.sweep_sets import easy

stages = Later("palpate_train.models.recipe.stages")

BARE = Architecture((), planned=3, spectrum=True)
SMALL = Architecture((6, 8, 8), 8, 2)
ODD = SweepFormat(2, 2, 100.0, 163, "int16")
FORMATS = {
    "skin": (skin.FORMAT, True),
    "four frames a period": (SweepFormat(1, 1, 200.0, 450, "float32"), True),
    "three frames a period": (SweepFormat(3, 3, 150.0, 450, "uint16"), False),
    "less than two periods a tenth": (SweepFormat(4, 4, 750.0, 299, "uint8"), False),
    "just two": (SweepFormat(4, 4, 750.0, 300, "uint8"), True),
    "odd": (ODD, False),
    "line": (SweepFormat(16, 1, 35.6, 128, "float32"), False),
    "shortest": (SweepFormat(2, 2, 100.0, 40, "uint8"), False),
    "three axes": (SweepFormat(3, 2, 750.0, 303, "int16", 3), True),
}
"""Formats, and whether the hum of the mains is removed there."""


def drawn(format: SweepFormat, n: int = 2, seed: int = 0) -> np.ndarray:
    """n sweeps of noise that all taxels share, and some of their own."""
    rng = np.random.default_rng(seed)
    own = rng.standard_normal((n, format.window, *format.shape))
    x = 90 + 8 * rng.standard_normal((n, format.window, *(1,) * len(format.shape))) + 4 * own
    return x.astype(format.dtype)


def trunk(
    format: SweepFormat, scale: float = 0.1, prefixes: bool = False, mains_hz: float = 50.0
) -> onnx.ModelProto:
    """The graph of the spectrum alone."""
    return graph.trunk_graph(format, scale, {}, replace(BARE, mains_hz=mains_hz), prefixes=prefixes)


def turned(x: np.ndarray) -> np.ndarray:
    """Factors of [n, T, R * C * A]: three times the noise of the fifth of sixteen is too loud."""
    step = max(x.shape[1] // 150, 1)
    noise = np.abs(x[:, 1::step] - x[:, :-1:step]).mean(1, keepdims=True)
    limit = 3 * -np.sort(-noise, axis=2)[:, :, [x.shape[2] // 4]]
    return np.minimum(limit / noise, 1)


def defined(
    format: SweepFormat, counts: np.ndarray, mains: bool, scale: float = 0.1, limited: bool = True
) -> np.ndarray:
    """Log band powers [n, 10, bands] of each prefix, in complex128; those of one axis after the
    other.

    From each tenth of the mean of the taxels the best-fitting offset and mains are subtracted; then
    Hann's window, a transform at half bins, and the mean of each band.
    """
    x, length = (
        counts.reshape(len(counts), format.window, -1).astype(np.float64),
        format.window // 10,
    )
    each = (x * turned(x) if limited else x).reshape(len(x), format.window, -1, format.axes).mean(2)
    wave = scale * each.swapaxes(1, 2)[:, :, : 10 * length].reshape(-1, length)
    turn = 2 * np.pi * 50 / format.rate_hz * np.arange(length)
    fits = np.stack([np.ones(length), np.sin(turn), np.cos(turn)][: 3 if mains else 1], axis=1)
    wave = wave - (fits @ np.linalg.lstsq(fits, wave.T, rcond=None)[0]).T
    window = np.hanning(length + 2)[1:-1]
    power = np.abs(np.fft.fft(wave * window, 2 * length)) ** 2 / (window**2).sum()
    edges = sorted({round(2 * ((length + 1) / 2) ** (i / 24)) for i in range(25)})
    bands = np.stack([power[:, a:b].mean(1) for a, b in pairwise(edges)], 1).reshape(
        len(counts), format.axes, 10, -1
    )
    bands = bands.swapaxes(1, 2).reshape(len(counts), 10, -1)
    return np.log(bands.cumsum(1) / np.arange(1, 11)[:, None] + 1e-4)


@pytest.mark.parametrize(("format", "mains"), FORMATS.values(), ids=FORMATS)
def test_the_spectrum_is_that_of_its_definition(format: SweepFormat, mains: bool):
    """In the graph and in that of prefixes; mains are removed from two periods on."""
    counts = drawn(format)
    want = defined(format, counts, mains)
    rows, whole = (
        graph_builder.run(trunk(format, prefixes=True), counts),
        graph_builder.run(trunk(format), counts),
    )
    assert rows.shape == want.shape == (2, 10, spectrum.count(format))
    np.testing.assert_allclose(rows, want, atol=2e-3)
    np.testing.assert_allclose(whole, want[:, -1], atol=2e-3)
    if mains:
        assert np.abs(defined(format, counts, False) - want).max() > 0.1


@pytest.mark.parametrize("dtype", ["uint8", "int16"])
def test_a_noisy_taxel_is_attenuated_as_for_the_trunk(dtype: str):
    """The bands come after the stages' features, in float and in int8."""
    format = SweepFormat(4, 4, 750.0, 600, dtype)
    counts = drawn(format)
    counts[:, :, 1, 2] = np.random.default_rng(3).integers(0, 250, counts.shape[:2])
    want = defined(format, counts, True)
    assert turned(counts.reshape(2, 600, 16).astype(float)).min() < 0.8
    assert np.abs(defined(format, counts, True, limited=False) - want).max() > 0.3
    np.testing.assert_allclose(graph_builder.run(trunk(format), counts), want[:, -1], atol=2e-3)
    plain = stages.StagesNetwork(format, 3, 0.1, norm=False, architecture=SMALL).eval()
    weights, found, size = plain.weights(), plain.ranges(counts), want.shape[2]
    for ranges in (None, found):
        for prefixes in (False, True):
            both, alone = (
                graph_builder.run(
                    graph.trunk_graph(format, 0.1, weights, shape, ranges, prefixes), counts
                )
                for shape in (replace(SMALL, spectrum=True), SMALL)
            )
            np.testing.assert_array_equal(both[..., :-size], alone)
            np.testing.assert_allclose(
                both[..., -size:], want if prefixes else want[:, -1], atol=2e-3
            )


@pytest.mark.parametrize("mains_hz", [50.0, 60.0])
@pytest.mark.parametrize(
    ("rate_hz", "window", "deaf"),
    [(750.0, 1500, True), (250.0, 500, True), (750.0, 200, False), (150.0, 450, False)],
)
def test_the_hum_of_the_mains_changes_nothing(
    rate_hz: float, window: int, deaf: bool, mains_hz: float
):
    """Of any phase if it can be separated; else everywhere."""
    format = SweepFormat(2, 2, rate_hz, window, "float32")
    counts, rng = drawn(format), np.random.default_rng(1)
    strength, phase = rng.uniform(35, 45, (2, 1, 2, 2)), rng.uniform(0, 1, (2, 1, 1, 1))
    ask = trunk(format, prefixes=True, mains_hz=mains_hz)
    for hz, silent in ((mains_hz, deaf), (110 - mains_hz, False)):
        hum = strength * np.sin(
            2 * np.pi * (hz / rate_hz * np.arange(window)[:, None, None] + phase)
        )
        hummed = (counts + hum).astype(np.float32)
        before, after = (graph_builder.run(ask, x) for x in (counts, hummed))
        apart = np.abs(after - before).max(-1)
        assert (apart < 5e-3).all() if silent else (apart > 0.5).all()


def test_later_frames_and_offsets_do_not_matter():
    """Row d depends on the first d + 1 tenths, to the bit; a constant load is nothing."""
    counts = drawn(ODD)
    held, late = counts.copy(), counts.copy()
    held[:, 64:], late[:, 160:] = held[:, 63:64], 91
    a, b, c, d = (
        graph_builder.run(trunk(ODD, prefixes=True), x)
        for x in (counts, held, late, counts + np.int16(300))
    )
    np.testing.assert_array_equal(a[:, :4], b[:, :4])
    assert (np.abs(a[:, 4:] - b[:, 4:]).max(2) > 1e-3).all()
    np.testing.assert_array_equal(a, c)
    np.testing.assert_allclose(a, d, atol=5e-3)


@pytest.mark.parametrize("name", FORMATS)
def test_silence_is_finite(name: str):
    """For any offset the power is only the constant that is added to each band."""
    format, _ = FORMATS[name]
    quiet = np.stack(
        [np.full((format.window, *format.shape), level, format.dtype) for level in (0, 90)]
    )
    for prefixes in (False, True):
        have = graph_builder.run(trunk(format, prefixes=prefixes), quiet)
        np.testing.assert_allclose(have, np.log(1e-4), atol=1e-3)


def test_the_box_computes_no_wave_and_the_file_holds_none(tmp_path: Path):
    """Made of a few numbers, one constant once loaded; the file stays below 10 kB."""
    model = trunk(skin.FORMAT)
    assert len(model.SerializeToString()) < 10_000
    options = onnxruntime.SessionOptions()
    options.optimized_model_filepath, options.log_severity_level = (
        str(tmp_path / "optimized.onnx"),
        3,
    )
    onnxruntime.InferenceSession(
        model.SerializeToString(), options, providers=["CPUExecutionProvider"]
    )
    optimized = onnx.load(tmp_path / "optimized.onnx").graph
    done = Counter(n.op_type for n in optimized.node)
    assert not {"Range", "Mod", "Cos", "Sin", "Less", "And", "Not"} & set(done)
    assert [150, 2 * 149] in [list(c.dims) for c in optimized.initializer]


@pytest.mark.slow
def test_a_window_too_short_has_no_spectrum():
    """With fewer than four frames in a tenth there are no bands, and a fit has no spectrum."""
    short = replace(easy(12), samples=easy(12).samples[:, :39])
    assert spectrum.count(short.format) == 0
    settings = recipe.Settings(calibrate=False)
    made = recipe.fit(short, Run(1), replace(settings, size=SIZES["64"]))
    assert (made.architecture.spectrum, made.bands) == (False, 0)
    assert made.architecture.pools
    enough = replace(easy(12), samples=easy(12).samples[:, :40])
    assert spectrum.count(enough.format) == 3
    assert recipe.fit(enough, Run(1), replace(settings, size=SIZES["bands"])).bands == 3
