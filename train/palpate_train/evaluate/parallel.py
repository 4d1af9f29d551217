"""Runs many tasks in parallel and yields each result as its task finishes.

joblib runs them on this machine. With the address of a Dask scheduler, its workers run them: the
data is first copied to every worker, so that a worker that dies loses only its current task, which
another worker computes again.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from typing import Any, TypeVar

from joblib import Parallel, delayed
from threadpoolctl import threadpool_limits

from palpate.core.errors import FormatError
from palpate_train.data import extras
from palpate_train.data.progress import Progress as Progress  # tasks use it to show progress

Task = TypeVar("Task")
Result = TypeVar("Result")
CONNECT_S = 10
"""Seconds that a scheduler may take to answer, and its first worker to appear."""


def results(
    call: Callable[..., Result],
    tasks: Sequence[Task],
    shared: Sequence[Any],
    jobs: int = -1,
    scheduler: str = "",
) -> Iterator[tuple[Task, Result]]:
    """The result of call(task, *shared) for every task, as they finish; each has one thread.

    jobs: processes on this machine, -1 for one on each core. scheduler: address of a Dask
    scheduler, whose workers then run all tasks. An error of a task is raised here. Raises
    FormatError if no scheduler or no worker answers, if workers died so often that a task is
    abandoned, or if they lack this project.
    """
    if scheduler and tasks:
        yield from _on_cluster(call, tasks, shared, scheduler)
    elif tasks:
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


def _on_cluster(
    call: Callable[..., Result], tasks: Sequence[Task], shared: Sequence[Any], scheduler: str
) -> Iterator[tuple[Task, Result]]:
    with extras.needed_for("--scheduler"):
        # not through joblib: its Dask backend waits for ever if a task cannot run any more
        from distributed import Client, KilledWorker
    try:
        client: Any = Client(scheduler, timeout=CONNECT_S)  # type: ignore[no-untyped-call]
    except (OSError, ValueError) as e:
        raise FormatError(
            f"no scheduler answers at {scheduler!r} ({e}); start one with: dask scheduler"
        ) from e
    with client:
        try:
            client.wait_for_workers(1, timeout=CONNECT_S)
            everywhere = client.scatter(list(shared), broadcast=True) if shared else ()
            yield from _finished(
                client, {client.submit(_run, task, call, *everywhere, pure=False) for task in tasks}
            )
        except TimeoutError as e:
            start = f"dask worker {scheduler}"
            raise FormatError(
                f"the scheduler at {scheduler!r} has no worker; start some with: {start}"
            ) from e
        except RuntimeError as e:
            if "deserialization" not in str(e):
                raise
            raise FormatError(
                f"the cluster at {scheduler!r} lacks this version of palpate-train; "
                "install it there"
            ) from e
        except KilledWorker as e:
            raise FormatError(
                f"the workers at {scheduler!r} died too often ({e}); see their logs and memory"
            ) from e


def _finished(client: Any, left: set[Any]) -> Iterator[Any]:
    """The results of the futures `left` as they finish. Raises TimeoutError if no worker is left.

    Nothing else may refer to the futures: a finished future that is not released runs again if its
    worker dies.
    """
    from distributed import wait

    while left:
        with suppress(TimeoutError):  # wait in turns, so that a cluster without workers is noticed
            done = wait(  # type: ignore[no-untyped-call]
                left, timeout=CONNECT_S, return_when="FIRST_COMPLETED"
            ).done
            yield from (future.result() for future in done)
            left -= done
        if left and not client.nthreads():
            raise TimeoutError
