"""The memory that a fit needs, told before hours of work."""

from __future__ import annotations

from pathlib import Path

from palpate.core.errors import FormatError
from palpate_train.data.sets import Dataset

MOST_SWEEPS = 4000
"""Usual largest number of sweeps of a fit. It bounds memory and time: features of each sweep and of
its copies are held, and candidates are fitted to them (docs/recipe.md)."""
COPIED, FEATURES, FIXED = 4, 150_000, 0.3e9
"""Bytes that a fit needs besides its set: COPIED times the bytes of the used sweeps, FEATURES for
each of them, and FIXED for the program (measured, docs/recipe.md)."""
MEMINFO, CGROUP = Path("/proc/meminfo"), Path("/sys/fs/cgroup")


def needed(sweeps: Dataset, used: int) -> float:
    """About how many bytes a fit to `used` of these sweeps needs besides the set."""
    return FIXED + float(used * (FEATURES + COPIED * sweeps.samples[0].nbytes))


def available() -> float:
    """The bytes that this process can still get, infinite if the system does not say."""
    free = [float("inf")]
    if MEMINFO.is_file():
        lines = (line.split() for line in MEMINFO.read_text().splitlines())
        free += [1024 * float(words[1]) for words in lines if words[0] == "MemAvailable:"]
    limit, current = CGROUP / "memory.max", CGROUP / "memory.current"
    if limit.is_file() and current.is_file() and (text := limit.read_text().strip()).isdigit():
        free.append(float(text) - float(current.read_text()))
    return min(free)


def check(sweeps: Dataset, used: int) -> None:
    """Raises FormatError if a fit to `used` of these sweeps needs more memory than there is."""
    want, free = needed(sweeps, used), available()
    if want <= free:
        return
    each = needed(sweeps, 1) - needed(sweeps, 0)
    fitting = int(max(free - FIXED, 0) / each) // 100 * 100
    advice = f"use --most-sweeps {fitting}" if fitting else "close other programs"
    raise FormatError(
        f"a fit to {used} sweeps of {sweeps.format} needs about {want / 1e9:.1f} GB of memory, and "
        f"{free / 1e9:.1f} GB are free; {advice}, or use a machine with more"
    )
