"""Runs the fuzzing: `python -m tests.fuzz [TARGET ...] --minutes N`, N in CPU minutes for each
target.

Prints a line of figures for each target, and saves the smallest corpus that covers as much, and in
crashes/ each input that broke a promise. New inputs are kept in build/fuzz/; the next run begins
with them, also after an interruption.
"""

import argparse
import re
import resource
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from shutil import rmtree

from tests.fuzz import corpus, seeds
from tests.fuzz.targets import TARGETS

WORK = seeds.ROOT / "build" / "fuzz"
LONGEST_INPUT = 5000
"""Largest input in bytes: a little more than the largest packet."""
LONGEST_SAVED = 2048
"""Largest input that is saved, in bytes: longer inputs repeat the same operations."""
OPTIONS = (f"-max_len={LONGEST_INPUT}", "-timeout=300", "-print_final_stats=1", "-reload=0")
"""libFuzzer measures real time, so its limit only stops endless runs; the engine limits processor
time."""


@dataclass(frozen=True, slots=True)
class FuzzRun:
    """Figures of a run of libFuzzer. features: the reached places with their counts."""

    executions: int
    coverage: int
    features: int
    cpu_s: float
    crashes: list[Path]


def main() -> int:
    """Fuzz the named targets, or all, one after another; 1 if a promise was broken."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.fuzz", description=__doc__.split("\n\n")[0]
    )
    parser.add_argument(
        "targets", nargs="*", metavar="TARGET", help=f"from {', '.join(TARGETS)}; all by default"
    )
    parser.add_argument(
        "--minutes",
        type=float,
        default=10,
        help="processor time for each target, 0 only to merge (%(default)s)",
    )
    parser.add_argument("--seed", type=int, default=1, help="of the generator (%(default)s)")
    given = parser.parse_args()
    if wrong := set(given.targets) - set(TARGETS):
        parser.error(f"no target {', '.join(sorted(wrong))}; there are {', '.join(TARGETS)}")
    return max([fuzz(target, given.minutes, given.seed) for target in given.targets or TARGETS])


def fuzz(target: str, minutes: float, seed: int) -> int:
    """Fuzz one target, save the inputs that it found, and print the figures."""
    place, inputs = WORK / target, WORK / target / "inputs"
    inputs.mkdir(parents=True, exist_ok=True)
    for data in [*corpus.load(target), *seeds.SEEDS[target]()]:
        (inputs / corpus.name(data)).write_bytes(data)
    words = ("".join(f"\\x{byte:02x}" for byte in word) for word in seeds.words(target))
    (place / "words").write_text("".join(f'"{word}"\n' for word in words), "ascii")
    before = _engine(target, 0, "-runs=0", inputs)
    run = _engine(
        target,
        minutes * 60,
        f"-runs={-1 if minutes else 0}",
        f"-seed={seed}",
        f"-dict={place / 'words'}",
        inputs,
    )
    kept = _smallest(target, inputs)
    corpus.save(target, kept)
    print(
        f"{target}: {run.executions} executions in {run.cpu_s:.0f} s of processor time, "
        f"{run.executions / run.cpu_s:.0f}/s; coverage {before.coverage} -> {run.coverage}, "
        f"features {before.features} -> {run.features}; "
        f"corpus {len(kept)} inputs, {sum(map(len, kept))} bytes; crashes {len(run.crashes)}",
        flush=True,
    )
    for crash in run.crashes:
        print(
            f"{target}: {crash} breaks a promise; "
            "mend it, and give the file a name that says what it was"
        )
    return 1 if run.crashes else 0


def _smallest(target: str, inputs: Path) -> list[bytes]:
    """The fewest of the inputs that cover as much as all, without those too large to be saved."""
    smallest = WORK / target / "smallest"
    rmtree(smallest, ignore_errors=True)
    smallest.mkdir()
    _engine(target, 0, "-merge=1", smallest, inputs)
    kept = [
        file.read_bytes() for file in smallest.iterdir() if file.stat().st_size <= LONGEST_SAVED
    ]
    if not kept:
        raise SystemExit(
            f"{target}: the merge kept no input; see {WORK / target / 'log'}; "
            "the saved corpus stays as it is"
        )
    return kept


def _engine(target: str, seconds: float, *options: object) -> FuzzRun:
    """Run one fuzzing process to its end. seconds: of its processor time, 0 for no limit."""
    found = WORK / target / "found"
    rmtree(found, ignore_errors=True)
    found.mkdir()
    command = [
        sys.executable,
        "-m",
        "tests.fuzz.engine",
        target,
        str(seconds),
        *OPTIONS,
        f"-artifact_prefix={found}/",
    ]
    begin = _cpu_s()
    log = WORK / target / "log"
    with log.open("wb") as file:
        done = subprocess.run([*command, *map(str, options)], stdout=file, stderr=file, check=False)
    text = log.read_text("utf-8", "replace")
    broke = [corpus.keep_crash(target, file.read_bytes()) for file in sorted(found.iterdir())]
    if done.returncode and not broke:
        raise SystemExit(
            f"{target}: the fuzzer ended with {done.returncode}; see {log}\n{text[-2000:]}"
        )
    states = re.findall(r"cov: (\d+) ft: (\d+)", text) or [("0", "0")]
    count = re.findall(r"number_of_executed_units: (\d+)|^#(\d+)", text, re.MULTILINE) or [
        ("0", "0")
    ]
    executions = max(int(a or b) for a, b in count)
    return FuzzRun(executions, *map(int, states[-1]), _cpu_s() - begin, broke)


def _cpu_s() -> float:
    """Processor seconds of all fuzzing processes up to now."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


if __name__ == "__main__":
    sys.exit(main())
