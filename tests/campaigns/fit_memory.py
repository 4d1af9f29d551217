"""Peak memory and time of `palpate-train fit` on sets of growing size.

`python -m tests.campaigns fit-memory` prints a line for each number of windows: the bytes of the
set, whether it is mapped (palpate_train.data.mapped), the peak memory that the process held without
mapped files, that without a set that was read, and processor time. Sets are drawn from ten
materials at four speeds in five sessions, 128 frames of 16 taxels in int16, 20 windows a recording.
Options after `--` go to fit, such as `--split recording:0.9`.
"""

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from palpate_train.data import mapped
from palpate_train.data.sets import Dataset

WINDOWS = (1_000, 10_000, 50_000, 100_000)
MATERIALS, EACH, SPEEDS, SESSIONS = 10, 20, 4, 5
FRAMES, TAXELS, RATE_HZ = 128, 16, 500.0
BATCH = 1000
PERIOD_S = 0.02


def drawn(count: int, seed: int = 0) -> Dataset:
    """A set of `count` windows: noise in a band that the material and a little the speed set."""
    rng, numbers = np.random.default_rng(seed), np.arange(count)
    labels, turn = numbers % MATERIALS, numbers // MATERIALS // EACH
    speed, session = turn % SPEEDS, turn // SPEEDS % SESSIONS
    samples = np.empty((count, FRAMES, 4, 4), np.int16)
    frequency = np.fft.rfftfreq(FRAMES)
    for first in range(0, count, BATCH):
        part = slice(first, min(first + BATCH, count))
        n = part.stop - first
        centre = (0.05 + 0.03 * labels[part]) * (1 + 0.1 * speed[part])
        passed = 0.3 + np.exp(-((frequency - centre[:, None]) ** 2) / 0.008)
        noise = np.fft.rfft(rng.standard_normal((n, TAXELS, FRAMES))) * passed[:, None]
        x = np.fft.irfft(noise, FRAMES) + 0.7 * rng.standard_normal((n, TAXELS, FRAMES))
        x *= 300 * np.exp(0.3 * rng.standard_normal((n, TAXELS, 1)))
        x += 2000 + 50 * session[part, None, None]
        samples[part] = np.rint(x.transpose(0, 2, 1)).reshape(n, FRAMES, 4, 4).clip(0, 32_000)
    groups = {"recording": turn * MATERIALS + labels, "speed": speed, "session": session}
    names = tuple(f"m{k}" for k in range(MATERIALS))
    return Dataset(samples, labels, names, RATE_HZ, groups, f"{count} windows")


def peak(command: list[str]) -> tuple[float, float]:
    """Peak memory in bytes without mapped files, read every PERIOD_S, and processor seconds."""
    most = 0.0
    with subprocess.Popen(command, stdout=sys.stderr) as process:
        while process.poll() is None:
            most = max(most, held(process.pid))
            time.sleep(PERIOD_S)
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    if process.returncode:
        raise SystemExit(f"fit-memory: {command} ended with {process.returncode}")
    return most, used.ru_utime + used.ru_stime


def held(pid: int) -> float:
    """The bytes of memory that a process holds now, without mapped files; 0 once it has ended."""
    try:
        text = Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return 0.0
    lines = (line.split() for line in text.splitlines())
    return sum(1024.0 * int(words[1]) for words in lines if words[0] == "RssAnon:")


def main(arguments: list[str]) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser("python -m tests.campaigns fit-memory")
    parser.add_argument("--windows", nargs="+", type=int, default=WINDOWS)
    parser.add_argument("fit", nargs="*", default=[], help="options of fit")
    args = parser.parse_args(arguments)
    print("windows  set MB  mapped  held MB  beside the set  CPU s")
    before = 0.0
    for count in args.windows:
        with tempfile.TemporaryDirectory() as folder:
            path, out = Path(folder) / "set.h5", Path(folder) / "fit.npz"
            sweeps = drawn(count)
            sweeps.save(path)
            size = sweeps.samples.nbytes
            del sweeps
            is_mapped = size >= mapped.LEAST
            words = ["fit", "--set", str(path), "--seed", "1", "--out", str(out), *args.fit]
            most, total = peak([sys.executable, "-m", "palpate_train", *words])
        seconds, before = total - before, total
        mega = [f"{x / 1e6:.0f}" for x in (size, most, most - size * (not is_mapped))]
        print(
            f"{count:>7}  {mega[0]:>6}  {'yes' if is_mapped else 'no':>6}  {mega[1]:>7}  "
            f"{mega[2]:>14}  {seconds:>5.0f}",
            flush=True,
        )


if __name__ == "__main__":
    main(sys.argv[1:])
