"""The simulator's calibration (`palpate_studies.sim_calibration`): printed and measured numbers."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from palpate.sim.skin import EFFECTS, LEVEL_BLIND, WORLD, World
from palpate_studies import sim_calibration
from palpate_studies.sim_calibration import FIGURES, HARD, LAB, METHODS, REAL

SEED, EACH = 1001, 2
EVERYTHING_ELSE = frozenset(EFFECTS) - {"position", "attachment"}


@pytest.fixture(scope="module")
def measured() -> dict:
    """A measurement of one seed with few sweeps and folds, with and without each effect."""
    with pytest.MonkeyPatch.context() as patch:
        few = {4: "random:2", 6: "random:3"}
        patch.setattr(
            sim_calibration,
            "FIGURES",
            tuple(replace(f, protocol=few.get(f.number, f.protocol)) for f in FIGURES),
        )
        return sim_calibration.measure([SEED], True, jobs=1, per_material=EACH)


def test_the_printed_numbers_are_the_papers() -> None:
    """Figs. 4 to 7, method by method: L Gauss, L kNN, L SVM, H kNN, H SVM."""
    assert METHODS == ("L-gauss", "L-knn", "L-svm", "H-knn", "H-svm")
    assert {f.number: f.printed for f in FIGURES} == {
        4: (0.85, 0.82, 0.85, 0.90, 0.96),
        5: (0.78, 0.77, 0.79, 0.75, 0.86),
        6: (0.80, 0.80, 0.83, 0.85, 0.93),
        7: (0.57, 0.58, 0.55, 0.50, 0.70),
    }


def test_each_figure_is_measured_on_its_own_sets() -> None:
    """T-LAB has one attachment, T-REAL nine, T-HARD several. Fig. 7 is tested on all of T-HARD
    alone.
    """
    sweeps = sim_calibration.draw(SEED, per_material=EACH)
    positions = [
        sweeps.group("position")[np.isin(sweeps.group("set"), kind)] for kind in (LAB, REAL, HARD)
    ]
    assert [len(np.unique(p)) for p in positions] == [1, 9, sim_calibration.ATTACHMENTS]
    assert len(np.unique(sweeps.group("position"))) == 10 + sim_calibration.ATTACHMENTS
    assert [f.sets for f in FIGURES] == [(LAB,), (REAL,), (REAL,), (REAL, *HARD)]
    part = sweeps.take(sweeps.group("set") != LAB)
    ((train, test),) = sim_calibration.Protocol(FIGURES[3].protocol).folds(part, 0)
    assert set(part.group("set")[train]) == {REAL}
    assert np.array_equal(test, np.flatnonzero(np.isin(part.group("set"), HARD)))


def test_the_far_attachments_are_a_row_off() -> None:
    """In the level-blind world the leading row has nearly no load in T-HARD, and some in the other
    sets. All attachments differ.
    """
    sweeps = sim_calibration.draw(SEED, LEVEL_BLIND, per_material=1)
    load = sweeps.samples[:, :, 3].mean((1, 2))
    hard = np.isin(sweeps.group("set"), HARD)
    assert (load[hard] < 1).all()
    assert (load[~hard] > 2).all()
    seconds = [
        sim_calibration.draw(seed, World(off=EVERYTHING_ELSE), 1) for seed in (SEED, SEED + 1)
    ]
    loads = np.concatenate(
        [s.samples[np.isin(s.group("set"), HARD) & (s.labels == 0), 0] for s in seconds]
    )
    assert len(np.unique(loads, axis=0)) == 2 * sim_calibration.ATTACHMENTS


def test_a_world_is_the_same_for_all_who_draw_it_and_others_differ() -> None:
    """The same seed gives the same sweeps. A changed world changes them and keeps labels and
    positions.
    """
    one, same, other = (
        sim_calibration.draw(SEED, w, 1) for w in (WORLD, WORLD, World(off=frozenset({"texture"})))
    )
    assert np.array_equal(one.samples, same.samples)
    assert not np.array_equal(one.samples, other.samples)
    assert np.array_equal(one.labels, other.labels)


@pytest.mark.slow
@pytest.mark.thorough  # measures the whole simulator
def test_what_is_measured_is_complete_and_adds_up(measured: dict) -> None:
    """Accuracies of four figures by five methods, and the differences to the printed ones, with the
    largest and the mean. All of it is valid JSON.
    """
    assert json.loads(json.dumps(measured)) == measured
    printed, ours, away = (np.array(measured[k]) for k in ("printed", "ours", "difference"))
    assert printed.shape == ours.shape == away.shape == np.array(measured["spread"]).shape == (4, 5)
    assert (ours[1:] > 0.3).all()  # still better than chance
    assert (ours <= 1).all()
    assert away == pytest.approx(ours - printed)
    assert measured["largest"] == pytest.approx(abs(away).max())
    assert measured["mean"] == pytest.approx(abs(away).mean())


@pytest.mark.slow
def test_every_effect_is_switched_off_in_turn(measured: dict) -> None:
    """Each row has the accuracies without an effect and their change. Each effect changes some of
    them.
    """
    assert tuple(measured["without"]) == EFFECTS
    for row in measured["without"].values():
        assert row["change"] == pytest.approx(np.array(row["ours"]) - measured["ours"])
        assert np.any(row["change"])


@pytest.mark.slow
def test_accuracies_count_right_answers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Sweeps whose features equal their label are all correct. With shifted test labels none is."""
    monkeypatch.setattr(sim_calibration, "FIGURES", FIGURES[3:])
    monkeypatch.setattr(sim_calibration, "PRINTED", sim_calibration.PRINTED[3:])
    sweeps = sim_calibration.draw(SEED, per_material=4)
    rng = np.random.default_rng(0)

    def inputs(kind: str, of: sim_calibration.sets.SweepSet) -> np.ndarray:
        return of.labels[:, None] + rng.normal(0, 0.01, (len(of), 3))

    monkeypatch.setattr(sim_calibration.methods, "model_inputs", inputs)
    assert (sim_calibration.accuracies(sweeps, SEED) == 1).all()
    labels = np.where(np.isin(sweeps.group("set"), HARD), (sweeps.labels + 1) % 6, sweeps.labels)
    monkeypatch.setattr(
        sim_calibration.methods, "model_inputs", lambda kind, of: inputs(kind, sweeps)
    )
    assert (sim_calibration.accuracies(replace(sweeps, labels=labels), SEED) == 0).all()


@pytest.mark.slow
def test_the_table_shows_every_number(measured: dict) -> None:
    """A row for each figure and each effect, with each number beside the printed number."""
    text = sim_calibration.table(measured)
    lines = text.splitlines()
    for figure, name in enumerate(measured["figures"]):
        (row,) = [line for line in lines if line.startswith(name) and "±" in line]
        for printed, ours in zip(
            measured["printed"][figure], measured["ours"][figure], strict=True
        ):
            assert f"{printed:.2f} {ours:.3f}±".replace("0.", ".") in row
    assert [line.split()[0] for line in lines[-len(EFFECTS) :]] == list(EFFECTS)
    assert f"mean {measured['mean']:.3f}".replace("0.", ".") in text


def test_without_ablation_nothing_is_switched_off() -> None:
    """`measure` computes only the requested numbers, and logs its progress."""
    lines: list[str] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            sim_calibration,
            "accuracies",
            lambda sweeps, seed: sim_calibration.PRINTED + seed - SEED,
        )
        result = sim_calibration.measure(
            [SEED, SEED + 2], False, lines.append, jobs=1, per_material=1
        )
    assert not result["without"]
    assert len(lines) == 2
    assert np.allclose(result["difference"], 1)
    assert np.allclose(result["spread"], 1)
    assert result["seeds"] == [SEED, SEED + 2]
