"""Progress of long work: share done and time left, as a line and as numbers."""

import pytest

from palpate_train.data.progress import Progress, ProgressLine, StepTimes, spoken


class SteppedClock:
    """A clock that the test sets, in seconds."""

    now = 0.0

    def __call__(self) -> float:
        """Now."""
        return self.now


def test_progress_shows_how_much_is_left():
    """Of all tasks, with the time; one counts when the next begins."""
    lines: list[str] = []
    clock = SteppedClock()
    progress = Progress(4, lines.append, clock)
    for what in ("a", "b"):
        clock.now += 30
        progress(what)
    assert lines == ["1/4 done, 90 s left (a)", "2/4 done, 60 s left (b)"]
    assert progress.done == 2
    assert isinstance(lines[1], ProgressLine)
    assert (lines[1].done, lines[1].total) == (2, 4)
    lines: list[str] = []
    clock = SteppedClock()
    progress = Progress(3, lines.append, clock)
    progress.begin("a")
    clock.now += 120
    progress.begin("b")
    assert lines == ["0/3 done (a)", "1/3 done, 4 min left (b)"]


def test_steps_of_unequal_length_tell_the_time_left():
    """By their shares, of the steps that there are."""
    told: list[tuple[str, float, float | None]] = []
    clock = SteppedClock()
    steps = StepTimes({"a": 0.1, "b": 0.3}, lambda *one: told.append(one), clock)
    steps.begin("a")
    clock.now += 10
    steps.begin("b")
    assert told == [("a", 0, None), ("b", pytest.approx(0.25), pytest.approx(30))]


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0, "0 s"),
        (99, "99 s"),
        (100, "2 min"),
        (5999, "100 min"),
        (6000, "1.7 h"),
        (36000, "10.0 h"),
    ],
)
def test_a_duration_is_said_in_the_unit_that_suits_it(seconds: float, text: str):
    """Seconds, minutes, hours."""
    assert spoken(seconds) == text
