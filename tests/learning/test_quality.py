"""A field that shows one colour, or an occupancy that keeps everything, is said to be of no use."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from ball_occupancy import ball
from small_learner import small_mixture

from leco_plugin.evaluation.inspection import describe, doubts
from leco_plugin.learning.quality import (
    AT_END,
    FIELD,
    ONE_COLOUR,
    doubts_of_field,
    doubts_of_occupancy,
    kept_of_seen,
    psnr_of_one_colour,
)
from leco_plugin.occupancy import Occupancy
from leco_plugin.studio import run_progress
from leco_plugin.studio.run_progress import at_end


def test_one_colour_is_scored_as_the_mean_of_all_pixels() -> None:
    truth = torch.tensor([[0.0, 0.0, 0.0], [0.2, 0.2, 0.2]])
    assert psnr_of_one_colour(truth) == pytest.approx(20.0, abs=1e-4)
    assert psnr_of_one_colour(torch.full((4, 3), 0.3)) == 120.0


@pytest.mark.parametrize(("field", "said"), [(7.0, True), (11.3, True), (11.5, False)])
def test_a_field_within_one_db_of_one_colour_is_doubted(field: float, said: bool) -> None:
    lines = doubts_of_field(field, 10.4)
    assert len(lines) == (2 if said else 0)
    assert not said or ("10.4 dB" in lines[0] and "leco points" in lines[1])


def test_an_occupancy_that_keeps_most_of_what_is_seen_is_doubted() -> None:
    assert doubts_of_occupancy(0.8) == [] and "81%" in doubts_of_occupancy(0.81)[0]
    assert "93%" in doubts_of_occupancy(0.93)[0]


def test_inspection_repeats_what_was_said() -> None:
    facts = {"report": {}, "kept_share_of_box": 0.3, "seen_share_of_box": 0.33}
    assert "91%" in doubts(facts)[0]
    facts["report"] = {FIELD: 7.0, ONE_COLOUR: 10.4}
    assert "7.0 dB" in doubts(facts)[0]
    facts["report"] = {FIELD: 22.3, ONE_COLOUR: 10.4, AT_END: {FIELD: 10.9, ONE_COLOUR: 10.4}}
    assert "10.9 dB" in doubts(facts)[0]
    # a field that was poor at freezing, or another run's, has learned since
    facts["report"] = {FIELD: 11.0, ONE_COLOUR: 10.4, AT_END: {FIELD: 25.3, ONE_COLOUR: 10.4}}
    assert "91%" in doubts(facts)[0]
    facts = {"report": {FIELD: 20.0, ONE_COLOUR: 10.4}, **{k: 0.1 for k in facts if "share" in k}}
    facts["seen_share_of_box"] = 0.5
    assert doubts(facts) == []


def test_of_a_contraction_only_the_inner_cube_says_what_is_kept_of_what_is_seen() -> None:
    """Here the gate keeps half of the inner cube, just at the threshold, and nothing beyond it."""
    mixture = small_mixture()
    mixture.freeze(0.5, {})
    inner = 0.5 * 0.5 ** (1 / 3)
    mixture.occupancies = lambda mapped: 0.5 * (mapped.abs().amax(dim=-1) <= inner)  # type: ignore
    assert kept_of_seen(mixture) == pytest.approx(1 / 2, abs=0.02)
    mixture.region.space.set("box", torch.zeros(3), 4.0)
    assert kept_of_seen(mixture) == pytest.approx(1 / 16, abs=0.01)
    mixture.region.seen.cells[16:] = False  # a quarter is seen, at the side, of which none is kept
    assert kept_of_seen(mixture) == 0.0
    mixture.region.seen.cells[:] = False
    assert kept_of_seen(mixture) == 0.0


def test_what_a_run_reached_is_kept_in_its_occupancy(tmp_path: Path) -> None:
    path = tmp_path / "occupancy.safetensors"
    ball().save(path)
    for last in (10.9, None):  # None: nothing was measured
        at_end(path, last, 10.4)
        occupancy = Occupancy.load(path)
        assert "10.9 dB on unseen pixels, where one colour" in doubts(describe(occupancy))[0]
    assert occupancy.report.items() >= ball().report.items()
    assert torch.equal(occupancy.gate.head.weight, ball().gate.head.weight)
    at_end(path, 25.3, 10.4)
    assert doubts(describe(Occupancy.load(path))) == []


def test_a_full_disk_hides_no_doubts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    path = tmp_path / "occupancy.safetensors"
    ball().save(path)
    monkeypatch.setattr(Occupancy, "save", full)
    assert "7.0 dB" in doubts(describe(at_end(path, 7.0, 10.4)))[0]
    monkeypatch.undo()
    before = path.read_bytes()
    monkeypatch.setattr(run_progress, "is_first", lambda: False)
    assert "7.0 dB" in doubts(describe(at_end(path, 7.0, 10.4)))[0]
    assert path.read_bytes() == before, "another process writes"
