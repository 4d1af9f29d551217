"""One fuzzing process: Atheris (libFuzzer) drives one target.

The runner starts it as a process, because libFuzzer ends the process in which it runs. Arguments
are the target's name, CPU seconds, and libFuzzer's options.
"""

from __future__ import annotations

import os
import resource
import signal
import sys
import time
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory

import atheris

with atheris.instrument_imports(include=["palpate", "tomllib", "palpate_train.data"]):
    from tests.fuzz import targets
from tests.fuzz.mutators import MUTATORS

MEMORY = 1 << 30
"""Memory limit of the process in bytes. An input for which the box needs more ends in a
MemoryError, which counts as a crash."""

SLOW_S = 10
"""An input that takes more processor time than this counts as a crash, too."""


def main(name: str, seconds: float, *options: str) -> None:
    """Fuzz a target for this much CPU time; libFuzzer prints its progress on standard error."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    target, mutate = targets.TARGETS[name], MUTATORS[name]
    with TemporaryDirectory(prefix=f"fuzz-{name}-") as folder:
        place = Path(folder)

        def mutator(data: bytes, most: int, seed: int) -> bytes:
            return mutate(data, Random(seed), lambda part: atheris.Mutate(part, most))[:most]

        def once(data: bytes) -> None:
            begin = time.process_time()  # not real time, which a busy machine would take away
            target(data, place)
            end = time.process_time()
            assert end - begin < SLOW_S, f"this input took {end - begin:.0f} s of processor time"
            if 0 < seconds < end:
                os.kill(os.getpid(), signal.SIGUSR1)  # ends libFuzzer cleanly

        # the command with which libFuzzer starts itself for a merge
        again = f"{sys.executable} -m tests.fuzz.engine {name} {seconds}"
        atheris.Setup([again, *options], once, custom_mutator=mutator)
        atheris.Fuzz()


if __name__ == "__main__":
    main(sys.argv[1], float(sys.argv[2]), *sys.argv[3:])
