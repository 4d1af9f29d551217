"""Runs many tasks in parallel with joblib, and yields each result as its task finishes."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

from joblib import Parallel, delayed
from threadpoolctl import threadpool_limits

from palpate_train.data.progress import Progress as Progress  # tasks use it to show progress

Task = TypeVar("Task")
Result = TypeVar("Result")


def results(
    call: Callable[..., Result],
    tasks: Sequence[Task],
    shared: Sequence[Any],
    jobs: int = -1,
) -> Iterator[tuple[Task, Result]]:
    """The result of call(task, *shared) for every task, as they finish; each has one thread.

    jobs: processes, -1 for one on each core. An error of a task is raised here.
    """
    if tasks:
        # joblib replaces a process whose memory has grown and warns; no task is lost by that
        warnings.filterwarnings(
            "ignore", "A worker stopped while some jobs were given", UserWarning
        )
        yield from Parallel(jobs, return_as="generator_unordered", batch_size=1)(
            delayed(_run)(task, call, *shared) for task in tasks
        )


def _run(task: Task, call: Callable[..., Result], *shared: Any) -> tuple[Task, Result]:
    with threadpool_limits(1):  # sums in the same order everywhere, and no competition for cores
        return task, call(task, *shared)
