"""The campaign of fuzzed models and enrolments. Our own models, changed at random, go through the
box's check, the trial in its sandbox, and a run; fuzzed enrolments beside the default bundle go
through their check and the classifier.

`python -m tests.campaigns.hostile_fuzz --count 10000 --seed 1 --out FILE.json` (run it with `nice`;
it continues an interrupted campaign). Each model is opened in a child with a limit of 256 MB more
memory and a minute, after its trial. The result is the number of models that hung the child, killed
it, or exceeded the memory. Seed and number identify a model.
"""

import argparse
import json
import os
import resource
import select
import signal
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from palpate.bundle import bundle
from palpate.bundle.bundle import Bundle
from palpate.bundle.onnx_check import check
from palpate.core import storage
from palpate.core.clock import SystemClock
from palpate.core.errors import BundleError
from palpate.core.types import Frames, Status, Sweep
from palpate.deployment.sandbox import run_limited
from palpate.inference.classifier import Classifier
from palpate.inference.session import MOST_S, session
from palpate_train.metrics.score import provenance
from tests.fuzz import mutated_enrolments
from tests.fuzz.mutated_models import Own, mutated, own_models

DEADLINE_S = 60.0
MOST_MORE = 256 << 20
"""Additional memory that a child may take, in bytes."""
BATCH = 50
"""Models that a child tries one after another: a fork for each would take longer than the model."""
ENROLLED = 0.1
"""Share of enrolments."""
ENROLLING = Own("enrolment", b"", bundle.load(bundle.DEFAULT).manifest)
"""Stands for the default bundle with an enrolment; its bytes are replaced by those of the
enrolment."""
SORRY = ("refused", "trial refused", "onnxruntime refused", "run refused", "ran")
"""The expected outcomes of a model; any other is a find."""


def tried(model: bytes, own: Own, rng: Random) -> dict[str, Any]:
    """Its name, the reason, processor ms of the check, seconds, and most MB more."""
    before = memory("VmRSS")
    Path("/proc/self/clear_refs").write_text("5")
    begin, begin_cpu = time.perf_counter(), time.process_time()
    outcome, why, checked_s = "refused", "", 0.0
    try:
        try:
            taken = checked(model, own)
        finally:
            checked_s = time.process_time() - begin_cpu
        outcome = "trial refused"
        if not taken:
            run_limited(lambda: trial(model))
        outcome = "onnxruntime refused"
        opened = Classifier(taken, SystemClock()) if taken else session(model)
        outcome = "run refused"
        run(opened, rng)
        outcome = "ran"
    except FloatingPointError as e:
        outcome, why = "no number", str(e)
    except MemoryError:
        outcome = "no memory"
    except Exception as e:  # onnxruntime's classes have no other common base
        if outcome == "refused" and not isinstance(e, BundleError):
            raise  # the check may only raise BundleError, so the child dies
        why = str(e)
    took = time.perf_counter() - begin
    short = any(word in why for word in ("bad_alloc", "bad allocation", "Failed to allocate"))
    if short and outcome != "trial refused":  # the trial has less memory than the box
        outcome = "no memory"
    more = (memory("VmHWM") - before) / 1024
    about = {"outcome": outcome, "why": why[:200]}
    return about | {"check_ms": 1e3 * checked_s, "mb": more, "s": took}


def trial(model: bytes) -> None:
    """The box's trial in its sandbox: a sweep at rest. Raises BundleError if it is slow."""
    opened = session(model)
    begin_s = time.process_time()
    (takes,) = opened.get_inputs()
    opened.run(None, {takes.name: np.zeros(takes.shape, kind_of(takes))})
    if time.process_time() - begin_s > MOST_S:
        raise BundleError("it is slow")


def kind_of(takes: Any) -> np.dtype[Any]:
    """The type of a model's input."""
    return np.dtype({"tensor(float)": "float32"}.get(takes.type, takes.type[7:-1]))


def checked(model: bytes, own: Own) -> Bundle | None:
    """The box's first check; the bundle of an enrolment. Raises BundleError."""
    if own is ENROLLING:
        files = mutated_enrolments.packaged() | {bundle.ENROLMENT: model}
        return bundle.from_files(files, "a campaign")
    check.check(model, own.manifest)
    return None


def run(opened: Any, rng: Random) -> None:
    """Three sweeps: at rest, full scale, noise. FloatingPointError: a name without probability."""
    if isinstance(opened, Classifier):
        classify(opened, rng)
        return
    (takes,) = opened.get_inputs()
    kind = kind_of(takes)
    top = 1e6 if kind.kind == "f" else np.iinfo(kind).max
    noise = np.random.default_rng(rng.getrandbits(32)).uniform(0, top, takes.shape)
    for window in (np.zeros(takes.shape), np.full(takes.shape, top), noise):
        opened.run(None, {takes.name: window.astype(kind)})


def classify(classifier: Classifier, rng: Random) -> None:
    """Classify these sweeps, and the golden sweeps, whose contact reaches the class means."""
    f = classifier.format
    noise = np.random.default_rng(rng.getrandbits(32)).integers(0, 255, (f.window, *f.shape))
    noise, number = noise.astype(f.numpy_type), np.arange(f.window)
    ends = np.zeros_like(noise), np.full_like(noise, 255)
    for window in (*ends, noise, *classifier.bundle.golden):
        verdict = classifier(Sweep(1, 0, 0, Status.OK, Frames(number, number, window)))
        if verdict.label and not 0 <= verdict.probability <= 1:
            raise FloatingPointError(f"{verdict.label!r} with probability {verdict.probability}")


def memory(name: str) -> int:
    """An entry of the process's memory status, in kB."""
    line = next(x for x in Path("/proc/self/status").read_text().splitlines() if x.startswith(name))
    return int(line.split()[1])


@dataclass
class Fuzz:
    """Models by number, and the children that try them."""

    owns: list[Own]
    seed: int

    def model(self, number: int) -> tuple[bytes, Own, Random]:
        """The model of this number."""
        rng = Random(f"{self.seed}/{number}")
        if rng.random() < ENROLLED:
            return mutated_enrolments.mutated(rng), ENROLLING, rng
        own = rng.choice(self.owns)
        return mutated(own.model, rng, rng.choice(self.owns).model), own, rng

    def results(self, first: int, count: int) -> Iterator[dict[str, Any]]:
        """The outcomes of `count` models from number `first` on, in their order."""
        at, end = first, first + count
        while at < end:
            for result in self._child(range(at, min(at + BATCH, end))):
                yield result
                at = result["number"] + 1

    def _child(self, numbers: range) -> Iterator[dict[str, Any]]:
        """A child tries these models. If a model ended the child, it is the last result."""
        into, out = os.pipe()
        pid = os.fork()
        if not pid:
            os.close(into)
            self._try(numbers, out)
        os.close(out)
        rest, at = b"", numbers.start
        try:
            while at < numbers.stop:
                there = select.select([into], [], [], DEADLINE_S)[0]
                more = os.read(into, 65536) if there else b""
                if not more:
                    os.kill(pid, signal.SIGKILL)  # it hangs, or has ended already
                    code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
                    pid = 0
                    outcome = f"died ({code})" if there else "hung"
                    found = {"number": at, "outcome": outcome, "why": ""}
                    yield found | {"check_ms": 0, "mb": 0, "s": DEADLINE_S}
                    return
                *lines, rest = (rest + more).split(b"\n")
                for line in lines:
                    at += 1
                    yield json.loads(line)
        finally:
            os.close(into)
            if pid:
                os.waitpid(pid, 0)

    def _try(self, numbers: range, out: int) -> None:
        """The program of the child; it never returns."""
        code = 1
        try:
            size = memory("VmSize") * 1024 + MOST_MORE
            resource.setrlimit(resource.RLIMIT_AS, (size, size))
            resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
            # onnxruntime prints the models that it refuses
            os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
            for number in numbers:
                result = {"number": number} | tried(*self.model(number))
                os.write(out, json.dumps(result).encode() + b"\n")
            code = 0
        finally:
            os._exit(code)


def fresh(seed: int) -> dict[str, Any]:
    """The record of a campaign that has not begun."""
    most = {"slowest_check_ms": 0.0, "slowest_s": 0.0, "most_mb": 0.0}
    return provenance() | {"seed": seed, "done": 0, "outcomes": {}, "finds": []} | most


def note(record: dict[str, Any], result: dict[str, Any]) -> None:
    """Add a result to the record."""
    outcome = result["outcome"]
    record["done"] += 1
    record["outcomes"][outcome] = record["outcomes"].get(outcome, 0) + 1
    for key, value in (("slowest_check_ms", "check_ms"), ("slowest_s", "s"), ("most_mb", "mb")):
        record[key] = max(record[key], round(result[value], 3))
    if outcome not in SORRY or result["mb"] > MOST_MORE >> 20:
        record["finds"].append(result)


def main() -> int:
    """Run the campaign; 1 if a model was a find."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--count", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    record = json.loads(args.out.read_text()) if args.out.exists() else fresh(args.seed)
    if record["seed"] != args.seed:
        parser.error(f"{args.out} is of seed {record['seed']}; name another file")
    fuzz = Fuzz(own_models(), args.seed)
    for result in fuzz.results(record["done"], args.count - record["done"]):
        note(record, result)
        if record["done"] % BATCH == 0 or record["done"] == args.count:
            storage.put(args.out, (json.dumps(record, indent=1) + "\n").encode())
            finds = len(record["finds"])
            print(f"{record['done']}: {record['outcomes']}, finds {finds}", flush=True)
    return 1 if record["finds"] else 0


if __name__ == "__main__":
    sys.exit(main())
