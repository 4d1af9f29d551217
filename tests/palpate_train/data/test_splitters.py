"""Protocols: which sweeps train and which test, and never a recording on both sides."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from palpate.core.errors import FormatError
from palpate_train.data.sets import Dataset
from palpate_train.data.splitters import Protocol, draw, inner_parts
from tests.factories.later import Later

model_selection = Later("sklearn.model_selection")


def a_set(labels: list[int], **groups: list[int]) -> Dataset:
    """Sweeps of one frame whose count is their number."""
    n = len(labels)
    samples = np.arange(n, dtype=np.int16).reshape(n, 1, 1, 1)
    names = tuple("abcdef"[: max(labels) + 1])
    arrays = {k: np.array(v) for k, v in groups.items()}
    return Dataset(samples, np.array(labels), names, 100.0, arrays, "made up")


GRID = a_set(
    [k for _ in range(3) for k in (0, 0, 1, 1)],
    position=[p for p in range(3) for _ in range(4)],
    recording=[r for r in range(6) for _ in range(2)],
)


@pytest.mark.parametrize("text", ["leave:position", "random:3", "split:position=0,1->2"])
def test_a_protocol_tests_what_it_did_not_train_on(text: str):
    """No sweep and no recording on both sides; every fold has both."""
    for train, test in Protocol(text).folds(GRID, 1):
        assert min(len(train), len(test)) > 0
        assert not set(GRID.groups["recording"][train]) & set(GRID.groups["recording"][test])


def test_leave_and_split_are_as_they_say():
    """scikit-learn's folds in their order; values before and after the arrow."""
    ((train, test),) = Protocol("split:position=2->0").folds(GRID, 1)
    assert set(GRID.groups["position"][train]) == {2}
    assert set(GRID.groups["position"][test]) == {0}
    theirs = model_selection.LeaveOneGroupOut().split(
        GRID.samples, GRID.labels, GRID.groups["position"]
    )
    for (train, test), (their_train, their_test) in zip(
        Protocol("leave:position").folds(GRID, 1), theirs, strict=True
    ):
        assert train.tolist() == their_train.tolist()
        assert test.tolist() == their_test.tolist()


@settings(max_examples=30)
@given(st.integers(2, 4), st.integers(0, 99), st.integers(1, 4))
def test_random_folds_are_whole_recordings_and_everything_once(folds: int, seed: int, pieces: int):
    """Each sweep is tested once; no recording is cut; every fold holds every material."""
    recording = np.repeat(np.arange(12), pieces)
    sweeps = a_set((recording % 3).tolist(), recording=recording.tolist())
    tested = []
    for train, test in Protocol(f"random:{folds}").folds(sweeps, seed):
        assert not set(recording[train]) & set(recording[test])
        assert set(sweeps.labels[test]) == {0, 1, 2}
        tested += test.tolist()
    assert sorted(tested) == list(range(len(sweeps)))


def test_random_folds_follow_their_seed_and_need_recordings():
    """Equal seeds, equal folds; for one recording no number would help."""
    sweeps = a_set([0, 1] * 20)
    one, same, other = (
        [t.tolist() for _, t in Protocol("random:4").folds(sweeps, s)] for s in (1, 1, 2)
    )
    assert one == same
    assert one != other
    with pytest.raises(FormatError, match="'b'"):
        Protocol("random:2").folds(a_set([0, 0, 1]), 1)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("loo", "be read"),
        ("random:1", "few folds"),
        ("random:4", "random:3"),
        ("leave:speed", "'speed'"),
        ("leave:one", "have 7"),
        ("split:position=0->9", "0, 1, 2"),
        ("split:position=0,1->1,2", "position=1"),
        ("split:position=0", "be read"),
    ],
)
def test_what_cannot_be_split_is_named(text: str, why: str):
    """Unknown protocols, groups and values, and folds that cannot be filled."""
    sweeps = a_set(GRID.labels.tolist(), **GRID.groups, one=[7] * 12)
    with pytest.raises(FormatError, match=why):
        Protocol(text).folds(sweeps, 1)


@pytest.mark.parametrize("text", ["leave:half", "split:half=0->1"])
def test_a_group_that_cuts_recordings_is_refused(text: str):
    """Pieces of one recording are never on both sides."""
    sweeps = a_set([0, 0, 1, 1], recording=[0, 0, 1, 1], half=[0, 1, 0, 1])
    with pytest.raises(FormatError, match="2 recordings, 0 among"):
        Protocol(text).folds(sweeps, 1)


def test_what_cannot_be_trained_on_is_refused():
    """Numbers that start anew would fuse materials; one material is not enough."""
    sweeps = a_set([0, 0, 1, 1], recording=[5, 6, 5, 6], day=[0, 1, 0, 1])
    with pytest.raises(FormatError, match="recording 5"):
        Protocol("leave:day").folds(sweeps, 1)
    sweeps = a_set([0, 0, 1, 1], session=[0, 0, 1, 1])
    with pytest.raises(FormatError, match="2 sweeps"):
        Protocol("leave:session").folds(sweeps, 1)


def test_protocols_speak_of_values():
    """Fractions and names; an absent value, or a text, is named."""
    force, speed = [0.0, 0.5, 1.5] * 4, ["slow", "medium", "fast"] * 4
    sweeps = a_set([0, 0, 0, 1, 1, 1] * 2, force=force, speed=speed)
    for text, left in (("force=0,0.5->1.5", 2), ("speed=slow,medium->fast", 2)):
        ((train, test),) = Protocol(f"split:{text}").folds(sweeps, 1)
        assert set(test % 3) == {left}
        assert len(train) == 8
    assert len(Protocol("leave:speed").folds(sweeps, 1)) == 3
    assert Protocol("leave:speed").clusters(sweeps).tolist() == speed
    with pytest.raises(FormatError, match="'speed'"):
        Protocol("split:speed=slow->quick").folds(sweeps, 1)
    with pytest.raises(FormatError, match="'slow'"):
        Protocol("split:force=0->slow").folds(sweeps, 1)
    parts = inner_parts(sweeps)
    assert {part.group for part in parts} == {"force", "speed"}
    assert all(part.out.sum() == 4 for part in parts)


def test_clusters_and_learning_curves_follow_the_split():
    """Left-out groups, recordings or None; so many of each, equal for equal seeds."""
    assert Protocol("leave:position").clusters(GRID).tolist() == GRID.groups["position"].tolist()
    assert Protocol("random:3").clusters(GRID).tolist() == GRID.groups["recording"].tolist()
    assert Protocol("random:3").clusters(a_set([0, 1])) is None
    labels = np.repeat([0, 1, 2], [20, 8, 3])
    train = np.flatnonzero(np.arange(31) % 5)
    few, more = (draw(train, labels, each, 1) for each in (2, 6))
    assert np.bincount(labels[few]).tolist() == [2, 2, 2]
    assert np.bincount(labels[more]).tolist() == [6, 6, 2]
    assert set(few) <= set(more) <= set(train)
    assert more.tolist() == sorted(more)
    assert draw(train, labels, 6, 1).tolist() == more.tolist() != draw(train, labels, 6, 2).tolist()
    assert draw(train, labels, 99, 1).tolist() == train.tolist()


def test_no_part_leaves_one_sweep_of_each_material():
    """That does not show how a material varies: recordings serve, and too few are said at once."""
    sweeps = a_set([0, 0, 0, 1, 1, 1], recording=[*range(6)], force=[0, 1, 1, 0, 1, 1])
    assert {part.group for part in inner_parts(sweeps)} == {"force"}
    even = a_set([0, 0, 1, 1, 2, 2, 2], recording=[*range(7)], force=[0, 1, 0, 1, 0, 1, 1])
    assert [part.out.tolist() for part in inner_parts(even)] == [
        (even.group("force") == 0).tolist()
    ]
    with pytest.raises(FormatError, match=r"4 sweeps of 2 .* three of each"):
        inner_parts(a_set([0, 0, 1, 1], recording=[*range(4)], force=[0, 1, 0, 1]))


@settings(max_examples=30)
@given(st.integers(2, 5), st.integers(0, 99), st.integers(1, 4), st.booleans())
def test_random_folds_are_scikit_learns(folds: int, seed: int, pieces: int, mixed: bool):
    """Those of StratifiedGroupKFold, which is not imported."""
    recording = np.repeat(np.arange(20), pieces)
    label = np.random.default_rng(seed).permutation(20)[recording] % 3 if mixed else recording % 3
    sweeps = a_set(label.tolist(), recording=recording.tolist())
    theirs = model_selection.StratifiedGroupKFold(folds, shuffle=True, random_state=seed).split(
        label, label, recording
    )
    for (_, test), (_, wanted) in zip(
        Protocol(f"random:{folds}").folds(sweeps, seed), theirs, strict=True
    ):
        assert test.tolist() == wanted.tolist()


@pytest.mark.parametrize("varies", [("speed",), ("speed", "force"), ()])
def test_named_groups_alone_are_left_out_with_their_outermost_values(varies: tuple[str, ...]):
    """Each value of them is judged once, by sweeps of the others; without a name, of all groups."""
    n, speeds = 60, [10, 20, 50, 100, 150]
    grid = {
        "speed": [speeds[i // 2 % 5] for i in range(n)],
        "force": [i // 10 % 3 for i in range(n)],
    }
    sweeps = a_set([i % 2 for i in range(n)], **grid)
    parts = inner_parts(sweeps, varies)
    assert {part.group for part in parts} == set(varies or grid)
    for name in {part.group for part in parts}:
        out = [np.unique(sweeps.group(name)[p.out]) for p in parts if p.group == name]
        assert sorted(np.concatenate(out)) == sorted(set(grid[name]))
