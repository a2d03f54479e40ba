"""Claims about what new views lose: whose surfaces count, and who loses more than was promised."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import promises
import pytest
import torch
from nerfstudio.data.datasets.base_dataset import InputDataset
from page_parts import RESULTS
from sharpening import confirmed, sharpening_sections

from leco_plugin.capacity.evidence import Evidence, Rendered
from leco_plugin.capacity.sources import find_source
from leco_plugin.cli_occupancy import occupancy_of
from leco_plugin.learning.dense import Reference, dense_reference
from leco_plugin.models.mixture import Mixture
from leco_plugin.models.rendering import Intervals, Rays
from leco_plugin.occupancy import CAMERAS_THAT_VOUCH


def test_surfaces_count_where_the_photograph_is_worse_without_them() -> None:
    """Two rays end in white, of which one photograph is black: a floater stands before it."""
    haze, surface = 0.1, 0.8
    worth = torch.tensor([0.0, surface, 0.0, surface])
    indices = torch.tensor([0, 0, 1, 1])
    known = Evidence(torch.rand(4, 3), indices, worth >= 0.0, worth + haze, worth, 2)
    with_backdrops = torch.tensor([0, 0, 0, 1, 1, 1])
    before = torch.tensor([True, True, False] * 2)
    intervals = Intervals(with_backdrops, torch.arange(6.0), torch.arange(6.0) + 1.0)
    white, truth = torch.ones(2, 3), torch.tensor([[1.0], [0.0]]).expand(2, 3)
    drawn: list[Intervals] = []

    def shade(_: Any, some: Intervals) -> Any:
        drawn.append(some)
        return SimpleNamespace(rgb=torch.zeros(2, 3))

    mixture: Any = SimpleNamespace(shade=shade)
    rays: Any = None
    found, share = confirmed(mixture, known, [Rendered(rays, intervals, before, white, truth)])
    assert drawn[0].t_starts.tolist() == [0.0, 2.0, 3.0, 5.0]
    assert found.worth.tolist() == [0.0, worth[1], 0.0, 0.0]
    assert found.weights.equal(known.weights) and share == 0.5


def test_what_photographs_confirm_is_said_of_scenes_that_store_it() -> None:
    report = json.loads((RESULTS / "sharpening.json").read_text())
    scenes = [*report["scenes"].values()]
    for found in scenes:
        found.pop("confirmed_share", None)
    assert "Photographs confirm" not in "".join(sharpening_sections(report))
    scenes[0]["confirmed_share"], scenes[1]["confirmed_share"] = 0.51, 0.64
    said = "Photographs confirm 51% to 64% of the weight on 2 scenes."
    assert said in "".join(sharpening_sections(report))


def test_a_photograph_at_its_bound_is_within_it() -> None:
    assert promises.beyond({"promised": {"bound": 2e-3}, "lost": [0.0, 2e-3, 2.1e-3]}) == 1
    row = {
        "promised": {"count": 9, "bound": 2e-3, "confidence": 0.9},
        "lost": [0.0, 3e-3, 1e-3],
        "lost_to_gate": [0.0, 1e-3, 1e-3],
        "code": {"version": "1", "commit": "abc", "sources": "def"},
        "date": "2024-02-29",
    }
    machine = {"cpu": "a", "cores": 2, "threads": 1, "device": "cpu"}
    said = "\n".join(promises.promises_section({"machine": machine, "scenes": {"town": row}}))
    assert "Of 3 test photographs on 1 scene 1 loses more of its surfaces than was promised" in said
    assert "it adds 0.2% at most" in said
    assert "| town | 0.20% | 90% | 1 of 3 | 0.10% | 0.30% |" in said


def promised_of(run: Path, scene: Path, monkeypatch: pytest.MonkeyPatch) -> Mixture:
    """What the benchmark finds of a run, whose gate is vouched for; its mixture."""
    source = find_source(occupancy_of(run), scene)
    frozen = source.mixture
    assert frozen is not None
    frozen.report[CAMERAS_THAT_VOUCH] = {"count": 2, "bound": 2e-3, "confidence": 0.6}
    monkeypatch.setattr(promises, "find_source", lambda *_: source._replace(frozen=frozen))
    return frozen


def test_what_no_ray_came_near_is_lost_but_for_backdrops(
    known_run: Path, tiny_scene: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing here was seen, and all that rays meet counts alike."""
    promised_of(known_run, tiny_scene, monkeypatch).region.seen.cells[:] = False
    backdrops: list[float] = []

    def alike(mixture: Mixture, rays: Rays) -> Reference:
        found = dense_reference(mixture, rays)
        backdrops.append(float(found.always_kept.double().mean()))
        ones = torch.ones_like(found.weights)
        return found._replace(weights=ones, near_surface=ones.bool())

    monkeypatch.setattr(promises, "dense_reference", alike)
    found = promises.row_of(known_run, tiny_scene)
    assert found["lost"] == pytest.approx([1.0 - share for share in backdrops])
    assert len(backdrops) == 2 and min(backdrops) > 0.0


def test_each_test_photograph_is_decoded_once(
    known_run: Path, tiny_scene: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    promised_of(known_run, tiny_scene, monkeypatch)
    decode, decoded = InputDataset.get_numpy_image, Counter[int]()

    def counted(dataset: InputDataset, number: int) -> Any:
        decoded[number] += 1
        return decode(dataset, number)

    monkeypatch.setattr(InputDataset, "get_numpy_image", counted)
    found = promises.row_of(known_run, tiny_scene)
    assert len(found["lost"]) == 2 and decoded == {0: 1, 1: 1}
