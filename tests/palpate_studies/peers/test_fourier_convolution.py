"""The convolution by the Fourier transform against PyTorch's direct one."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch.nn import functional

from palpate_studies.peers import paper_cnn
from palpate_studies.peers.fourier_convolution import convolve

SHAPES = [
    (150, 16, 15, 5),
    (31, 4, 15, 5),
    (11, 4, 3, 5),
    (16, 3, 1, 3),
    (4, 2, 15, 5),
    (7, 1, 5, 1),
]
"""Rows and columns of images and of kernels; some kernels are larger than their image."""


@pytest.mark.parametrize("shape", SHAPES)
def test_images_and_gradients_are_those_of_the_direct_sum(shape: tuple[int, ...]) -> None:
    """Up to rounding, for each size of image and odd kernel."""
    rows, cols, high, wide = shape
    rng = torch.Generator().manual_seed(1)
    x = torch.randn(3, 2, rows, cols, generator=rng, dtype=torch.float64, requires_grad=True)
    weight = torch.randn(4, 2, high, wide, generator=rng, dtype=torch.float64, requires_grad=True)
    direct = functional.conv2d(x, weight, padding=(high // 2, wide // 2))
    quick = convolve(x, weight)
    torch.testing.assert_close(quick, direct)
    gradient = torch.randn(direct.shape, generator=rng, dtype=torch.float64)
    for one, other in zip(
        torch.autograd.grad(quick, (x, weight), gradient),
        torch.autograd.grad(direct, (x, weight), gradient),
        strict=True,
    ):
        torch.testing.assert_close(one, other)


def test_the_papers_network_trains_by_it_and_answers_directly(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """In training it takes the place of the second convolution alone, with the same features; the
    finished network, which is exported, has PyTorch's convolutions."""
    rng = np.random.default_rng(0)
    samples = rng.integers(0, 255, (4, 60, 4, 4)).astype(np.uint8)
    layers = paper_cnn.ImageLayers((8, 4), ((1, 1), (1, 1)), 4, False, 8)
    format = paper_cnn.SweepFormat(4, 4, 750.0, 60, "uint8")
    torch.manual_seed(0)
    network = paper_cnn.build_paper_cnn(format, 3, samples, layers)
    prepared = network.prepare(torch.from_numpy(samples.astype(np.float32)))
    calls: list[int] = []

    def counted(x: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
        calls.append(len(weight))
        return convolve(x, weight)

    monkeypatch.setattr(paper_cnn.fourier_convolution, "convolve", counted)
    direct = network.eval().features(prepared)
    assert calls == []
    torch.testing.assert_close(network.train().features(prepared), direct, atol=1e-4, rtol=1e-4)
    assert calls == [4]
