"""Augmentation: the sweeps that a skin might have given if it had been attached anew, or read by a
worse amplifier.

`augment` changes prepared sweeps in the training of a network. `copies` gives raw counts, from
which heads in closed form learn how materials vary. Every change is drawn anew for every sweep from
one generator; a parameter of 0 draws and changes nothing. Neither needs PyTorch or double
precision.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from math import pi
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.random import Generator
from numpy.typing import NDArray

from palpate_train.data.sets import Dataset

Array = NDArray[np.float32]
OCTAVES = 5.0
"""Lowest cut-off of a damped sweep, in octaves below half the sampling rate: at 750 Hz it lies
between 12 and 375 Hz."""
NOISY = 4.0
"""Maximum noise of a noisy taxel."""
HUMMING = 0.25
"""Share of the sweeps with hum, if `hum` is not 0."""
PIECES = 1 << 16
"""Number of positions in a batch's draw of noise at which the noise of a taxel may start."""

COPIES = 2
"""Number of copies of each training sweep for a head in closed form."""
BATCH = 128
"""Number of sweeps that are copied at a time, which bounds the memory."""


@dataclass(frozen=True)
class Augmentation:
    """The changes of a sweep; 0 is off. Spreads are standard deviations. Amplitudes are in
    deviations of all taxels together, which `Network.prepare` brings to 1.

    The defaults that are not 0 improved single runs on simulated sweeps at 750 Hz (T-REAL and
    T-HARD, seeds 301 to 399). The others did not, because the first layers of the network deal with
    hum, drift and noisy taxels at less cost.
    """

    shift: float = 1.0
    """Largest displacement of the skin along the rows, in rows, in both directions; uniform, and
    interpolated between rows. A row that enters over the edge carries between nothing and all of
    the load at the edge. A single line of taxels is not displaced."""
    displaced: float = 0.5
    """Share of the sweeps that are displaced."""
    gain: float = 0.2
    """Spread of the logarithm of the gain of all taxels together: force, skin, amplifier."""
    gains: float = 0.2
    """Spread of the logarithm of each taxel's own gain."""
    silent: float = 0.05
    """Share of the taxels without a signal: dead, stuck or saturated."""
    damped: float = 0.5
    """Share of the sweeps in which skin and tape absorb high frequencies: a first-order low-pass
    with its cut-off anywhere in the OCTAVES below half the sampling rate."""
    colour: float = 0.3
    """Spread of the logarithm of the gain of each octave: tape and glove pass some frequencies
    better than others."""
    noise: float = 0.5
    """Maximum white noise on all taxels, drawn squared: small noise is more common."""
    noisy: float = 0.0
    """Share of the taxels with white noise of their own, up to NOISY."""
    drift: float = 0.0
    """Spread of a taxel's offset at the sweep's end; it changes linearly, from the opposite value
    at the start."""
    hum: float = 0.0
    """Largest amplitude of a sine of any frequency, the same on all taxels."""

    def without_faults(self) -> Augmentation:
        """The effects of another position of the skin alone, without effects of its electronics.

        Noise and silent taxels make copies so much harder to classify than any displaced skin is
        that an error rate of such copies says nothing about it.
        """
        return replace(self, noise=0.0, noisy=0.0, silent=0.0, drift=0.0, hum=0.0)


SLOW = Augmentation(gain=0.4, noise=0.1, silent=0.0, damped=0.0, colour=0.0)
"""The augmentation for sensors that are too slow for vibrations. Fingers and tape do not damp their
signal, which depends more on force and friction."""


def default_augmentation(zero_sum: bool) -> Augmentation:
    """The default for a recipe. zero_sum: whether the sensor is fast enough for kernels that sum to
    zero."""
    return Augmentation() if zero_sum else SLOW


def augment(x: Array, rows: int, augmentation: Augmentation, rng: Generator) -> Array:
    """Changed sweeps float32 [B, R * C * A, T], where R is `rows`; the same for the same state of
    `rng`.

    rows: 1 if the taxels stand in a line, which is not displaced. x: prepared sweeps (see
    `Network.prepare`); it is not changed.
    """
    x = _attached(x, rows, augmentation, rng)  # new memory, which may be written to
    return _with_faults(_filtered(x, augmentation, rng), augmentation, rng)


def _attached(x: Array, rows: int, augmentation: Augmentation, rng: Generator) -> Array:
    """Attach the skin anew: another position, other gains, failed taxels."""
    n, taxels, _ = x.shape
    gain = np.ones((n, taxels, 1), np.float32)
    x = (
        _shifted(x, rows, augmentation, rng)
        if augmentation.shift and 1 < rows < taxels
        else x.copy()
    )
    if augmentation.gain:
        gain *= np.exp(augmentation.gain * _normal(rng, n, 1, 1))
    if augmentation.gains:
        gain *= np.exp(augmentation.gains * _normal(rng, n, taxels, 1))
    if augmentation.silent:
        gain *= ~_chosen(augmentation.silent, rng, n, taxels, 1)
    x *= gain
    return x


def _shifted(x: Array, rows: int, augmentation: Augmentation, rng: Generator) -> Array:
    """Displace a share of the sweeps along the rows."""
    n, row = len(x), np.arange(rows, dtype=np.float32)
    source = row + augmentation.shift * _symmetric(rng, n, 1) * _chosen(
        augmentation.displaced, rng, n, 1
    )
    # the load on the row that enters is unknown: that of its neighbour, nothing, or something in
    # between
    level = np.where((source < 0) | (source > rows - 1), _uniform(rng, n, rows), np.float32(1))
    near = np.maximum(1 - np.abs(source.clip(0, rows - 1)[..., None] - row), 0)
    shifted: Array = np.matmul(near * level[..., None], x.reshape(n, rows, -1)).reshape(x.shape)
    return shifted


def _filtered(x: Array, augmentation: Augmentation, rng: Generator) -> Array:
    """Filter as skin, tape and glove do, which pass some frequencies better than others."""
    n, _, frames = x.shape
    if not (augmentation.damped or augmentation.colour) or frames < 2:
        return x
    from scipy import fft

    frequency = 2 * np.fft.rfftfreq(frames).astype(np.float32)  # 1 is half the sampling rate
    passed = np.ones((n, len(frequency)), np.float32)
    if augmentation.damped:
        cut = np.exp2(-OCTAVES * _uniform(rng, n, 1))
        damped = _chosen(augmentation.damped, rng, n, 1)
        passed = np.where(damped, 1 / np.sqrt(1 + (frequency / cut) ** 2), passed)
    if augmentation.colour:
        # in octaves below the highest frequency
        octave = -np.log2(np.maximum(frequency, frequency[1]))
        knot = octave.astype(np.int64)
        log_gain = augmentation.colour * _normal(rng, n, int(knot.max()) + 2)
        passed *= np.exp(_lerp(log_gain[:, knot], log_gain[:, knot + 1], octave % 1))
    spectrum = fft.rfft(x)
    spectrum *= passed[:, None]
    filtered: Array = fft.irfft(spectrum, frames, overwrite_x=True)
    return filtered


def _with_faults(x: Array, augmentation: Augmentation, rng: Generator) -> Array:
    """Add the faults of the sensor: noise, an offset that drifts, hum."""
    n, taxels, frames = x.shape
    if augmentation.noise or augmentation.noisy:
        level = augmentation.noise * _uniform(rng, n, 1, 1) ** 2
        own = NOISY * _uniform(rng, n, taxels, 1) * _chosen(augmentation.noisy, rng, n, taxels, 1)
        noise = _white_noise(rng, n, taxels, frames)
        noise *= level + own
        x += noise
    if augmentation.drift:
        x += (
            augmentation.drift
            * _normal(rng, n, taxels, 1)
            * np.linspace(-1, 1, frames, dtype=np.float32)
        )
    if augmentation.hum:
        amplitude = augmentation.hum * _uniform(rng, n, 1, 1) * _chosen(HUMMING, rng, n, 1, 1)
        frequency, phase = _uniform(rng, 2, n, 1, 1)
        x += amplitude * np.sin(
            2 * pi * (frequency / 2 * np.arange(frames, dtype=np.float32) + phase)
        )
    return x


def _white_noise(rng: Generator, n: int, taxels: int, frames: int) -> Array:
    """White noise [n, taxels, frames] from pieces of one draw, because separate draws would take
    longer than everything else."""
    # Box and Muller 1958: NumPy's own method takes three times as long
    distance, angle = _uniform(rng, 2, (PIECES + frames + 1) // 2)
    distance, angle = np.sqrt(-2 * np.log1p(-distance)), 2 * pi * angle
    source = np.concatenate([distance * np.cos(angle), distance * np.sin(angle)])
    pieces: Array = sliding_window_view(source, frames)[rng.integers(0, PIECES, (n, taxels))]
    return pieces


def _chosen(share: float, rng: Generator, *shape: int) -> NDArray[np.bool_]:
    """Booleans of `shape`, each true with the probability `share`."""
    return _uniform(rng, *shape) < share


def _symmetric(rng: Generator, *shape: int) -> Array:
    """Numbers of `shape`, uniform from -1 to 1."""
    return 2 * _uniform(rng, *shape) - 1


def _uniform(rng: Generator, *shape: int) -> Array:
    """Numbers of `shape`, uniform from 0 to 1."""
    return rng.random(shape, np.float32)


def _normal(rng: Generator, *shape: int) -> Array:
    """Numbers of `shape`, normal with deviation 1."""
    return rng.standard_normal(shape, np.float32)


def _lerp(start: Array, end: Array, share: Array) -> Array:
    """`share` of the way from `start` to `end`."""
    return start + share * (end - start)


def texture_scale(samples: NDArray[Any]) -> float:
    """The factor that gives raw counts [N, T, R, C] a deviation of 1 after the mean of each taxel
    over its sweep is subtracted."""
    squares = 0.0
    for start in range(0, len(samples), BATCH):  # whole sets would be copied thrice
        some = samples[start : start + BATCH]
        # float32 would add row after row, and round the more the longer the sweeps are
        deviation = some - some.mean(axis=1, keepdims=True, dtype=np.float64).astype(np.float32)
        squares += float(np.square(deviation).sum(dtype=np.float64))
    return float(1 / max(np.sqrt(squares / samples.size), 1e-6))


def copies(sweeps: Dataset, augmentation: Augmentation, seed: int, count: int) -> Iterator[Dataset]:
    """`count` changed versions of all sweeps, in their order and of their data type."""
    rng, scale = np.random.default_rng(seed), texture_scale(sweeps.samples)
    for _ in range(count):
        samples = np.empty_like(sweeps.samples)
        for start in range(0, len(sweeps), BATCH):
            part = slice(start, start + BATCH)
            samples[part] = _changed(sweeps.samples[part], scale, augmentation, rng)
        yield replace(sweeps, samples=samples)


def _changed(
    counts: NDArray[Any], scale: float, augmentation: Augmentation, rng: Generator
) -> NDArray[np.float32]:
    """Changed raw counts [B, T, R, C] or [B, T, R, C, A]; integers are rounded and clipped to the
    range of their data type."""
    n, frames, rows, cols = counts.shape[:4]
    x = np.ascontiguousarray(counts.reshape(n, frames, -1).transpose(0, 2, 1), np.float32)
    means = x.mean(axis=2, keepdims=True)
    x = augment((x - means) * scale, rows if cols > 1 else 1, augmentation, rng) / scale + means
    if counts.dtype.kind != "f":
        limits = np.iinfo(counts.dtype)
        x = np.rint(x).clip(limits.min, limits.max)
    changed: NDArray[np.float32] = x.transpose(0, 2, 1).reshape(counts.shape)
    return changed
