"""The check of the mean level: levels of sessions, levels of materials, odd sets."""

import re
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from palpate_train.arguments import options
from palpate_train.cli.main import PROGRAM, main
from palpate_train.data.sets import Dataset
from palpate_train.evaluate import level_check
from tests.factories.recordings import record

MATERIALS = ("a", "b", "c", "d")
SESSIONS = re.compile(
    r"warning: the mean level alone names 100 % of the sweeps within one session and (\d+) % "
    r"across sessions \(chance 2[5-7] %\): a level that the session sets more than the material; "
    r"leave sessions out when you evaluate \(--protocol leave:session\)"
)


def leveled(
    by_session: bool, each: int = 8, windows: int = 1, sessions: int = 3, dtype: str = "int16"
) -> Dataset:
    """`each` recordings of `windows` sweeps [6, 2, 2] of each of MATERIALS in each session.

    The level of a material is its number times 100, or if `by_session` the next material's in the
    next session.
    """
    session, material, _, _ = np.indices((sessions, len(MATERIALS), each, windows)).reshape(4, -1)
    level = 100 * ((material + session * by_session) % len(MATERIALS))
    noise = np.random.default_rng(1).normal(0, 4, (len(level), 6, 2, 2))
    samples = (1000 + level[:, None, None, None] + noise).astype(dtype)
    groups = {"recording": np.arange(len(level)) // windows, "session": session}
    return Dataset(samples, material, MATERIALS, 50.0, groups, "leveled")


def check_sessions(lines: Sequence[str]) -> None:
    """The only line is that of the session; across sessions the level is worse than chance."""
    (line,) = lines
    assert (found := SESSIONS.fullmatch(line))
    assert int(found[1]) < 25


def with_levels(sweeps: Dataset, level: np.ndarray) -> Dataset:
    """The set with other levels [N] under the same noise."""
    noise = sweeps.samples - sweeps.samples.mean(axis=(1, 2, 3), keepdims=True)
    return replace(sweeps, samples=(level[:, None, None, None] + noise).astype(np.int16))


@pytest.mark.parametrize("dtype", ["int16", "uint16", "float32"])
@pytest.mark.parametrize("windows", [1, 2])
def test_a_level_that_the_session_sets_is_reported(dtype: str, windows: int):
    """Both accuracies and chance; no line for other groups."""
    sweeps = leveled(True, windows=windows, dtype=dtype)
    sweeps.groups["speed"] = sweeps.groups["recording"] % 2
    check_sessions(level_check.warnings_of(sweeps))


def test_axes_are_taxels_and_many_values_are_drawn():
    """A level of the second axis is reported; MOST_VALUES of a group, first to last."""
    sweeps = leveled(True)
    still = np.zeros_like(sweeps.samples)
    samples = np.stack([still, sweeps.samples, still], axis=-1)
    check_sessions(level_check.warnings_of(replace(sweeps, samples=samples)))
    sweeps = leveled(True, each=3, sessions=30)
    answers, possible = level_check._within(sweeps, sweeps.groups["session"])
    tested = np.unique(sweeps.groups["session"][answers != level_check.UNTESTED])
    assert len(tested) == level_check.MOST_VALUES
    assert (tested[0], tested[-1]) == (0, 29)
    assert possible.any(axis=1).sum() == 12 * level_check.MOST_VALUES


def test_levels_are_blamed_on_a_session_only_if_it_sets_them():
    """Everywhere: one line with the count; 75 % across sessions: no line."""
    sweeps = leveled(False)
    sweeps.groups["speed"] = sweeps.groups["recording"] % 2
    (line,) = level_check.warnings_of(sweeps)
    assert "96 of 96" in line
    drawn = np.random.default_rng(2).uniform(0, 400, len(sweeps))
    assert level_check.warnings_of(with_levels(sweeps, drawn)) == []
    sweeps = leveled(False)
    moved = 100 * sweeps.labels + 75 * (sweeps.groups["session"] == 2)
    assert not any(map(SESSIONS.fullmatch, level_check.warnings_of(with_levels(sweeps, moved))))


def test_sets_of_one_session_have_a_line_of_their_own():
    """Also of one material each; no level, no line."""
    one = leveled(False, sessions=1)
    bare = replace(one, groups={})
    apart = replace(one, groups={"session": one.labels})
    for sweeps, why in ((one, "in one session"), (bare, "in one session"), (apart, "no group")):
        (line,) = level_check.warnings_of(sweeps)
        assert why in line
        assert line.endswith("(32 of 32, chance 25 %)")
    drawn = np.random.default_rng(2).uniform(0, 400, len(one))
    assert level_check.warnings_of(with_levels(one, drawn)) == []


def test_recordings_stay_whole_and_chance_is_the_sessions():
    """Levels of their own reveal windows; of two materials a session chance is 50 %."""
    sweeps = leveled(False, windows=6, sessions=1)
    own = np.random.default_rng(3).uniform(0, 400, (32, 1, 6, 6))[sweeps.groups["recording"]]
    noise = np.random.default_rng(4).normal(0, 4, (len(own), 6, 6, 6))
    mixed = replace(sweeps, samples=(own + noise).astype(np.int16))
    assert level_check.warnings_of(mixed) == []
    assert "one session" in level_check.warnings_of(replace(mixed, groups={}))[0]
    whole = leveled(True, each=12, sessions=6)
    sweeps = whole.take((whole.labels - whole.groups["session"]) % 2 == 0)
    rank, turn = sweeps.labels // 2, sweeps.groups["session"] // 2
    (line,) = level_check.warnings_of(with_levels(sweeps, 100 * rank))
    assert "144 of 144" in line
    (line,) = level_check.warnings_of(with_levels(sweeps, 100 * ((rank + turn) % 2)))
    assert " 100 % of" in line
    assert "(chance 50 %)" in line


def constant(sweeps: Dataset) -> Dataset:
    """All raw counts are 7."""
    return replace(sweeps, samples=np.full_like(sweeps.samples, 7))


def mixed_recordings(sweeps: Dataset) -> Dataset:
    """All materials in each recording."""
    return replace(sweeps, groups=sweeps.groups | {"recording": np.arange(len(sweeps)) % 8})


def first(sweeps: Dataset, materials: int, each: int) -> Dataset:
    """The first `each` sweeps of the first `materials` in each session."""
    return sweeps.take((sweeps.groups["recording"] % 8 < each) & (sweeps.labels < materials))


@pytest.mark.parametrize("sessions", [1, 2, 3])
@pytest.mark.parametrize(
    "odd",
    [
        constant,
        mixed_recordings,
        lambda s: first(s, 4, 1),
        lambda s: first(s, 2, 1),
        lambda s: first(s, 2, 2),
        lambda s: first(s, 1, 8),
        lambda s: s.take(np.arange(1)),
    ],
)
def test_small_and_odd_sets_have_no_line(odd, sessions: int):
    """Constant taxels, one sweep of each, one or two materials: no line, error or warning."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert level_check.warnings_of(odd(leveled(True, sessions=sessions))) == []


def test_odd_counts_are_scaled():
    """Equal sweeps on many taxels, 1e30 and a constant taxel: finite, the usual line."""
    sweeps = leveled(True)
    equal = replace(sweeps, samples=np.tile((sweeps.samples + 50) // 100 * 100, (1, 1, 8, 8)))
    assert len(np.unique(equal.samples)) == len(MATERIALS)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_sessions(level_check.warnings_of(equal))
    sweeps = leveled(True, dtype="float32")
    sweeps.samples[...] *= np.float32(1e30)
    sweeps.samples[..., 0, 0] = 3
    check_sessions(level_check.warnings_of(sweeps))
    levels = level_check.levels_of(sweeps).samples
    assert levels.shape == (len(sweeps), 1, 3, 1)
    np.testing.assert_allclose(levels.std(axis=0), 1, rtol=1e-3)


@pytest.mark.slow
def test_large_sets_are_drawn_evenly():
    """About MOST_SWEEPS of many, of each material alike, and MOST_TAXELS of the taxels."""
    sweeps = leveled(True, each=200)
    turns = sweeps.take(np.argsort(sweeps.groups["recording"] % 200, kind="stable"))
    wide = replace(turns, samples=np.tile(turns.samples, (1, 1, 10, 10)))
    levels = level_check.levels_of(wide)
    assert np.bincount(levels.labels).tolist() == [level_check.MOST_SWEEPS // 4] * 4
    assert levels.samples.shape[2] == level_check.MOST_TAXELS
    check_sessions(level_check.warnings_of(turns))


@pytest.mark.slow
def test_the_commands_print_the_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """`sets describe` below the set; others warn, of what --only keeps."""
    file = tmp_path / "set.npz"
    leveled(True).save(file)
    for session, material, i in np.ndindex(3, 4, 8):
        number = 100 * ((material + session) % 4) + 8 * session + i
        path = tmp_path / "folder" / f"{number}.npy"
        record(path, MATERIALS[material], id=number, session=str(session))
    assert main(["sets", "describe", str(file), str(tmp_path / "folder")]) == 0
    described = capsys.readouterr().out.splitlines()
    assert len([line for line in described if SESSIONS.fullmatch(line.strip())]) == 2
    words = ["fit", "--seed", "1", "--set", str(file), "--out", str(tmp_path / "fit.npz")]
    options.load(PROGRAM.parser("fit").parse_args(words))
    check_sessions([capsys.readouterr().err.removeprefix("palpate-train: ").strip()])
    options.load(PROGRAM.parser("fit").parse_args([*words, "--only", "session=1"]))
    (alone,) = capsys.readouterr().err.splitlines()
    assert alone.startswith("palpate-train: warning: ")
    assert "32 of 32" in alone
