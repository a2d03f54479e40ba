"""Vector-matrix, K-planes and grid features against slow twins written from their definitions."""

from __future__ import annotations

import itertools
import math

import pytest
import torch
from torch import Tensor

from leco_plugin.models.encodings import GridEncoding, KPlanesEncoding, VectorMatrixEncoding

AXES = {"XY": (0, 1, 2), "XZ": (0, 2, 1), "YZ": (1, 2, 0)}
"""Axes along the columns and the rows of each plane, and the one that it leaves out."""


def between(points: list[Tensor], place: float) -> Tensor:
    """Linear interpolation of values at the points of an axis from -1 to 1."""
    at = (place + 1.0) / 2.0 * (len(points) - 1)
    low = min(math.floor(at), len(points) - 2)
    return (1.0 - (at - low)) * points[low] + (at - low) * points[low + 1]


def bilinear(table: Tensor, column: float, row: float) -> Tensor:
    """Values [F] of a table [F, rows, columns] at one place."""
    rows = [between(list(values.unbind(-1)), column) for values in table.unbind(1)]
    return between(rows, row)


def slow_vm(tables: list[Tensor], x: list[float]) -> Tensor:
    """TensoRF, eq. 3, before the sum over components: M^XY v^Z, M^XZ v^Y and M^YZ v^X."""
    planes, lines = tables
    return torch.cat(
        [
            bilinear(plane, x[a], x[b]) * between(list(line[..., 0].unbind(-1)), x[c])
            for plane, line, (a, b, c) in zip(planes, lines, AXES.values())
        ]
    )


def slow_k_planes(tables: list[Tensor], x: list[float]) -> Tensor:
    """K-planes, eq. 1 and 2, at each resolution."""
    levels = []
    for planes in tables:
        product = torch.ones(planes.shape[1], dtype=planes.dtype)
        for plane, (a, b, _) in zip(planes, AXES.values()):
            product = product * bilinear(plane, x[a], x[b])
        levels.append(product)
    return torch.cat(levels)


def slow_grid(tables: list[Tensor], x: list[float]) -> Tensor:
    """DVGO, eq. 4: bilinear in each layer, then between the layers."""
    (values,) = tables[0]
    return between([bilinear(layer, x[0], x[1]) for layer in values.unbind(1)], x[2])


TWINS = {"vm": slow_vm, "k-planes": slow_k_planes, "grid": slow_grid}
kinds = pytest.mark.parametrize("kind", TWINS)


def encoding_of(kind: str) -> VectorMatrixEncoding | KPlanesEncoding | GridEncoding:
    torch.manual_seed(0)
    if kind == "vm":
        return VectorMatrixEncoding(components=2, cells=5).double()
    if kind == "grid":
        return GridEncoding(features=2, cells=5).double()
    return KPlanesEncoding(levels=3, features=2, coarsest=2, finest=7).double()


def points() -> Tensor:
    """Random points, the corners, middles of edges and faces, and the centre of the cube."""
    ends = torch.tensor(list(itertools.product((-1.0, 0.0, 1.0), repeat=3)))
    return torch.cat([torch.rand(40, 3) * 2 - 1, ends]).double()


def slow(kind: str, tables: list[Tensor], x: Tensor) -> Tensor:
    return torch.stack([TWINS[kind](tables, row) for row in x.tolist()])


@kinds
def test_features_are_those_of_the_definition(kind: str) -> None:
    encoding, x = encoding_of(kind), points()
    expected = slow(kind, [table.detach() for table in encoding.parameters()], x)
    assert expected.shape == (len(x), encoding.out_dim)
    torch.testing.assert_close(encoding(x), expected, rtol=0, atol=1e-12)


@kinds
def test_gradients_are_those_of_the_definition(kind: str) -> None:
    encoding, x = encoding_of(kind), points()
    weights = torch.randn(len(x), encoding.out_dim, dtype=torch.float64)
    (encoding(x) * weights).sum().backward()
    tables = [table.detach().clone().requires_grad_() for table in encoding.parameters()]
    (slow(kind, tables, x) * weights).sum().backward()
    for fast, table in zip(encoding.parameters(), tables):
        torch.testing.assert_close(fast.grad, table.grad, rtol=0, atol=1e-12)


@kinds
def test_float32_features_are_those_of_float64(kind: str) -> None:
    encoding, x = encoding_of(kind), points()
    exact = encoding(x)
    torch.testing.assert_close(encoding.float()(x.float()).double(), exact, rtol=0, atol=1e-5)


@kinds
def test_each_end_of_the_cube_has_an_entry_of_its_own(kind: str) -> None:
    encoding = encoding_of(kind)
    corners = torch.tensor(list(itertools.product((-1.0, 1.0), repeat=3)))
    features = encoding(corners)
    assert len(features.unique(dim=0)) == 8
    torch.testing.assert_close(encoding(corners * 3.0), features)


@kinds
def test_positions_receive_no_gradient(kind: str) -> None:
    x = points().requires_grad_()
    encoding_of(kind)(x).sum().backward()
    assert x.grad is None


@kinds
def test_no_points_give_no_features_and_a_zero_gradient(kind: str) -> None:
    encoding = encoding_of(kind)
    features = encoding(torch.zeros(0, 3))
    features.sum().backward()
    assert features.shape == (0, encoding.out_dim)
    assert not any(bool(table.grad.any()) for table in encoding.parameters())


@kinds
def test_features_are_float32_under_autocast(kind: str) -> None:
    encoding, x = encoding_of(kind).float(), points().float()
    expected = encoding(x)
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(encoding(x), expected)


def test_resolutions_grow_evenly_from_the_coarsest_to_the_finest() -> None:
    assert KPlanesEncoding(4, 1, 16, 128).resolutions == [16, 32, 64, 128]
    assert KPlanesEncoding(1, 1, 16, 128).resolutions == [16]


def test_products_do_not_vanish_at_first() -> None:
    """A factor near zero would keep the gradient from the other two."""
    torch.manual_seed(0)
    x = torch.rand(1000, 3) * 2 - 1
    features = KPlanesEncoding(levels=8, features=2, coarsest=16, finest=128)(x).detach()
    assert 0.7 < float(features.min()) < float(features.max()) < 1.4
    assert float(features.std(dim=0).min()) > 0.02
    features = VectorMatrixEncoding(components=8, cells=128)(x).detach()
    assert float(features.std(dim=0).min()) > 1e-3
