"""Claims about which scene experts leave a field, on one whose experts are known."""

from __future__ import annotations

import copy
import io
from dataclasses import replace
from typing import Any

import pytest
import torch
from small_learner import ARun, NoPixels, small_learner

from leco_plugin.learning.dense import evaluating, near_median_depth
from leco_plugin.learning.merging import Merging, MergingConfig, Trial, find_unneeded, line_of
from leco_plugin.models.encodings import EncodingConfig
from leco_plugin.models.field import FieldConfig
from leco_plugin.models.gate import GateConfig
from leco_plugin.models.hmoe import HMoEConfig
from leco_plugin.models.mixture import Mixture
from leco_plugin.models.rendering import Intervals, Rays, Routing
from leco_plugin.models.sizing.sizes import Sizes

BOUND, AT_ONCE = 0.01, 64
SIZES = Sizes(
    gate=GateConfig(EncodingConfig(octaves=1), width=8, layers=1, scene_experts=4),
    field=FieldConfig(
        EncodingConfig(kind="hash", levels=2, log2_table=8), HMoEConfig(4, width=16, layers=1)
    ),
    candidates=24,
)


def make() -> Mixture:
    return Mixture(SIZES, 3, "float32", Routing(0.2, False))


@pytest.fixture
def mixture() -> Mixture:
    """Frozen; its experts 2 and 3 add nothing, the first and the last one a lot."""
    torch.manual_seed(0)
    mixture = make()
    torch.nn.init.normal_(mixture.gate.head.weight, std=2.0)
    torch.nn.init.normal_(mixture.field.encoding.table, std=1.0)
    for number in (1, 4):
        for parameter in mixture.field.experts.experts[number].parameters():
            torch.nn.init.normal_(parameter, std=1.0)
    mixture.freeze(0.0, {})
    return mixture.train()


def some_rays(count: int = 200) -> Rays:
    torch.manual_seed(1)
    directions = torch.nn.functional.normalize(torch.randn(count, 3), dim=-1)
    ends = torch.full((count,), 1.5)
    return Rays(-0.5 * directions, directions, torch.full((count,), 0.05), ends, None)


def dense(mixture: Mixture, rays: Rays) -> Intervals:
    return mixture.with_backdrops(rays, mixture.candidates(rays))


def image(mixture: Mixture) -> torch.Tensor:
    rays = some_rays()
    with evaluating(mixture), torch.no_grad():
        return mixture.shade(rays, dense(mixture, rays)).rgb


def unneeded(mixture: Mixture, truth: torch.Tensor, bound: float = BOUND) -> Merging:
    return find_unneeded(mixture, some_rays(), truth, bound, AT_ONCE)


def occupancies(mixture: Mixture) -> torch.Tensor:
    torch.manual_seed(2)
    return mixture.occupancy().query(torch.rand(500, 3) - 0.5)


def test_an_expert_whose_points_fare_as_well_elsewhere_goes_and_no_other(mixture: Mixture) -> None:
    """2 and 3 do the same, so that one of them is enough."""
    # nothing but the two that are alike has any points
    with torch.no_grad():
        mixture.gate.head.bias[1], mixture.gate.head.bias[4] = -50.0, -50.0
    truth = image(mixture)
    found = unneeded(mixture, truth)
    assert {trial.expert for trial in found.dropped} > {1, 4} and len(found.dropped) == 3
    assert found.refused is None
    assert all(trial.price_db == pytest.approx(0.0, abs=1e-9) for trial in found.dropped)


def test_the_least_is_tried_first_and_the_first_failure_ends_it(mixture: Mixture) -> None:
    truth = image(mixture)  # which only the field as it is explains
    rays = some_rays()
    mixture.eval()
    intervals = dense(mixture, rays)
    with torch.no_grad():
        shaded = mixture.shade(rays, intervals)
    mass = torch.bincount(
        shaded.routes, shaded.weights * near_median_depth(shaded, intervals), minlength=5
    )
    found = unneeded(mixture, truth)
    assert found.refused is not None and found.refused.price_db > BOUND
    first = (found.dropped or [found.refused])[0]
    assert first.expert == int(mass[1:].argmin()) + 1
    assert first.share == pytest.approx(float(mass[first.expert] / mass.sum()), rel=1e-5)


def test_looking_changes_nothing(mixture: Mixture) -> None:
    before, pixels = copy.deepcopy(mixture.state_dict()), image(mixture)
    unneeded(mixture, pixels, 1e3)
    assert mixture.training and torch.equal(image(mixture), pixels)
    after = mixture.state_dict()
    assert list(after) == list(before)
    assert mixture.field.experts.remaining_experts() is None


def test_a_failure_half_way_leaves_all_experts(mixture: Mixture, monkeypatch) -> None:
    left, shade, calls = mixture.field.experts.left.tolist(), mixture.shade, []

    def fails(*given: Any) -> Any:
        calls.append(given)
        if len(calls) == 2:
            raise RuntimeError("out of memory")
        return shade(*given)

    monkeypatch.setattr(mixture, "shade", fails)
    with pytest.raises(RuntimeError, match="out of memory"):
        unneeded(mixture, image(make()))
    assert mixture.field.experts.left.tolist() == left


def test_the_price_is_that_of_all_that_have_gone(mixture: Mixture) -> None:
    torch.manual_seed(3)
    truth = torch.rand(200, 3)
    full = image(mixture)
    found = unneeded(mixture, truth, 1e3)
    assert [trial.expert for trial in found.dropped] and len(found.dropped) == 3
    for trial in found.dropped:
        mixture.field.experts.drop(trial.expert)
        errors = [float((rgb - truth).square().mean()) for rgb in (image(mixture), full)]
        price = 10.0 * torch.log10(torch.tensor(errors[0] / errors[1]))
        assert trial.price_db == pytest.approx(float(price), abs=1e-4)


class Drawn(NoPixels):
    """Some rays of the scene, and any colours."""

    def held_out(self, mixture: Mixture, count: int, *_: object) -> tuple[Rays, torch.Tensor]:
        rays, images = some_rays(count), torch.zeros(count, dtype=torch.int64)
        return mixture.rays(rays.origins, rays.directions, images), torch.rand(count, 3)


def test_what_is_empty_and_what_is_skipped_stays_so(mixture: Mixture, printed: Any) -> None:
    before = occupancies(mixture)
    params = sum(parameter.numel() for parameter in mixture.field.parameters())
    run = ARun()
    kept: list[dict[str, list[torch.nn.Parameter]]] = []
    run.forget = kept.append  # type: ignore[method-assign]
    small_learner(run, mixture, Drawn(), merging=MergingConfig(1e3, rays=200))._merge()
    assert torch.equal(occupancies(mixture), before)
    assert int(mixture.field.experts.left.sum()) == 1
    each = 16 * 16 + 16
    assert sum(p.numel() for p in mixture.field.parameters()) == params - 3 * each
    (groups,) = kept
    assert sum(p.numel() for p in groups["field"]) <= params - 3 * each
    assert "scene experts: 1 left; dropped" in printed()


def test_a_checkpoint_of_a_field_without_some_experts_renders_the_same(mixture: Mixture) -> None:
    mixture.field.experts.drop(2)
    buffer = io.BytesIO()
    torch.save(mixture.state_dict(), buffer)
    buffer.seek(0)
    restored = make().train()
    restored.load_state_dict(torch.load(buffer, weights_only=True))
    assert restored.field.experts.left.tolist() == [True, False, True, True]
    assert torch.equal(image(restored), image(mixture))


def test_where_nothing_may_go_nothing_is_tried(mixture: Mixture) -> None:
    """`NoPixels` fails where rays are asked for."""
    small_learner(ARun(), mixture, merging=MergingConfig(None))._merge()
    small_learner(ARun(), mixture, homogeneous=True).after_step(10_000, 0.0, 1.0)
    for number in (1, 2, 3):
        mixture.field.experts.drop(number)
    small_learner(ARun(), mixture, merging=MergingConfig(BOUND))._merge()
    assert mixture.field.experts.left.tolist() == [False, False, False, True]


def test_the_log_says_what_was_dropped_and_why_no_more(mixture: Mixture) -> None:
    found = unneeded(mixture, image(mixture))
    line = line_of(found, 4 - len(found.dropped))
    assert found.refused is not None
    assert f"without {found.refused.expert} (" in line and "would lose" in line


def test_the_price_that_is_said_is_of_all_dropped_experts() -> None:
    found = Merging([Trial(3, 0.02, 0.004), Trial(1, 0.05, 0.009)], None)
    assert line_of(found, 2) == (
        "scene experts: 2 left; dropped: 3 (2.0% of the surface mass) and 1 (5.0% of the surface "
        "mass), for +0.009 dB; their points go to those left"
    )


def test_experts_that_the_gate_cannot_reach_leave_first() -> None:
    torch.manual_seed(0)
    sizes = replace(SIZES, gate=replace(SIZES.gate, scene_experts=2))
    mixture = Mixture(sizes, 3, "float32", Routing(0.2, False))
    torch.nn.init.constant_(mixture.gate.head.bias, 0.0)
    with torch.no_grad():
        mixture.gate.head.bias[0] = 20.0  # nothing lies on any scene expert
    mixture.freeze(0.0, {})
    found = unneeded(mixture, torch.rand(200, 3), 99.0)
    assert [trial.expert for trial in found.dropped][:2] == [3, 4] and len(found.dropped) == 3
