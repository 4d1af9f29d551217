"""The room of augmentation. In: prepared sweeps and a Augmentation, which says what varies. Out: the same sweeps as another
scene would have given them: the skin put on anew, slid at another speed, read by a worse amplifier.

Everything is drawn anew for every sweep, from one generator. A knob at 0 draws nothing and changes nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import pi

import torch
from torch import Generator, Tensor

OCTAVES = 5.0
"""How far below half the sampling rate the cut-off of a damped sweep may lie: at 750 Hz it is 12 to 375 Hz."""
NOISY = 4.0
"""Most noise of a noisy taxel."""
HUMMING = 0.25
"""Share of the sweeps that hum, where any do."""
PIECES = 1 << 16
"""Places at which the noise of a taxel may start in the one draw of a batch."""


@dataclass(frozen=True)
class Augmentation:
    """What varies in a scene; 0 is off. Spreads are standard deviations; amplitudes are in deviations of all taxels
    together, which `Network.prepare` makes 1.

    What is not 0 by default came out ahead, in single runs, on simulated sweeps at 750 Hz (T-REAL and T-HARD, seeds 301
    to 399). The rest did not there: the network's front deals with hum, drift and noisy taxels at less cost.
    """

    shift: float = 1.0
    """Farthest that the skin sits from its place, forth or back along the rows, in rows; any part of one is as likely,
    and read between its neighbours. What comes in over the edge carries between nothing and all of what the edge feels.
    A line of taxels is not moved."""
    moved: float = 0.5
    """Share of the sweeps that are moved so."""
    gain: float = 0.2
    """Spread of the logarithm of the gain of all taxels together: force, skin, amplifier."""
    gains: float = 0.2
    """Spread of the logarithm of each taxel's own gain."""
    silent: float = 0.05
    """Share of the taxels that say nothing: dead, stuck or saturated."""
    stretch: float = 0.0
    """Largest change of speed, as a share of it, below 1."""
    damped: float = 0.5
    """Share of the sweeps in which skin and tape swallow high rates: a first-order low-pass with its cut-off anywhere
    in the OCTAVES below half the sampling rate."""
    colour: float = 0.3
    """Spread of the logarithm of the gain of each octave: tape and glove pass some rates better than others."""
    noise: float = 0.5
    """Most white noise, on all taxels; drawn squared, so that little of it is more common than much."""
    noisy: float = 0.0
    """Share of the taxels with white noise of their own, up to NOISY."""
    drift: float = 0.0
    """Spread of a taxel's offset at the sweep's end; it gets there in a line, from the opposite at the start."""
    hum: float = 0.0
    """Largest amplitude of a sine of any rate, the same on all taxels."""
    clipped: float = 0.0
    """Share of the taxels that are cut off above, anywhere within two of their own deviations of their mean."""


SLOW = Augmentation(gain=0.4, noise=0.1, silent=0.0, damped=0.0, colour=0.0)
"""For sensors that are too slow for vibrations: what fingers and tape do to those does not concern them, and what lies
below says more of force and friction."""


def vary(x: Tensor, rows: int, scene: Augmentation, rng: Generator) -> Tensor:
    """Sweeps float32 [B, R * C, T] as `scene` may give them, R being `rows`; the same of the same `rng`.

    x: what `Network.prepare` gives, about 1 and, where something is drawn that shows it, around 0. It is left as it is.
    """
    x = _put_on(x, rows, scene, rng)
    for change in (_slid, _passed, _disturbed, _cut_off):
        x = change(x, scene, rng)
    return x


def _put_on(x: Tensor, rows: int, scene: Augmentation, rng: Generator) -> Tensor:
    """The skin is put on anew: it sits elsewhere, its gains are others, a taxel fails."""
    n, taxels, _ = x.shape
    if scene.shift and 1 < rows < taxels:
        by = scene.shift * _even(rng, n, 1) * _share(scene.moved, rng, n, 1)
        source, row = torch.arange(rows) + by, torch.arange(rows)
        # nobody knows what lies under the row that comes in: as much as its neighbour feels, nothing, or between
        level = torch.where((source < 0) | (source > rows - 1), torch.rand(n, rows, generator=rng), 1.0)
        near = (1 - (source.clamp(0, rows - 1)[..., None] - row).abs()).clamp(min=0)
        x = torch.bmm(near * level[..., None], x.flatten(1).unflatten(1, (rows, -1))).view(x.shape)
    gain = torch.ones(n, taxels, 1)
    if scene.gain:
        gain = gain * torch.exp(scene.gain * torch.randn(n, 1, 1, generator=rng))
    if scene.gains:
        gain = gain * torch.exp(scene.gains * torch.randn(n, taxels, 1, generator=rng))
    if scene.silent:
        gain = gain * ~_share(scene.silent, rng, n, taxels, 1)
    return x * gain


def _slid(x: Tensor, scene: Augmentation, rng: Generator) -> Tensor:
    """At another speed; past its end a sweep runs back."""
    n, _, frames = x.shape
    if not scene.stretch or frames < 2:
        return x
    last = frames - 1
    at = last - (last - torch.arange(frames) * (1 + scene.stretch * _even(rng, n, 1))).abs()
    left = at.floor().clamp(0, last - 1)
    take = left.long()[:, None].expand_as(x)
    return torch.lerp(x.gather(2, take), x.gather(2, take + 1), (at - left)[:, None])


def _passed(x: Tensor, scene: Augmentation, rng: Generator) -> Tensor:
    """Through skin, tape and glove, which pass on some rates better than others."""
    n, _, frames = x.shape
    if not (scene.damped or scene.colour) or frames < 2:
        return x
    rate = 2 * torch.fft.rfftfreq(frames)  # 1 is half the sampling rate
    passed = torch.ones(n, len(rate))
    if scene.damped:
        cut = torch.exp2(-OCTAVES * torch.rand(n, 1, generator=rng))
        passed = torch.where(_share(scene.damped, rng, n, 1), torch.rsqrt(1 + (rate / cut) ** 2), passed)
    if scene.colour:
        octave = -torch.log2(rate.clamp(min=rate[1]))  # from the highest rate downward
        knot = octave.long()
        log_gain = scene.colour * torch.randn(n, int(knot.max()) + 2, generator=rng)
        passed = passed * torch.lerp(log_gain[:, knot], log_gain[:, knot + 1], octave - knot).exp()
    return torch.fft.irfft(torch.fft.rfft(x) * passed[:, None], frames)


def _disturbed(x: Tensor, scene: Augmentation, rng: Generator) -> Tensor:
    """By what the sensor adds of its own: noise, an offset that moves, hum."""
    n, taxels, frames = x.shape
    if scene.noise or scene.noisy:
        level = scene.noise * torch.rand(n, 1, 1, generator=rng) ** 2
        own = NOISY * torch.rand(n, taxels, 1, generator=rng) * _share(scene.noisy, rng, n, taxels, 1)
        x = torch.addcmul(x, level + own, _white(rng, n, taxels, frames))
    if scene.drift:
        end = scene.drift * torch.randn(n, taxels, 1, generator=rng)
        x = torch.addcmul(x, end, torch.linspace(-1, 1, frames))
    if scene.hum:
        amplitude = scene.hum * torch.rand(n, 1, 1, generator=rng) * _share(HUMMING, rng, n, 1, 1)
        rate, phase = torch.rand(2, n, 1, 1, generator=rng)
        x = x + amplitude * torch.sin(2 * pi * (rate / 2 * torch.arange(frames) + phase))
    return x


def _cut_off(x: Tensor, scene: Augmentation, rng: Generator) -> Tensor:
    """By a converter or a skin that has come to its end."""
    if not scene.clipped:
        return x
    n, taxels, _ = x.shape
    deviation, mean = torch.std_mean(x, 2, correction=0, keepdim=True)
    top = mean + 2 * deviation * _even(rng, n, taxels, 1)
    return torch.where(_share(scene.clipped, rng, n, taxels, 1), torch.minimum(x, top), x)


def _white(rng: Generator, n: int, taxels: int, frames: int) -> Tensor:
    """White noise [n, taxels, frames]: pieces of one draw, since a draw for each would take longer than all else."""
    source = torch.randn(PIECES + frames, generator=rng).unfold(0, frames, 1)
    return source[torch.randint(0, PIECES, (n, taxels), generator=rng)]


def _share(share: float, rng: Generator, *shape: int) -> Tensor:
    return torch.rand(shape, generator=rng) < share


def _even(rng: Generator, *shape: int) -> Tensor:
    return 2 * torch.rand(shape, generator=rng) - 1
