"""Claims about measuring an occupancy against the exact city."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch

from leco_plugin.evaluation import equal_loss
from leco_plugin.evaluation.equal_loss import compare_with_truth, free_points
from leco_plugin.scenes.city.city import CityConfig
from leco_plugin.scenes.city.folder import CaptureConfig, CityTruth, write_city

SCALE, STEP, HIGHEST = 0.02, 0.01, 1.2
NO_WALLS = torch.tensor([-1e6] * 3 + [1e6] * 3)


@pytest.fixture(autouse=True)
def few_points(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(equal_loss, "AIR_POINTS", 4000)
    monkeypatch.setattr(equal_loss, "MOST_SURFACE_POINTS", 4000)


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> CityTruth:
    folder = tmp_path_factory.mktemp("truth") / "city"
    write_city(CityConfig(blocks=1), folder, CaptureConfig(48, 36), progress=False)
    transform = torch.eye(4)[:3]
    outputs = SimpleNamespace(dataparser_transform=transform, dataparser_scale=SCALE)
    return CityTruth.from_dataparser(folder, outputs)


class Rule:
    """Keeps what a rule says, as an occupancy would."""

    threshold_value = torch.tensor(0.5)

    def __init__(self, rule) -> None:  # type: ignore[no-untyped-def]
        self.occupied = rule


def test_only_keeping_just_what_is_near_a_surface_is_perfect(truth: CityTruth) -> None:
    for rule, recall, skipped in (
        (lambda positions: truth.distance(positions) * truth.scale <= STEP, 1.0, 1.0),
        (lambda positions: torch.ones(len(positions), dtype=torch.bool), 1.0, 0.0),
        (lambda positions: torch.zeros(len(positions), dtype=torch.bool), 0.0, 1.0),
    ):
        found = compare_with_truth(Rule(rule), truth, NO_WALLS, STEP, HIGHEST)  # type: ignore
        assert found == {"kept_surface_recall": recall, "free_space_skipped": skipped}


def test_free_points_are_in_the_air_inside_the_walls(truth: CityTruth) -> None:
    walls = torch.tensor([-0.3, -0.3, -1.0, 0.3, 0.3, 0.9])
    points = free_points(truth, truth.visible_surface("test"), walls, STEP, HIGHEST)
    assert len(points) > 1000 and not bool(truth.occupied(points).any())
    assert float(points[:, 2].max()) <= 0.9 and float(points[:, :2].abs().max()) <= 0.3
    assert float((truth.distance(points) * truth.scale).min()) > STEP
