"""The encodings against slow twins written from their definitions."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from leco_plugin.models.encodings import EncodingConfig, HashEncoding, build_encoding

PRIMES = (1, 2654435761, 805459861)


def slow_frequency(x: list[float], octaves: int) -> list[float]:
    """NeRF, eq. 4."""
    angles = [2.0**k * math.pi * value for k in range(octaves) for value in x]
    return [*x, *map(math.sin, angles), *map(math.cos, angles)]


def slow_hash(encoding: HashEncoding, x: list[float], table: Tensor) -> Tensor:
    """Instant-NGP, section 3, interpolated over a tetrahedron, for one point in [-1, 1]^3."""
    size, parts = encoding.mask + 1, []
    for level, resolution in enumerate(encoding.resolutions.tolist()):
        cell = [(value * 0.5 + 0.5) * resolution for value in x]
        base = [math.floor(value) for value in cell]
        inside = [value - low for value, low in zip(cell, base)]
        walk = sorted(range(3), key=lambda axis: -inside[axis])
        heights = [1.0, *(inside[axis] for axis in walk), 0.0]
        corner, total = list(base), torch.zeros(table.shape[1], dtype=table.dtype)
        for step in range(4):
            number = corner[0] * PRIMES[0] ^ corner[1] * PRIMES[1] ^ corner[2] * PRIMES[2]
            weight = heights[step] - heights[step + 1]
            total = total + weight * table[level * size + number % size]
            if step < 3:
                corner[walk[step]] += 1
        parts.append(total)
    return torch.cat(parts)


def hash_encoding() -> HashEncoding:
    torch.manual_seed(0)
    encoding = HashEncoding(levels=3, features=2, log2_table=6, coarsest=4, finest=50)
    return encoding.double()


def test_resolutions_grow_evenly_from_the_coarsest_to_the_finest() -> None:
    assert HashEncoding(4, 1, 4, 16, 128).resolutions.tolist() == [16, 32, 64, 128]
    assert HashEncoding(1, 1, 4, 16, 128).resolutions.tolist() == [16]


def test_frequencies_are_those_of_the_definition() -> None:
    x = (torch.rand(50, 3) * 2 - 1).double()
    encoding = build_encoding(EncodingConfig(octaves=5)).double()
    expected = torch.tensor([slow_frequency(row, 5) for row in x.tolist()], dtype=torch.float64)
    assert encoding(x).shape == (50, encoding.out_dim)
    torch.testing.assert_close(encoding(x), expected, rtol=0, atol=1e-5)  # scales are float32


def test_doubled_octaves_are_as_exact_as_their_angles() -> None:
    x = torch.rand(5000, 3) * 2 - 1
    encoding = build_encoding(EncodingConfig(octaves=12))
    angles = (x[:, None, :] * encoding.scales[:, None]).flatten(1)
    direct = torch.cat([x, angles.sin(), angles.cos()], dim=-1)
    exact = build_encoding(EncodingConfig(octaves=12)).double()
    exact.scales.copy_(math.pi * 2.0 ** torch.arange(12, dtype=torch.float64))
    truth = exact(x.double())
    error, bound = (encoding(x) - truth).abs().max(), (direct - truth).abs().max()
    assert float(error) < 1.5 * float(bound) < 1e-3


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_octaves_in_halves_are_nearly_the_rounded_ones(dtype) -> None:
    x = torch.rand(5000, 3) * 2 - 1
    encoding = build_encoding(EncodingConfig(octaves=8))
    features, exact = encoding(x, dtype), encoding(x)
    assert features.dtype == dtype
    error, rounding = (features - exact).abs().max(), (exact.to(dtype) - exact).abs().max()
    assert float(error) < 1.34 * float(rounding)


def test_hash_features_are_those_of_the_definition() -> None:
    encoding, x = hash_encoding(), torch.rand(40, 3) * 2 - 1
    x = torch.cat([x, torch.tensor([[-1.0] * 3, [1.0] * 3, [0.0] * 3])])
    table = encoding.table.detach()
    expected = torch.stack([slow_hash(encoding, row, table) for row in x.tolist()])
    torch.testing.assert_close(encoding(x), expected, rtol=0, atol=1e-8)


def test_hash_gradients_are_those_of_the_definition() -> None:
    encoding, x = hash_encoding(), torch.rand(40, 3) * 2 - 1
    weights = torch.randn(40, encoding.out_dim, dtype=torch.float64)
    (encoding(x) * weights).sum().backward()
    table = encoding.table.detach().requires_grad_()
    slow = torch.stack([slow_hash(encoding, row, table) for row in x.tolist()])
    (slow * weights).sum().backward()
    torch.testing.assert_close(encoding.table.grad, table.grad, rtol=0, atol=1e-5)


def test_no_points_give_no_features_and_a_zero_gradient() -> None:
    encoding = hash_encoding()
    features = encoding(torch.zeros(0, 3))
    features.sum().backward()
    assert features.shape == (0, encoding.out_dim)
    assert encoding.table.grad is not None and not bool(encoding.table.grad.any())


def test_frequencies_have_the_gradient_of_the_definition() -> None:
    encoding = build_encoding(EncodingConfig(octaves=3)).double()
    x = (torch.rand(10, 3) * 2 - 1).double().requires_grad_()
    assert torch.autograd.gradcheck(encoding, x)
    torch.testing.assert_close(encoding(x), encoding(x.detach()), rtol=0, atol=1e-12)
