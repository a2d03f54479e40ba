"""Claims about comparing representations where all lose equally much."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from leco_plugin.evaluation import equal_loss
from leco_plugin.evaluation.equal_loss import at_equal_loss, grid_of_field, threshold_losing
from leco_plugin.models.calibration import CalibrationConfig
from leco_plugin.models.encodings import EncodingConfig
from leco_plugin.models.field import FieldConfig
from leco_plugin.models.gate import GateConfig
from leco_plugin.models.hmoe import HMoEConfig
from leco_plugin.models.leco import LecoModel, LecoModelConfig
from leco_plugin.models.rendering import Rays
from leco_plugin.models.sizes import Sizes
from leco_plugin.scenes.bounds import SceneBounds


def slow_threshold(weights: Tensor, scores: Tensor, lost: float) -> float:
    """The largest of the scores that is a threshold within the loss."""
    allowed = lost * float(weights.double().sum())
    return max(
        float(score)
        for score in scores
        if float(weights.double()[scores < score].sum()) <= allowed + 1e-12
    )


@settings(deadline=None)
@given(st.integers(0, 10_000), st.sampled_from([0.0, 1e-3, 0.1, 0.5]), st.integers(1, 8))
def test_the_threshold_is_the_largest_within_the_loss(seed: int, lost: float, levels: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    weights = torch.rand(40, generator=generator)
    scores = torch.randint(levels, (40,), generator=generator).float()  # with ties
    expected = slow_threshold(weights, scores, lost)
    assert threshold_losing(weights, scores, lost) == expected


BOUNDS = SceneBounds(
    "box", torch.zeros(3), 1.0, 0.1, 4.0, torch.tensor([-0.5, -0.5, -0.25, 0.5, 0.5, 0.25]), "test"
)


@pytest.fixture
def model(monkeypatch: pytest.MonkeyPatch) -> LecoModel:
    """A model whose field is dense, and whose gate says so, where x > 0 and nowhere else."""
    sizes = Sizes(
        gate=GateConfig(EncodingConfig(octaves=1), width=4, layers=1, scene_experts=2),
        field=FieldConfig(
            EncodingConfig("hash", levels=1, log2_table=4), HMoEConfig(2, width=4, layers=1)
        ),
        candidates=64,
    )
    config = LecoModelConfig(sizes=sizes, calibration=CalibrationConfig(rays_at_once=32))
    torch.manual_seed(0)
    made = LecoModel(config, scene_box=None, num_train_data=1)  # type: ignore[arg-type]
    made.set_bounds(BOUNDS, 1.0)

    def gate(mapped: Tensor) -> Tensor:
        occupied = 20.0 * (mapped[:, 0] > 0.0)
        return torch.stack([10.0 - occupied, torch.zeros_like(occupied), occupied - 10.0], dim=-1)

    def density(mapped: Tensor, *_: Tensor) -> tuple[Tensor, Tensor]:
        return 30.0 * (mapped[:, 0] > 0.0), torch.zeros(len(mapped), 4)

    monkeypatch.setattr(made.gate, "forward", gate)
    monkeypatch.setattr(made.field, "density", density)
    made.report = {"aabb": BOUNDS.aabb.tolist()}
    origins = torch.tensor([[-2.0, 0.0, 0.0]]).expand(50, 3)
    aims = torch.stack([torch.full((50,), 2.0), *(0.1 * torch.randn(2, 50))], dim=-1)
    directions = torch.nn.functional.normalize(aims, dim=-1)
    rays = Rays(origins, directions, torch.full((50,), 1.5), torch.full((50,), 2.5), None)
    monkeypatch.setattr(equal_loss, "calibration_rays", lambda *_: (rays, torch.zeros(50, 3)))
    return made


def test_a_perfect_gate_keeps_the_occupied_half_of_the_box(model: LecoModel) -> None:
    found = at_equal_loss(model.train(), None)
    assert found["lost_surface_mass"] == 1e-3 and found["grids"] == []
    assert found["kept_volume"] == pytest.approx(0.5, abs=0.01)
    assert 0.3 < found["kept_candidates"] < 0.6
    assert model.training


def test_a_grid_made_from_the_field_keeps_its_cells(model: LecoModel) -> None:
    grid = grid_of_field(model, 5)
    torch.testing.assert_close(grid.aabbs[0], BOUNDS.aabb)  # the walls, not the whole cube
    kept = grid.values(torch.tensor([[0.3, 0.0, 0.0], [-0.3, 0.0, 0.0], [0.7, 0.0, 0.0]])) > 0
    assert kept.tolist() == [True, False, False]


def test_grids_are_measured_like_the_gate(
    model: LecoModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(equal_loss, "GRID_UPDATES", 20)  # enough to see both halves of a cell
    even, odd = at_equal_loss(model, None, grids=(4, 5))["grids"]
    assert (even["resolution"], even["bytes"]) == (4, 8)
    assert (odd["resolution"], odd["bytes"]) == (5, 16)
    assert even["kept_volume"] == pytest.approx(0.5, abs=0.01)
    # the cells in the middle hold both, and a surface in them
    assert odd["kept_volume"] == pytest.approx(0.6, abs=0.01)
    assert even["update_seconds"] > 0.0
