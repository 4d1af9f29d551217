"""The filter bank: graph by definition, float and int8, offsets, short windows."""

from dataclasses import replace

import numpy as np
import onnx
import pytest

from palpate.core.errors import FormatError
from palpate.core.types import SweepFormat
from palpate_train.data.augment import texture_scale
from palpate_train.models.recipe import bank, graph
from palpate_train.models.recipe.architectures import FLOOR, Architecture
from palpate_train.models.recipe.bank import TAPS, Bank
from palpate_train.models.recipe.recipe import FIXED
from palpate_train.onnx_tools.graph_builder import run

FORMATS = [
    SweepFormat(2, 2, 100.0, 64, "uint8"),
    SweepFormat(3, 3, 50.0, 40, "int16"),
    SweepFormat(1, 1, 10.0, 16, "uint16"),
    SweepFormat(4, 4, 750.0, 600, "uint8"),
    SweepFormat(4, 2, 750.0, 600, "float32"),
    SweepFormat(2, 2, 750.0, 600, "int16", 3),
]
MANY = SweepFormat(8, 10, 100.0, 160, "uint8")
LONG = SweepFormat(1, 1, 2200.0, 8800, "uint8")
forms = pytest.mark.parametrize("format", FORMATS, ids=str)
BANK = replace(FIXED, pools=bank.POOLS)


def counts(format: SweepFormat, n: int = 3) -> np.ndarray:
    """Random walks [n, T, R, C] of raw counts."""
    walk = (
        np.random.default_rng(7).integers(-3, 4, (n, format.window, *format.shape)).cumsum(axis=1)
    )
    return (
        1000 * (format.dtype != "uint8")
        + np.clip(100 + walk - walk.mean(axis=1, keepdims=True).astype(int), 0, 255)
    ).astype(format.dtype)


def small(format: SweepFormat, architecture: Architecture = BANK) -> Bank:
    """Twenty filters of the kinds for `format`, fitted to the random walks."""
    rng, kinds = (
        np.random.default_rng(3),
        (False,) if architecture.zero_sum(format.window) else (False, True),
    )
    every = bank.draw(format, rng, kinds)
    some = every.take(np.concatenate([np.flatnonzero(every.free == free)[:20] for free in kinds]))
    given, seen = counts(format, 12), [np.empty(0)] * len(some)
    for numbers, model in graph.bank_responses(format, texture_scale(given), architecture, some):
        for number, values in zip(numbers, run(model, given).swapaxes(0, 2), strict=True):
            seen[number] = values.ravel()
    return bank.fitted(some, seen, rng)


def trunk(
    format: SweepFormat,
    filters: Bank,
    int8: bool,
    prefixes: bool = False,
    pools: tuple[str, ...] = bank.POOLS,
) -> onnx.ModelProto:
    """The trunk of these filters alone."""
    given, seen = counts(format, 12), replace(BANK, pools=pools)
    ranges = graph.Ranges(graph.count_range(given, seen), ()) if int8 else None
    return graph.trunk_graph(
        format, texture_scale(given), filters.weights(), seen, ranges, prefixes
    )


@forms
def test_the_graph_is_the_definition(format: SweepFormat):
    """Tap by tap: the log of the mean magnitude in deviations, the share above a threshold."""
    filters, given = small(format), counts(format)
    scaled = (given - given.mean(axis=1, keepdims=True)) * texture_scale(counts(format, 12))
    for sweep, row in zip(
        scaled.reshape(len(given), format.window, -1),
        run(trunk(format, filters, False), given),
        strict=True,
    ):
        sizes, shares = [], []
        for weights, dilation, reach, limit in zip(
            filters.taps(), filters.dilations, filters.reach, filters.limits, strict=True
        ):
            stride = bank.stage(format, dilation).stride
            starts = range(0, format.window - (TAPS - 1) * dilation, stride)
            y = np.array(
                [
                    sum(weights[:, tap] @ sweep[at + tap * dilation] for tap in range(TAPS))
                    for at in starts
                ]
            )
            sizes.append(np.log(np.abs(y).mean() * reach + FLOOR))
            shares.append(np.mean(y > limit))
        np.testing.assert_allclose(row[: len(filters)], sizes, atol=2e-3)
        np.testing.assert_allclose(row[len(filters) :], shares, atol=3.5 / len(starts))


@forms
def test_int8_is_close_and_the_last_tenth_is_the_whole_window(format: SweepFormat):
    """Magnitudes agree within hundredths of a logarithm, shares within a few responses."""
    filters, given = small(format), counts(format)
    precise, rounded = (run(trunk(format, filters, int8), given) for int8 in (False, True))
    assert np.abs(precise - rounded).mean() < 0.03
    for int8, whole in ((False, precise), (True, rounded)):
        prefixes = run(trunk(format, filters, int8, prefixes=True), given)
        assert prefixes.shape == (len(given), 10, whole.shape[1])
        np.testing.assert_allclose(prefixes[:, -1], whole, atol=1e-5)


@pytest.mark.parametrize("int8", [False, True])
def test_one_pool_alone_is_its_part_of_both(int8: bool):
    """A head may see magnitudes or shares alone."""
    format, given = FORMATS[0], counts(FORMATS[0])
    filters = small(format)
    both = run(trunk(format, filters, int8), given)
    alone = [run(trunk(format, filters, int8, pools=(pool,)), given) for pool in bank.POOLS]
    np.testing.assert_array_equal(np.concatenate(alone, axis=1), both)


def test_wide_counts_keep_what_a_byte_would_round_away():
    """One sweep of eight is ten thousand times as large: int8 still gives float's features."""
    format = FORMATS[4]
    given = counts(format, 8)
    given[0] = (given[0] - 1000) * 1e4
    assert graph.count_range(given, BANK) / 127 > given[1:].max() - given[1:].min()
    ranges, filters = graph.Ranges(graph.count_range(given, BANK), ()), small(format)
    rounded, precise = (
        run(
            graph.trunk_graph(
                format, texture_scale(counts(format, 12)), filters.weights(), BANK, some
            ),
            given,
        )
        for some in (ranges, None)
    )
    np.testing.assert_array_equal(rounded, precise)
    assert len(np.unique(rounded[1:, len(filters) :])) > 20


@forms
def test_an_offset_changes_nothing(format: SweepFormat):
    """An offset of all taxels changes no bit in int8 if counts are whole."""
    filters, given = small(format), counts(format)
    higher = (given.clip(0, 250) + 5 if format.dtype == "uint8" else given + 1000).astype(
        format.dtype
    )
    given = given.clip(0, 250).astype(format.dtype) if format.dtype == "uint8" else given
    model = trunk(format, filters, True)
    np.testing.assert_allclose(
        run(model, higher),
        run(model, given),
        atol=0 if format.dtype == "uint8" and format.window == 600 else 0.05,
    )


@pytest.mark.parametrize("format", [*FORMATS, MANY, LONG], ids=str)
def test_filters_fit_the_window(format: SweepFormat):
    """Unit norm, sum zero unless free; all dilations fit; one taxel or all."""
    for free in (False, True):
        drawn = bank.draw(format, np.random.default_rng(0), (free,))
        assert (drawn.along.sum(axis=1) == 0).all() is np.bool_(not free)
        assert 0 < max(np.abs(drawn.across).max(), np.abs(drawn.along).max()) <= bank.LARGEST
        np.testing.assert_allclose(np.linalg.norm(drawn.taps(), axis=(1, 2)), 1, atol=1e-5)
        assert set(drawn.dilations) == set(bank.dilations(format.window))
        seen = (drawn.across != 0).sum(axis=1)
        assert seen.min() == 1
        assert seen.max() > 0.9 * format.channels
        assert len(drawn) * format.channels * TAPS <= bank.MOST_TAPS * (4 if format == MANY else 1)
        last = bank.stage(format, int(drawn.dilations.max()))
        assert (last.steps - 1) * last.hop + last.reach <= format.window


@pytest.mark.parametrize(
    ("window", "longest"), [(9, 1), (17, 2), (66, 8), (128, 8), (251, 16), (1500, 64), (8800, 512)]
)
def test_dilations_grow_with_the_window(window: int, longest: int):
    """Every power of two up to the longest, whose filters fit; in long windows they span half."""
    found = bank.dilations(window)
    assert found == [2**k for k in range(len(found))]
    assert found[-1] == longest
    assert (TAPS - 1) * longest < window


@pytest.mark.parametrize(
    ("format", "filters", "stride"),
    [
        (SweepFormat(4, 4, 750.0, 1500, "uint8"), 256, 5),
        (MANY, 204, 1),
        (LONG, 512, 8),
        (SweepFormat(40, 40, 50.0, 100, "uint8"), 64, 2),
    ],
    ids=str,
)
def test_filters_and_stride_follow_the_budgets(format: SweepFormat, filters: int, stride: int):
    """Of taps, operations and responses; large skins have more."""
    assert bank.count(format) == filters
    assert bank.stage(format, 1).stride == stride


def test_thresholds_leave_the_shares_that_were_drawn():
    """Of the responses that they are of; a window shorter than a filter is refused."""
    format = FORMATS[0]
    shares = run(trunk(format, small(format), False), counts(format, 12))[:, 40:].mean(axis=0)
    assert 0.05 < shares.min() < 0.25
    assert 0.75 < shares.max() < 0.95
    with pytest.raises(FormatError, match="8 frames"):
        bank.draw(SweepFormat(1, 1, 10.0, 8, "uint8"), np.random.default_rng(0), (False,))
