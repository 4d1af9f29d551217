"""Finds sweeps that a set holds twice: identical sweeps, and windows that share frames.

A model that is tested on such a sweep has seen it in training, and even noise is classified
correctly.
"""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate_train.data.sets import Dataset

Array = NDArray[Any]
RUN = 8
"""Frames in a row that are searched for in other sweeps. They must differ from one another."""
LEAST_SHARED = 1 / 8
"""Least share of the window that two sweeps must have in common."""
BATCH = 256
"""Sweeps that are hashed at a time."""
WORD = 4
"""Bytes of a frame that are hashed together."""
MOST_KEPT = 512
"""Largest number of digests of training sweeps that a bundle keeps: those with the lowest values,
which are a random sample of all (a bottom-k sketch, Cohen and Kaplan 2007)."""


@dataclass(frozen=True, eq=False)
class Pairs:
    """Pairs of sweeps [P] that share `frames` [P] frames; the whole window if they are identical.

    first, second: their numbers.
    """

    first: Array
    second: Array
    frames: Array

    def take(self, index: Array) -> Pairs:
        """The pairs at `index`."""
        return Pairs(self.first[index], self.second[index], self.frames[index])

    def across(self, train: Array, test: Array) -> Array:
        """The numbers of the sweeps in `test` that share frames with one in `train` (numbers)."""
        found = [
            one[np.isin(one, test) & np.isin(other, train)]
            for one, other in ((self.first, self.second), (self.second, self.first))
        ]
        return np.unique(np.concatenate(found))


def digests(sweeps: Dataset) -> Array:
    """A digest uint64 [N] of the raw counts of each sweep, in whatever set it is."""
    kind = sweeps.samples.dtype.newbyteorder("<")
    texts = (np.ascontiguousarray(one, kind).data for one in sweeps.samples)
    return np.array(
        [int.from_bytes(hashlib.blake2b(t, digest_size=8).digest(), "little") for t in texts],
        np.uint64,
    )


def sketch(*sets: Dataset) -> str:
    """The lowest MOST_KEPT of the digests of all sweeps as text, for a manifest."""
    lowest = np.unique(np.concatenate([digests(sweeps) for sweeps in sets]))[:MOST_KEPT]
    return base64.b64encode(lowest.astype("<u8").tobytes()).decode()


def seen(sweeps: Dataset, kept: str) -> tuple[int, int]:
    """(number of `sweeps` whose digest is in the `sketch` kept, number that could be there).

    Of a set with more than MOST_KEPT sweeps only some digests are kept; then the two numbers are of
    a random part of the sweeps. Raises ValueError if `kept` is not a sketch.
    """
    known = np.frombuffer(base64.b64decode(kept, validate=True), "<u8")
    if not len(known):
        return 0, len(sweeps)
    own = digests(sweeps)
    possible = own if len(known) < MOST_KEPT else own[own <= known.max()]
    return int(np.isin(possible, known).sum()), len(possible)


def pairs(sweeps: Dataset) -> Pairs:
    """The sweeps of different recordings that are identical or share frames at their ends."""
    hashes = _frame_hashes(sweeps.samples)
    run = min(RUN, max(hashes.shape[1] // 2, 1))
    probe, place = _probes(hashes, run)
    recording = sweeps.group("recording")
    found = [np.empty((3, 0), int), _identical(sweeps)]
    order = np.argsort(probe, kind="stable")
    for first, second, shift in _candidates(hashes, probe[order], order, place, run):
        other = (recording[first] != recording[second]) & (shift >= 0)
        other &= (shift > 0) | (first < second)
        found.append(_verified(hashes, first[other], second[other], shift[other]))
    joined = np.unique(np.concatenate(found, axis=1), axis=1)
    apart = recording[joined[0]] != recording[joined[1]]
    return Pairs(*joined[:, apart])


def _identical(sweeps: Dataset) -> Array:
    """(first, second, frames) int [3, P]: pairs of identical sweeps; several copies are a chain of
    pairs."""
    own = digests(sweeps)
    order = np.argsort(own, kind="stable")
    same = np.flatnonzero(own[order][1:] == own[order][:-1])
    frames = np.full(len(same), sweeps.samples.shape[1])
    return np.stack([order[same], order[same + 1], frames])


def _frame_hashes(samples: Array) -> Array:
    """A hash uint64 [N, T] of each frame."""
    n, frames = samples.shape[:2]
    rng = np.random.default_rng(0)
    factors = rng.integers(
        1, 1 << 63, samples[0, 0].nbytes // WORD + 1, dtype=np.uint64
    ) | np.uint64(1)
    hashes = np.empty((n, frames), np.uint64)
    for first in range(0, n, BATCH):
        part = np.ascontiguousarray(samples[first : first + BATCH])
        own = part.reshape(len(part), frames, -1).view(np.uint8)
        filled = np.pad(own, ((0, 0), (0, 0), (0, -own.shape[2] % WORD)))
        words = filled.view(np.uint32).astype(np.uint64)  # the fewer numbers, the faster
        hashes[first : first + BATCH] = words @ factors[: words.shape[2]]
    return hashes


def _runs(hashes: Array, run: int) -> tuple[Array, Array]:
    """A hash uint64 [n, T - run + 1] of each run of frames, and whether its frames change."""
    factors = np.random.default_rng(1).integers(1, 1 << 63, run, dtype=np.uint64) | np.uint64(1)
    number = hashes.shape[1] - run + 1
    values = np.zeros((len(hashes), number), np.uint64)
    for frame, factor in enumerate(factors):
        values += factor * hashes[:, frame : frame + number]
    changes = np.zeros((len(hashes), hashes.shape[1]), int)
    changes[:, 1:] = (hashes[:, 1:] != hashes[:, :-1]).cumsum(axis=1)
    different = changes[:, run - 1 :] - changes[:, :number]
    return values, different >= max(run // 2, 1)


def _probes(hashes: Array, run: int) -> tuple[Array, Array]:
    """For each sweep the hash [N] of its first run whose frames change, and the place [N] of that
    run; -1 if there is none."""
    probe, place = np.zeros(len(hashes), np.uint64), np.full(len(hashes), -1)
    for first in range(0, len(hashes), BATCH):
        values, different = _runs(hashes[first : first + BATCH], run)
        at = different.argmax(axis=1)
        each = np.arange(len(values))
        probe[first : first + BATCH] = values[each, at]
        place[first : first + BATCH] = np.where(different[each, at], at, -1)
    return probe, place


def _candidates(
    hashes: Array, ordered: Array, order: Array, place: Array, run: int
) -> Iterator[tuple[Array, Array, Array]]:
    """(first, second, shift) [p] each: pairs of sweeps that may overlap. The first holds the probe
    of the second; frame 0 of the second may be frame `shift` of the first."""
    if not len(ordered):
        return
    for start in range(0, len(hashes), BATCH):
        values, different = _runs(hashes[start : start + BATCH], run)
        at = np.minimum(np.searchsorted(ordered, values), len(ordered) - 1)
        first, frame = np.nonzero((ordered[at] == values) & different)
        rank = at[first, frame]
        second = order[rank]
        itself = second == first + start
        # of equal probes the search finds the first alone, which may be the sweep itself
        after = np.minimum(rank + 1, len(ordered) - 1)
        again = itself & (ordered[after] == ordered[rank])
        second = np.where(again, order[after], second)
        kept = (second != first + start) & (place[second] >= 0)
        first, second, frame = first[kept] + start, second[kept], frame[kept]
        yield first, second, frame - place[second]


def _verified(hashes: Array, first: Array, second: Array, shift: Array) -> Array:
    """(first, second, frames) int [3, p]: the candidates whose common part is equal, long enough
    and not constant."""
    window, found = hashes.shape[1], [np.empty((3, 0), int)]
    for by in np.unique(shift).tolist():
        frames = window - by
        if frames < max(LEAST_SHARED * window, min(RUN, window // 2)):
            continue
        mine = np.flatnonzero(shift == by)
        own, other = hashes[first[mine], by:], hashes[second[mine], :frames]
        equal = (own == other).all(axis=1)
        changes = (own[:, 1:] != own[:, :-1]).sum(axis=1)
        kept = mine[equal & (changes >= min(RUN, window // 2) // 2)]
        found.append(np.stack([first[kept], second[kept], np.full(len(kept), frames)]))
    return np.concatenate(found, axis=1)


def warnings_of(sweeps: Dataset, found: Pairs) -> list[str]:
    """Warnings about pairs of sweeps, with their figures."""
    lines, window = [], sweeps.samples.shape[1]
    same = found.take(found.frames == window)
    if n := len(np.unique(np.append(same.first, same.second))):
        two = same.take(sweeps.labels[same.first] != sweeps.labels[same.second])
        wrong = len(np.unique(np.append(two.first, two.second)))
        shown = two if wrong else same
        under = f", {wrong} of them under two materials" if wrong else ""
        lines.append(
            f"warning: {n} of {len(sweeps)} sweeps are identical to another{under} "
            f"({_example(sweeps, shown)}); remove the copies"
        )
    part = found.take(found.frames < window)
    if n := len(np.unique(np.append(part.first, part.second))):
        lines.append(
            f"warning: {n} of {len(sweeps)} sweeps share frames with a sweep of another recording "
            f"({_example(sweeps, part)}, {part.frames[0]} of {window} frames); give windows of one "
            "recording the same number in the group recording"
        )
    return lines


def _example(sweeps: Dataset, found: Pairs) -> str:
    a, b = int(found.first[0]), int(found.second[0])
    names = [sweeps.materials[sweeps.labels[i]] for i in (a, b)]
    return f"sweep {a}, {names[0]}, and sweep {b}, {names[1]}"
