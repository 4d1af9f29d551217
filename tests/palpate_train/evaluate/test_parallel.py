"""Parallel tasks: each once, in one thread, with its errors."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import threadpoolctl

from palpate_train.evaluate import parallel

pytestmark = pytest.mark.slow


def add(task: int, data: np.ndarray) -> float:
    """A task."""
    return float(data[task] + data.sum())


def threads(task: int) -> int:
    """The number of threads that a linear algebra library may use."""
    return max(entry["num_threads"] for entry in threadpoolctl.threadpool_info())


def test_every_task_is_done_once_with_its_data():
    """With two processes, each result comes with its task."""
    data = np.arange(50.0)
    done = dict(parallel.results(add, range(20), [data], jobs=2))
    assert done == {task: task + 1225.0 for task in range(20)}
    assert not list(parallel.results(add, [], [data]))


def test_a_process_that_is_replaced_is_not_spoken_of():
    """joblib warns when it replaces a process whose memory has grown. No task is lost by that, so
    the warning is hidden; other warnings are shown."""
    with warnings.catch_warnings(record=True) as shown:
        warnings.simplefilter("always")
        assert len(list(parallel.results(add, range(3), [np.arange(3.0)], jobs=1))) == 3
        warnings.warn(
            "A worker stopped while some jobs were given to the executor.",
            UserWarning,
            stacklevel=1,
        )
        warnings.warn("another", UserWarning, stacklevel=1)
    assert [str(one.message) for one in shown] == ["another"]


def test_each_task_has_one_thread():
    """Linear algebra has one thread, in this process and in others."""
    for jobs in (1, 2):
        assert {n for _, n in parallel.results(threads, [0], [], jobs=jobs)} == {1}


def test_an_error_in_a_task_is_the_callers():
    """The error of a task is raised here."""
    with pytest.raises(IndexError):
        list(parallel.results(add, [99], [np.arange(3.0)], jobs=2))
