"""Augmentation. In: prepared sweeps and an Augmentation, which says what varies. Out: the same sweeps, changed.

Each sweep becomes one that the skin might have given when attached anew, slid at another speed or read by a worse
amplifier. Everything is drawn anew for every sweep, from one generator; a parameter at 0 draws and changes nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import pi

import torch
from torch import Generator, Tensor

OCTAVES = 5.0
"""How far below half the sampling rate the cut-off of a damped sweep may lie: at 750 Hz it is 12 to 375 Hz."""
NOISY = 4.0
"""Maximum noise of a noisy taxel."""
HUMMING = 0.25
"""Share of the sweeps with hum, where there is any."""
PIECES = 1 << 16
"""Positions in the batch's one draw of noise at which a taxel's noise may start."""


@dataclass(frozen=True)
class Augmentation:
    """What varies; 0 is off. Spreads are standard deviations; amplitudes are in deviations of all taxels together, which
    `Network.prepare` makes 1.

    What is not 0 by default was better in single runs on simulated sweeps at 750 Hz (T-REAL and T-HARD, seeds 301 to
    399). The rest was not, there: the network's first layers deal with hum, drift and noisy taxels at less cost.
    """

    shift: float = 1.0
    """Largest displacement of the skin along the rows, in rows, either way; uniform, and interpolated between rows. A row
    that enters over the edge carries between nothing and all of what the row at the edge feels. A line of taxels is not
    moved."""
    moved: float = 0.5
    """Share of the sweeps that are displaced so."""
    gain: float = 0.2
    """Spread of the logarithm of the gain of all taxels together: force, skin, amplifier."""
    gains: float = 0.2
    """Spread of the logarithm of each taxel's own gain."""
    silent: float = 0.05
    """Share of the taxels without a signal: dead, stuck or saturated."""
    stretch: float = 0.0
    """Largest change of speed, as a share of it, below 1."""
    damped: float = 0.5
    """Share of the sweeps in which skin and tape absorb high frequencies: a first-order low-pass with its cut-off anywhere
    in the OCTAVES below half the sampling rate."""
    colour: float = 0.3
    """Spread of the logarithm of the gain of each octave: tape and glove pass some frequencies better than others."""
    noise: float = 0.5
    """Maximum white noise, on all taxels; drawn squared, so that little of it is more common than much."""
    noisy: float = 0.0
    """Share of the taxels with white noise of their own, up to NOISY."""
    drift: float = 0.0
    """Spread of a taxel's offset at the sweep's end; it changes linearly, from the opposite value at the start."""
    hum: float = 0.0
    """Largest amplitude of a sine of any frequency, the same on all taxels."""
    clipped: float = 0.0
    """Share of the taxels that are clipped from above, anywhere within two of their own deviations of their mean."""


SLOW = Augmentation(gain=0.4, noise=0.1, silent=0.0, damped=0.0, colour=0.0)
"""For sensors that are too slow for vibrations: fingers and tape do not damp what these measure, and what they measure
depends more on force and friction."""


def augment(x: Tensor, rows: int, augmentation: Augmentation, rng: Generator) -> Tensor:
    """Sweeps float32 [B, R * C, T], varied as `augmentation` says, R being `rows`; the same for the same state of `rng`.

    x: what `Network.prepare` gives, about 1 and, where something is drawn that shows it, around 0. It is not changed.
    """
    x = _attached(x, rows, augmentation, rng)
    for change in (_stretched, _filtered, _disturbed, _clipped):
        x = change(x, augmentation, rng)
    return x


def _attached(x: Tensor, rows: int, augmentation: Augmentation, rng: Generator) -> Tensor:
    """The skin attached anew: it sits elsewhere, its gains are others, a taxel fails."""
    n, taxels, _ = x.shape
    if augmentation.shift and 1 < rows < taxels:
        by = augmentation.shift * _symmetric(rng, n, 1) * _chosen(augmentation.moved, rng, n, 1)
        source, row = torch.arange(rows) + by, torch.arange(rows)
        # what lies under the row that enters is unknown: as much as its neighbour feels, nothing, or in between
        level = torch.where((source < 0) | (source > rows - 1), torch.rand(n, rows, generator=rng), 1.0)
        near = (1 - (source.clamp(0, rows - 1)[..., None] - row).abs()).clamp(min=0)
        x = torch.bmm(near * level[..., None], x.flatten(1).unflatten(1, (rows, -1))).view(x.shape)
    gain = torch.ones(n, taxels, 1)
    if augmentation.gain:
        gain = gain * torch.exp(augmentation.gain * torch.randn(n, 1, 1, generator=rng))
    if augmentation.gains:
        gain = gain * torch.exp(augmentation.gains * torch.randn(n, taxels, 1, generator=rng))
    if augmentation.silent:
        gain = gain * ~_chosen(augmentation.silent, rng, n, taxels, 1)
    return x * gain


def _stretched(x: Tensor, augmentation: Augmentation, rng: Generator) -> Tensor:
    """At another speed; a sweep that ends too soon is continued backwards."""
    n, _, frames = x.shape
    if not augmentation.stretch or frames < 2:
        return x
    last = frames - 1
    at = last - (last - torch.arange(frames) * (1 + augmentation.stretch * _symmetric(rng, n, 1))).abs()
    left = at.floor().clamp(0, last - 1)
    take = left.long()[:, None].expand_as(x)
    return torch.lerp(x.gather(2, take), x.gather(2, take + 1), (at - left)[:, None])


def _filtered(x: Tensor, augmentation: Augmentation, rng: Generator) -> Tensor:
    """Through skin, tape and glove, which pass some frequencies better than others."""
    n, _, frames = x.shape
    if not (augmentation.damped or augmentation.colour) or frames < 2:
        return x
    frequency = 2 * torch.fft.rfftfreq(frames)  # 1 is half the sampling rate
    passed = torch.ones(n, len(frequency))
    if augmentation.damped:
        cut = torch.exp2(-OCTAVES * torch.rand(n, 1, generator=rng))
        damped = _chosen(augmentation.damped, rng, n, 1)
        passed = torch.where(damped, torch.rsqrt(1 + (frequency / cut) ** 2), passed)
    if augmentation.colour:
        octave = -torch.log2(frequency.clamp(min=frequency[1]))  # from the highest frequency downwards
        knot = octave.long()
        log_gain = augmentation.colour * torch.randn(n, int(knot.max()) + 2, generator=rng)
        passed = passed * torch.lerp(log_gain[:, knot], log_gain[:, knot + 1], octave - knot).exp()
    filtered: Tensor = torch.fft.irfft(torch.fft.rfft(x) * passed[:, None], frames)
    return filtered


def _disturbed(x: Tensor, augmentation: Augmentation, rng: Generator) -> Tensor:
    """With what the sensor itself adds: noise, an offset that moves, hum."""
    n, taxels, frames = x.shape
    if augmentation.noise or augmentation.noisy:
        level = augmentation.noise * torch.rand(n, 1, 1, generator=rng) ** 2
        own = NOISY * torch.rand(n, taxels, 1, generator=rng) * _chosen(augmentation.noisy, rng, n, taxels, 1)
        x = torch.addcmul(x, level + own, _white_noise(rng, n, taxels, frames))
    if augmentation.drift:
        end = augmentation.drift * torch.randn(n, taxels, 1, generator=rng)
        x = torch.addcmul(x, end, torch.linspace(-1, 1, frames))
    if augmentation.hum:
        amplitude = augmentation.hum * torch.rand(n, 1, 1, generator=rng) * _chosen(HUMMING, rng, n, 1, 1)
        frequency, phase = torch.rand(2, n, 1, 1, generator=rng)
        x = x + amplitude * torch.sin(2 * pi * (frequency / 2 * torch.arange(frames) + phase))
    return x


def _clipped(x: Tensor, augmentation: Augmentation, rng: Generator) -> Tensor:
    """By a converter or a skin that has reached the end of its range."""
    if not augmentation.clipped:
        return x
    n, taxels, _ = x.shape
    deviation, mean = torch.std_mean(x, 2, correction=0, keepdim=True)
    top = mean + 2 * deviation * _symmetric(rng, n, taxels, 1)
    return torch.where(_chosen(augmentation.clipped, rng, n, taxels, 1), torch.minimum(x, top), x)


def _white_noise(rng: Generator, n: int, taxels: int, frames: int) -> Tensor:
    """White noise [n, taxels, frames]: pieces of one draw, since a draw for each would take longer than all else."""
    source = torch.randn(PIECES + frames, generator=rng).unfold(0, frames, 1)
    return source[torch.randint(0, PIECES, (n, taxels), generator=rng)]


def _chosen(share: float, rng: Generator, *shape: int) -> Tensor:
    """Booleans of `shape`, each true with the probability `share`."""
    return torch.lt(torch.rand(shape, generator=rng), share)


def _symmetric(rng: Generator, *shape: int) -> Tensor:
    """Numbers of `shape`, uniform from -1 to 1."""
    return 2 * torch.rand(shape, generator=rng) - 1
