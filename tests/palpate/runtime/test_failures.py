"""A model, an observer or a command that fails: each sweep is answered."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace

import numpy as np
import pytest

from palpate.bundle import bundle
from palpate.client.answers import Answer
from palpate.core import config
from palpate.core.errors import LineError, ModelError
from palpate.core.observer import Health, Observer
from palpate.core.types import Status, Sweep, Verdict
from palpate.inference import session
from palpate.runtime import assembly
from palpate.runtime.loop import FAILURES, SOUND
from tests.factories.paths import NO_SITE
from tests.factories.simulated_box import SECOND, SETTLE_S, Rigged, tubes

Make = Callable[..., Rigged]
BAD_ALLOC = RuntimeError("std::bad_alloc")


def heard(box: Rigged) -> list[tuple[int, str]]:
    """Number and status of each answer that the robot has read."""
    box.listen(SETTLE_S)
    return [(a.sweep, a.status) for a in map(Answer.read, box.heard) if a]


class FailingModel:
    """Stands before an answerer; fails on the sweeps with these numbers."""

    def __init__(self, answerer: object, on: Callable[[int], bool], error: Exception) -> None:
        self._answerer, self._on, self._error = answerer, on, error

    def __getattr__(self, name: str) -> object:
        return getattr(self._answerer, name)

    def __call__(self, sweep: Sweep) -> Verdict:
        if sweep.status is Status.OK and self._on(sweep.id):
            raise self._error
        return self._answerer(sweep)


def fail(box: Rigged, on: Callable[[int], bool], error: Exception = BAD_ALLOC) -> None:
    """Make the model of a box fail on these sweeps."""
    box.box._answerer = FailingModel(box.box._answerer, on, error)


@pytest.mark.parametrize("error", [BAD_ALLOC, MemoryError(), ModelError("Gather: index 7")])
def test_a_sweep_on_which_the_model_fails_is_answered(rigged, error):
    """Its status is `failed`, its detail the reason, and the sweeps after it are answered."""
    simulated = tubes(1, 2)
    box = rigged(simulated)
    fail(box, {1}.__contains__, error)
    verdicts = box.until(lambda: simulated.finished(box.box.answered))
    assert [v.status for v in verdicts].count(Status.FAILED) == 1
    assert heard(box)[0] == (1, "failed")
    assert (verdicts[0].detail, verdicts[0].label) == (str(error) or "MemoryError", "")


@pytest.mark.parametrize(("took_ms", "after"), [(2, {1, 2}), (20, set())])
def test_quick_answers_are_rehearsed_while_a_sweep_may_end(rigged, took_ms, after):
    """From the second sweep on, a few times; a rehearsal that fails changes no answer. A slow model
    would cost frames."""

    class Rehearsing(FailingModel):
        """Notes how many sweeps were answered at each rehearsal, which fails."""

        def __init__(self, box: Rigged, took_ns: int) -> None:
            super().__init__(box.box._answerer, lambda sweep: False, BAD_ALLOC)
            self._box, self._took_ns, self.after = box.box, took_ns, []
            box.box._answerer = self

        def __call__(self, sweep: Sweep) -> Verdict:
            return replace(self._answerer(sweep), latency_ns=self._took_ns)

        def rehearse(self) -> None:
            self._answerer.rehearse()
            assert self._box._cutter.sweeping
            self.after.append(self._box.answered)
            raise self._error

    plain, other = tubes(1, 3), tubes(1, 3)
    box = rigged(plain)
    want = box.until(lambda: plain.finished(box.box.answered))
    box = rigged(other)
    rehearsing = Rehearsing(box, took_ms * 1_000_000)
    verdicts = box.until(lambda: other.finished(box.box.answered))
    assert [(v.status, v.label, v.scores.tolist()) for v in verdicts] == [
        (v.status, v.label, v.scores.tolist()) for v in want
    ]
    assert set(rehearsing.after) == after
    assert len(rehearsing.after) <= 60


def test_repeated_failures_end_the_program_once_all_are_answered(rigged):
    """After the third failed sweep the program ends with exit code 70, which the unit restarts."""
    box = rigged(tubes(1, 5))
    fail(box, lambda number: True)
    with pytest.raises(ModelError, match=r"3 .*bad_alloc") as e:
        box.box.run(lambda: False)
    assert e.value.exit_code == 70
    assert heard(box) == [(1, "failed"), (2, "failed"), (3, "failed")]


def test_failures_far_apart_do_not_end_it(default_bundle):
    """A failure counts until SOUND sweeps were classified after it."""

    def run_of(failures: np.ndarray, model: bundle.Bundle) -> int | None:
        """The number of the sweep that ends a box whose model fails on these, None if none does."""
        box = assembly.box(config.load(None, site=NO_SITE), model, tubes(1, 1), None, ExitStack())
        verdict = Verdict(1, 0, Status.OK, "wood", 1, 1, np.ones(1), 1, 0, 0, "")

        def answer(sweep: Sweep) -> Verdict:
            if failures[sweep.id - 1]:
                raise BAD_ALLOC
            return verdict

        answer.model = ""
        box._answerer = answer
        for number in range(1, len(failures) + 1):
            box._classified(Sweep(number, 0, 0, Status.OK, np.empty(0)))
            if box._failures >= FAILURES:
                return number
        return None

    numbers = np.arange(1, 100)
    assert run_of(numbers % (SOUND + 1) == 0, default_bundle) is None
    assert run_of(numbers % SOUND == 0, default_bundle) == SOUND * FAILURES


def test_early_heads_that_fail_leave_the_whole_sweep(rigged, logged):
    """An error of the early heads is logged once, and the whole window is answered."""
    simulated = tubes(1, 2)
    box = rigged(simulated, sets=("classifier.early=true",))

    class Failing:
        steps = box.box._early.steps

        def __call__(self, sweep: Sweep) -> Verdict:
            raise BAD_ALLOC

    box.box._early = Failing()
    verdicts = box.until(lambda: simulated.finished(box.box.answered))
    assert all(v.status is not Status.FAILED and v.share == 1 for v in verdicts)
    assert sum("answers" in line for line in logged) == 1


def test_a_fault_in_an_observer_costs_nothing_else(rigged, logged):
    """It is logged, the sweeps are answered, and the other observers are called."""

    class Breaking(Observer):
        """An observer that raises in each of its methods."""

        def __init__(self, error: Exception) -> None:
            self._error = error

        def turn(self, health: Health) -> None:
            raise self._error

        def answered(self, verdict: Verdict) -> None:
            raise self._error

        def sweep(self, sweep: Sweep, verdict: Verdict, circumstances: object) -> None:
            raise self._error

    simulated = tubes(1, 3)
    box = rigged(simulated, observers=[Breaking(KeyError("none of these"))])
    box.until(lambda: simulated.finished(box.box.answered))
    assert [number for number, _ in heard(box)] == [1, 2, 3]
    assert len(box.kept) == 3
    assert any("KeyError" in line for line in logged)


def test_a_failed_output_ends_the_program_and_the_open_sweep_is_answered(rigged):
    """An error of the GPIO lines is a fault that the robot must see: the program ends with 69."""
    simulated = tubes(1, 3)
    box = rigged(simulated)
    box.until(lambda: box.box.health.sweeping)

    def show(**levels: bool) -> None:
        raise LineError("chip is gone")

    box.box._lines.show = show
    with pytest.raises(LineError):
        box.box.run(lambda: False)
    assert heard(box) == [(1, "aborted")]


@pytest.mark.parametrize("error", [RuntimeError("no"), SystemExit(3), KeyboardInterrupt()])
def test_any_end_answers_the_open_sweep(rigged, error):
    """Whatever ends the loop, the open sweep is answered `aborted`."""
    simulated = tubes(1, 1)
    box = rigged(simulated)
    end_ns = simulated.clock.now_ns() + 2 * SECOND

    def stopped() -> bool:
        if simulated.clock.now_ns() > end_ns:
            raise error
        return False

    with pytest.raises(type(error)):
        box.box.run(stopped)
    assert heard(box) == [(1, "aborted")]


def test_a_command_that_fails_is_answered(rigged, monkeypatch):
    """An unexpected error of a command becomes its answer."""
    box = rigged()
    box.seconds(1)
    monkeypatch.setattr(session, "run", lambda *given: (_ for _ in ()).throw(BAD_ALLOC))
    assert ",TEST,error,std::bad_alloc" in box.ask("$PPLP,TEST")
    assert ",ID,ok," in box.ask("$PPLP,ID")


@pytest.mark.parametrize(
    ("why", "code"), [("std::bad_alloc", 70), ("Failed to allocate memory", 70), ("no op X", 78)]
)
def test_memory_that_is_short_is_no_fault_of_the_bundle(monkeypatch, why, code):
    """std::bad_alloc is restarted; a refused model is not."""

    def refuse(*given: object, **more: object) -> None:
        raise RuntimeError(why)

    monkeypatch.setattr(session.ort, "InferenceSession", refuse)
    with pytest.raises(Exception, match=why) as e:
        session.session(b"")
    assert e.value.exit_code == code
