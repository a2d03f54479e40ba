"""The space mapping is invertible, fills its cube, and leaves the inner cube as it is."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from leco_plugin.space import Space, contract, uncontract

SEEDS = st.integers(0, 2**16)


def points(seed: int, spread: float) -> torch.Tensor:
    """[64, 3] float64, from near the origin to some 10^spread away."""
    generator = torch.Generator().manual_seed(seed)
    directions = torch.randn(64, 3, generator=generator, dtype=torch.float64)
    exponents = torch.rand(64, 1, generator=generator, dtype=torch.float64) * 2 - 1
    return directions * 10 ** (spread * exponents)


@settings(deadline=None, max_examples=50)
@given(seed=SEEDS)
def test_uncontract_is_the_inverse_of_contract(seed: int) -> None:
    x = points(seed, 3.0)
    torch.testing.assert_close(uncontract(contract(x)), x, rtol=1e-7, atol=1e-12)


@settings(deadline=None, max_examples=50)
@given(seed=SEEDS)
def test_contraction_stays_in_the_cube_of_half_width_2(seed: int) -> None:
    assert float(contract(points(seed, 12.0)).abs().max()) <= 2.0


@settings(deadline=None, max_examples=50)
@given(seed=SEEDS)
def test_contraction_leaves_the_inner_cube_as_it_is(seed: int) -> None:
    x = points(seed, 0.0).clamp(-1.0, 1.0)
    assert torch.equal(contract(x), x)


def test_contraction_keeps_gradients_finite_everywhere() -> None:
    x = torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0], [1e6, 0.0, 0.0]], requires_grad=True)
    contract(x).sum().backward()
    assert x.grad is not None and bool(x.grad.isfinite().all())


def test_faces_of_the_cube_lead_back_to_finite_points() -> None:
    assert bool(uncontract(torch.tensor([[2.0, 0.0, 0.0], [2.0, 2.0, -2.0]])).isfinite().all())


@pytest.mark.parametrize("kind", ["box", "contraction"])
def test_unmap_is_the_inverse_of_map(kind) -> None:
    space = Space(kind, (1.0, -2.0, 3.0), 4.0).double()
    x = points(0, 2.0)
    torch.testing.assert_close(space.unmap(space.map(x)), x, rtol=1e-6, atol=1e-9)


def test_a_box_maps_its_corners_to_the_cube_and_clips_nothing() -> None:
    space = Space("box", (1.0, 1.0, 1.0), 2.0)
    x = torch.tensor([[3.0, -1.0, 1.0], [7.0, 1.0, 1.0]])
    assert space.map(x).tolist() == [[1.0, -1.0, 0.0], [3.0, 0.0, 0.0]]


def test_a_contraction_maps_all_space_into_the_cube() -> None:
    assert float(Space("contraction", half_extent=0.1).map(points(1, 6.0).float()).abs().max()) <= 1


def test_a_space_travels_with_a_state_dict() -> None:
    space, other = Space("contraction", (1.0, 2.0, 3.0), 4.0), Space()
    other.load_state_dict(space.state_dict())
    x = points(2, 1.0).float()
    assert other.kind == "contraction" and torch.equal(other.map(x), space.map(x))


def test_a_space_can_be_set_from_each_kind_to_the_other() -> None:
    space = Space()
    for kind in ("contraction", "box"):
        space.set(kind, torch.ones(3), 2.0)
        assert space.kind == kind


@pytest.mark.parametrize("half_extent", [0.0, -1.0, float("nan"), float("inf")])
def test_a_half_extent_that_is_not_positive_and_finite_is_refused(half_extent: float) -> None:
    with pytest.raises(ValueError, match="half extent"):
        Space("box", half_extent=half_extent)


def test_infinitely_far_points_have_no_place() -> None:
    far = contract(torch.tensor([[1e30, 0.0, 0.0], [torch.inf, 0.0, 0.0]]))
    assert far[0, 0] == 2.0 and bool(far[1, 0].isnan())
