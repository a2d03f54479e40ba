"""Claims about the field that teaches all representations, and what is measured of each."""

from __future__ import annotations

import random
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from leco_plugin.capacity import measuring
from leco_plugin.capacity.evidence import Evidence
from leco_plugin.capacity.measuring import VOLUMES, lost_where, measure, taught_grid
from leco_plugin.capacity.search import grids
from leco_plugin.evaluation.inspection import ViewBox
from leco_plugin.learning.sharpening import Lesson
from leco_plugin.scenes.city.cameras import CaptureConfig
from leco_plugin.scenes.city.city import CityConfig
from leco_plugin.scenes.city.folder import write_city


def evidence(count: int = 10_000) -> Evidence:
    torch.manual_seed(0)
    worth = torch.rand(count)
    ones = torch.ones(count, dtype=torch.bool)
    return Evidence(torch.rand(count, 3), torch.arange(count), ones, worth, worth, count)


def test_a_score_that_knows_the_worth_loses_the_least() -> None:
    known = evidence()
    volume = torch.rand(10_000)
    good = measure(known, known.worth, volume, 0.01)
    blind = measure(known, torch.rand(10_000), volume, 0.01)
    # of places with worth below t, the share is t and their worth t^2 / 2 of a half
    assert good["kept_volume"] == pytest.approx(1.0 - 0.01**0.5, abs=0.02)
    assert blind["kept_volume"] == pytest.approx(0.99, abs=0.01)
    assert good["kept_candidates"] < blind["kept_candidates"]


def test_losses_at_volumes_are_those_of_the_skipped() -> None:
    known = evidence()
    losses = measure(known, known.worth, torch.rand(10_000), 0.01)["lost_at_volumes"]
    expected = [(1.0 - share) ** 2 for share in VOLUMES]
    assert losses == pytest.approx(expected, abs=0.03)
    assert losses == sorted(losses, reverse=True)


def test_a_grid_that_cannot_tell_its_cells_apart_keeps_no_more_than_is_asked_for() -> None:
    """Half of the volume has one score: of a quarter of the volume, that is half of those cells."""
    worth, scores = torch.ones(100), torch.full((100,), 0.5)
    of_volume = (torch.arange(1000) < 500) * 0.5
    found = [lost_where(worth, scores, of_volume, share) for share in (0.1, 0.25, 0.5, 0.75)]
    assert found == pytest.approx([0.8, 0.5, 0.0, 0.0], abs=1e-6)


def test_a_cell_of_a_grid_has_the_largest_target_of_the_lesson_in_it() -> None:
    mapped = torch.tensor([[-0.5, 0.5, 0.5], [-0.4, 0.6, 0.5], [0.5, -0.5, -0.5], [3.0, 0.0, 0.0]])
    targets = torch.tensor([0.2, 0.7, 0.4, 1.0])
    box = ViewBox(torch.tensor([-1.0, -0.6, -1.0]), torch.tensor([1.0, 1.4, 1.8]))
    scores = taught_grid(Lesson(mapped, 8.0 * targets, 1.0 - targets), box, 2)
    expected = torch.zeros(2, 2, 2)
    expected[0, 1, 1], expected[1, 0, 0] = 0.7, 0.4
    torch.testing.assert_close(scores, expected)


def test_a_row_says_how_long_a_representation_took(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(measuring, "seconds_now", iter([10.0, 12.5]).__next__)
    monkeypatch.setattr(measuring, "taught_grid", lambda *arguments: None)
    kept = iter([0.5, 0.4]).__next__
    monkeypatch.setattr(measuring, "measure", lambda *arguments: {"kept_volume": kept()})
    both = [(None, None, {"octree_bytes": size}) for size in (3, 7)]
    ground = SimpleNamespace(box=None, scores_of=lambda *arguments: both)
    known: Any = SimpleNamespace(ground=ground, lesson=None, held_out=None)
    (grid,) = grids((4,))
    row = measuring.measure_candidate(known, grid, 1e-3)
    dilated = {"kept_volume": 0.4, "octree_bytes": 7}
    assert row == {"family": "grid", "size": "4", "bytes": 8, "seconds": 2.5, **dilated}


def test_resuming_has_the_same_rays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also whoever has learned the field, with rays to sparse points, and whatever was drawn
    between."""
    capture = CaptureConfig(24, 18, aerial_per_block=12.0, street_per_block=0.0)
    city = write_city(CityConfig(1), tmp_path / "city", capture)
    monkeypatch.setattr(measuring, "RAYS", 128)
    monkeypatch.setattr(measuring, "TAUGHT_RAYS", 256)
    monkeypatch.setattr(measuring, "VOLUME_POINTS", 512)
    first = measuring.prepare(city, tmp_path, learn_steps=4)
    random.random()
    torch.rand(7)
    again = measuring.prepare(city, tmp_path, learn_steps=4)
    for one, other in (
        (first.lesson.mapped, again.lesson.mapped),
        (first.lesson.keep, again.lesson.keep),
        (first.held_out.positions, again.held_out.positions),
        (first.ground.volume, again.ground.volume),
    ):
        assert torch.equal(one, other)
