"""The fused gate decides as `Occupancy.occupied` does, but for places near the threshold."""

from __future__ import annotations

import pytest
import torch
from samplers.kernel_cases import (
    DEVICE,
    INTERPRETED,
    NEAR_THRESHOLD,
    ON_KERNELS,
    PLACES,
    left_to_torch,
    occupancy,
    positions,
)

from leco_plugin.occupancy import Occupancy
from leco_plugin.samplers.kernels.fused import twins_only
from leco_plugin.samplers.kernels.gate_weights import gate_weights

pytestmark = ON_KERNELS

WIDTHS = [16, 24, 100, 256] if INTERPRETED else [16, 24, 32, 64, 100, 128, 256]
OCTAVES = [1, 6, 12] if INTERPRETED else [1, 4, 6, 8, 10, 12]
"""Of what is padded alike, the interpreter gets one; all other tests have width 32, 4 octaves."""


EVERY = 7 if INTERPRETED else 1


def fused(asked: Occupancy, places: torch.Tensor) -> torch.Tensor:
    from leco_plugin.samplers.kernels.gate_kernel import gate_decisions

    if reason := left_to_torch(asked):
        pytest.skip(reason)
    return gate_decisions(gate_weights(asked), places)


def twin(asked: Occupancy, places: torch.Tensor) -> torch.Tensor:
    with twins_only():
        return asked.occupied(places)


def differing(asked: Occupancy, places: torch.Tensor) -> torch.Tensor:
    """Where the kernel decides otherwise than its twin; nowhere but near the threshold."""
    ours = fused(asked, places)
    assert ours.dtype == torch.bool and ours.shape == (len(places),)
    found = ours != twin(asked, places)
    distances = (asked.query(places) - asked.threshold_value).abs()[found]
    assert (distances <= NEAR_THRESHOLD[asked.precision]).all(), distances.max()
    return found


def assert_agreement(asked: Occupancy, places: torch.Tensor) -> None:
    assert differing(asked, places).float().mean() < 0.02
    assert 0.02 < twin(asked, places).float().mean() < 0.98


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
@pytest.mark.parametrize("width", WIDTHS)
def test_every_width(width: int, precision: str) -> None:
    assert_agreement(occupancy(precision=precision, width=width), positions(PLACES))


@pytest.mark.parametrize("kind", ["box", "contraction"])
@pytest.mark.parametrize("layers", [1, 2, 3, 5])
def test_every_depth_in_both_spaces(layers: int, kind: str) -> None:
    assert_agreement(occupancy(kind, layers=layers), positions(PLACES))


@pytest.mark.parametrize("kind", ["box", "contraction"])
def test_unseen_space_is_skipped(kind: str) -> None:
    asked, places = occupancy(kind, unseen=True), positions(PLACES)
    mapped = asked.space.map(places)
    unseen = ~asked.seen(mapped.clamp(-1.0, 1.0)) & (mapped.abs() <= 1.0).all(dim=-1)
    assert_agreement(asked, places)
    assert unseen.sum() > PLACES // 10 and not fused(asked, places)[unseen].any()


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
@pytest.mark.parametrize("octaves", OCTAVES)
def test_every_number_of_octaves(octaves: int, precision: str) -> None:
    asked = occupancy("contraction", precision, octaves=octaves)
    assert_agreement(asked, positions(PLACES))


@pytest.mark.parametrize("experts", [1, 8, 15, 20])
def test_every_number_of_experts(experts: int) -> None:
    assert_agreement(occupancy(experts=experts), positions(PLACES))


@pytest.mark.parametrize("count", [0, 1, 2, 127, 128, 129, 300])
def test_ends_are_ragged(count: int) -> None:
    asked = occupancy(precision="float32")
    places = positions(count)
    assert int(differing(asked, places).sum()) <= 1


@pytest.mark.parametrize("kind", ["box", "contraction"])
def test_places_that_no_scene_has(kind: str) -> None:
    asked = occupancy(kind, "float32")
    odd = [0.0, -0.0, 0.1, 1.6, -1.4, 1e6, -1e20, 1e38, 3e38, torch.inf, -torch.inf, torch.nan]
    # every seventh still has all pairs of values on all pairs of axes
    places = torch.cartesian_prod(*[torch.tensor(odd, device=DEVICE)] * 3)[::EVERY]
    assert torch.equal(fused(asked, places), twin(asked, places))


def test_what_lies_beyond_the_walls_is_skipped() -> None:
    asked = occupancy(precision="float32", walls=[-1.0, -1.0, -1.0, 0.5, 0.5, 0.5])
    places = positions(PLACES, 1.0)
    beyond = (places > 0.5).any(dim=-1)
    assert not fused(asked, places)[beyond].any()
    assert torch.equal(fused(asked, places), twin(asked, places))


@pytest.mark.parametrize("threshold", [0.0, 1.0])
def test_the_ends_of_the_threshold(threshold: float) -> None:
    asked = occupancy(precision="float32")
    asked.threshold_value.fill_(threshold)
    places = torch.cat([positions(PLACES), torch.full((1, 3), torch.nan, device=DEVICE)])
    assert torch.equal(fused(asked, places), twin(asked, places))
    assert bool(fused(asked, places).all()) == (threshold == 0.0)


def test_positions_may_have_any_strides() -> None:
    asked = occupancy(precision="float32")
    places = positions(PLACES)
    column_by_column = places.T.contiguous().T
    assert column_by_column.stride() == (1, PLACES)
    assert torch.equal(fused(asked, column_by_column), fused(asked, places))
    assert torch.equal(fused(asked, places[::3]), fused(asked, places)[::3])


def test_saturated_gates_overflow_nothing() -> None:
    asked = occupancy(precision="float32")
    with torch.no_grad():
        asked.gate.head.weight.mul_(1e4)
    asked.threshold_value.fill_(0.5)
    assert torch.equal(fused(asked, positions(PLACES)), twin(asked, positions(PLACES)))
