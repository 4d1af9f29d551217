"""Parallel tasks here and on a real Dask cluster of two workers, which may die."""

from __future__ import annotations

import contextlib
import importlib
import os
import re
import signal
import subprocess
import sys
import time
import warnings
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import threadpoolctl

from palpate.core.errors import FormatError
from palpate_train.evaluate import evaluate, parallel
from palpate_train.evaluate.evaluate import Plan, Where
from palpate_train.models import methods
from tests.factories.later import Later
from tests.factories.sweep_sets import tones

distributed = Later("distributed")

pytestmark = pytest.mark.slow


def add(task: int, data: np.ndarray) -> float:
    """A task."""
    return float(data[task] + data.sum())


def test_every_task_is_done_once_in_one_thread():
    """Each result comes with its task, and an error is raised here."""

    def threads(task: int) -> int:
        """The number of threads that a linear algebra library may use."""
        return max(entry["num_threads"] for entry in threadpoolctl.threadpool_info())

    data = np.arange(50.0)
    done = dict(parallel.results(add, range(20), [data], jobs=2))
    assert done == {task: task + 1225.0 for task in range(20)}
    assert not list(parallel.results(add, [], [data]))
    for jobs in (1, 2):
        assert {n for _, n in parallel.results(threads, [0], [], jobs=jobs)} == {1}
    with pytest.raises(IndexError):
        list(parallel.results(add, [99], [np.arange(3.0)], jobs=2))


def test_a_process_that_is_replaced_is_not_spoken_of():
    """joblib loses no task by that, so its warning is hidden; others are shown."""
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


@pytest.fixture(scope="module")
def cluster() -> Iterator[tuple[str, list[subprocess.Popen[str]]]]:
    """A scheduler and two workers without nannies, so that a dead worker stays dead."""
    command, env = (
        (sys.executable, "-m", "dask"),
        os.environ | {"PYTHONPATH": str(Path(__file__).parent)},
    )
    scheduler = subprocess.Popen(
        (*command, "scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard"),
        stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        text=True,
        env=env,
    )
    processes = [scheduler]
    try:
        for line in scheduler.stderr:
            if found := re.search(r"tcp://127\.0\.0\.1:\d+", line):
                break
        address = found[0]
        for _ in range(2):
            options = ("--no-nanny", "--nthreads", "1", "--host", "127.0.0.1", "--no-dashboard")
            processes.append(
                subprocess.Popen(
                    (*command, "worker", address, *options),
                    stderr=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    text=True,
                    env=env,
                )
            )
        with distributed.Client(address, timeout=20, set_as_default=False) as client:
            client.wait_for_workers(2, timeout=30)
        yield address, processes[1:]
    finally:
        for process in processes:
            process.kill()
            process.wait()


@pytest.mark.thorough  # a Dask cluster of two processes
def test_a_cluster_gives_the_same_bits(cluster):
    """Logits here and on the cluster are equal, for an SVM on features and for a network."""
    plan = Plan(("L-svm", "recurrent"), ("leave:session",), effort=methods.Effort(0.02))
    there, here = (
        {result.method: result for result in evaluate.evaluate(tones(), plan, where)}
        for where in (Where(scheduler=cluster[0], cache=None), Where(jobs=1, cache=None))
    )
    for name in plan.methods:
        assert np.array_equal(there[name].logits, here[name].logits), name
        assert there[name].json()["window"] == here[name].json()["window"]


@pytest.mark.thorough  # a Dask cluster of two processes
def test_a_worker_that_dies_costs_only_what_it_was_running(cluster, tmp_path: Path):
    """One of two is killed during twenty tasks: only its task runs twice."""

    def noted(task: int, folder: str, data: np.ndarray) -> float:
        """A task that leaves a note for each run. The first run of task 7 kills its worker."""
        if task == 7:
            with contextlib.suppress(FileExistsError):
                Path(folder, "killed").touch(exist_ok=False)
                os.kill(os.getpid(), signal.SIGKILL)
        time.sleep(0.25)
        Path(folder, f"{task}-{os.getpid()}").touch()
        return float(data[task])

    address, workers = cluster
    data = np.arange(20.0)
    done = dict(parallel.results(noted, range(20), [str(tmp_path), data], scheduler=address))
    assert done == {task: float(task) for task in range(20)}
    assert sum(w.poll() is not None for w in workers) == 1
    times = Counter(note.name.split("-")[0] for note in tmp_path.glob("*-*"))
    assert set(times) == {str(task) for task in range(20)}
    assert sum(times.values()) <= 21  # at most the result that was on its way when its worker died


@pytest.mark.thorough  # a Dask cluster of two processes
def test_an_error_on_a_worker_is_the_callers(cluster):
    """The error of a task on the cluster is raised here."""
    with pytest.raises(IndexError):
        list(parallel.results(add, [99], [np.arange(3.0)], scheduler=cluster[0]))


@pytest.mark.thorough  # a Dask cluster of two processes
def test_a_cluster_without_the_project_is_named(
    cluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Workers without this version of the project are reported."""
    (tmp_path / "only_here.py").write_text("def call(task):\n    return task\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(FormatError, match="version"):
        list(
            parallel.results(
                importlib.import_module("only_here").call, [1], [], scheduler=cluster[0]
            )
        )


@pytest.mark.thorough  # a Dask cluster of two processes
def test_a_task_that_kills_every_worker_ends_with_a_reason(
    cluster, monkeypatch: pytest.MonkeyPatch
):
    """The call ends if no worker is left."""

    def always_dies(task: int) -> None:
        """A task that kills its worker."""
        os.kill(os.getpid(), signal.SIGKILL)

    monkeypatch.setattr(parallel, "CONNECT_S", 1)
    with pytest.raises(FormatError, match=r"often|worker"):
        list(parallel.results(always_dies, [1], [], scheduler=cluster[0]))


def test_a_cluster_that_does_not_answer_is_named(monkeypatch: pytest.MonkeyPatch):
    """The command that starts a scheduler is named within the deadline."""
    monkeypatch.setattr(parallel, "CONNECT_S", 1)
    with pytest.raises(FormatError, match="scheduler"):
        list(parallel.results(add, [1], [np.arange(3.0)], scheduler="tcp://127.0.0.1:9"))


def test_without_dask_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch):
    """The message names the extra to install."""
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(FormatError, match=r"palpate-train\[dask\]"):
        list(parallel.results(add, [1], [np.arange(3.0)], scheduler="tcp://127.0.0.1:9"))
