"""Front to back, pixels are those of asking about everything, for fewer questions."""

from __future__ import annotations

from threading import Thread
from typing import Literal

import pytest
import torch

from leco_plugin.models import front_to_back
from leco_plugin.models.compute import native
from leco_plugin.models.encodings import EncodingConfig
from leco_plugin.models.field import FieldConfig, HMoEField
from leco_plugin.models.front_to_back import (
    AT_ONCE_IN_C,
    FAINT,
    FEWEST_AT_ONCE,
    LEAST_LIGHT,
    MANY_RAYS,
    MOST_LOOKS,
    is_no_slower,
    samples_of,
    shade_front_to_back,
    shade_in_torch,
    suits_native,
)
from leco_plugin.models.gate import Gate, GateConfig, occupancy_from_logits
from leco_plugin.models.hmoe import HMoEConfig
from leco_plugin.models.rendering import (
    Answers,
    Intervals,
    Rays,
    Routing,
    Scene,
    ask,
    mapped_middles,
    shade,
    with_backdrop,
)
from leco_plugin.samplers import marching
from leco_plugin.samplers.kernels import VARIABLE
from leco_plugin.samplers.marching import March, march
from leco_plugin.samplers.packed import render_transmittance_from_density
from leco_plugin.space import Space

STEP = 0.02
HARDLY = 1.0 / 255.0 / 30.0
"""A thirtieth of a step of an 8-bit image."""

needs_compiler = pytest.mark.skipif(not native.has_native(), reason="no C compiler")


@pytest.fixture(params=[pytest.param("native", marks=needs_compiler), "torch"])
def by(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Tests with it run in C and in torch."""
    if request.param == "torch":
        monkeypatch.setenv(VARIABLE, "native")


@pytest.fixture
def nothing_is_faint(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(front_to_back, "FAINT", 0.0)


def scene_of(density: float) -> Scene:
    """About so dense everywhere, per half extent."""
    torch.manual_seed(0)
    encoding = EncodingConfig("hash", levels=2, log2_table=6, coarsest=4, finest=16)
    config = FieldConfig(encoding, HMoEConfig(scene_experts=3, width=16), appearance_dim=4)
    field = HMoEField(config, num_images=3)
    torch.nn.init.normal_(field.encoding.table, std=2.0)
    with torch.no_grad():
        field.density_head.bias.fill_(1.0 + torch.tensor(density).log())
    gate = Gate(GateConfig(EncodingConfig(octaves=2), width=8, scene_experts=3))
    return Scene(field, gate, Space("contraction", half_extent=0.5), Routing(0.2, False))


def some_rays(count: int) -> Rays:
    torch.manual_seed(count)
    directions = torch.nn.functional.normalize(torch.randn(count, 3), dim=-1)
    starts, ends = torch.full((count,), 0.1), 0.3 + 2.0 * torch.rand(count)
    ends[::7] = 0.05  # these miss the scene
    return Rays(torch.rand(count, 3) - 0.5, directions, starts, ends, None)


def kept_along(rays: Rays) -> Intervals:
    def occupied(positions: torch.Tensor) -> torch.Tensor:
        return (7.0 * positions).sin().sum(dim=-1) > -0.3

    samples = march(marching.Rays(*rays[:4]), March(STEP), occupied)
    return with_backdrop(Intervals(*samples), rays, STEP, 0.0)


@pytest.mark.usefixtures("by", "nothing_is_faint")
@pytest.mark.parametrize("density", [0.01, 1.0, 30.0, 3000.0])
@pytest.mark.parametrize("count", [0, 1, 150])
def test_it_renders_what_asking_about_everything_renders(
    count: int, density: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(front_to_back, "LEAST_LIGHT", 1e-4)  # less than shows anywhere
    scene, rays = scene_of(density), some_rays(count)
    everything = kept_along(rays)
    with torch.no_grad():
        whole = shade(scene, rays, everything, freeze_gate=True)
    seen, asked = shade_front_to_back(scene, rays, everything)
    assert len(asked.t_starts) == len(seen.weights) == len(seen.routes)
    torch.testing.assert_close(seen.rgb, whole.rgb, atol=HARDLY, rtol=0.0)
    torch.testing.assert_close(seen.accumulation, whole.accumulation, atol=HARDLY, rtol=0.0)
    torch.testing.assert_close(seen.depth, whole.depth, atol=2.5 * HARDLY, rtol=0.0)


@pytest.mark.usefixtures("by")
@pytest.mark.parametrize(
    ("density", "looks"),
    [(0.001, MOST_LOOKS), (0.01, 5), (0.03, MOST_LOOKS), (1.0, MOST_LOOKS), (30.0, MOST_LOOKS)],
)
def test_of_two_neighbours_that_are_faint_one_is_enough(
    density: float, looks: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(front_to_back, "MOST_LOOKS", looks)
    scene, rays = scene_of(density), some_rays(150)
    everything = kept_along(rays)
    with torch.no_grad():
        whole = shade(scene, rays, everything, freeze_gate=True)
    seen, asked = shade_front_to_back(scene, rays, everything)
    of_asked = [(int(ray), float(t)) for ray, t in zip(asked.ray_indices, asked.t_starts)]
    expected = not_faint(everything, whole.sigmas, rays)
    assert of_asked == [one for one in expected if one in set(of_asked)]  # in order, none beside
    missed = expected.keys() - set(of_asked)
    assert all(expected[one] < 1.01 * LEAST_LIGHT for one in missed)
    if density == 0.001:
        assert not missed and 0.5 < len(of_asked) / len(everything.t_starts) < 0.8
    with torch.no_grad():
        shown = shade(scene, rays, asked, freeze_gate=True)
    torch.testing.assert_close(seen.rgb, shown.rgb, atol=1e-5, rtol=0.0)


def not_faint(
    samples: Intervals, sigmas: torch.Tensor, rays: Rays
) -> dict[tuple[int, float], float]:
    """What is to be asked, one sample after the other, and the light that is left before it."""
    found: dict[tuple[int, float], float] = {}
    lengths = (samples.t_ends - samples.t_starts) / 0.5
    opacities = (-(-sigmas * lengths).expm1()).tolist()
    starts, ends = samples.t_starts.tolist(), samples.t_ends.tolist()
    for ray in range(len(rays.origins)):
        numbers = (samples.ray_indices == ray).nonzero()[:, 0].tolist()
        light = 1.0
        for place, n in enumerate(numbers):
            between = n - 1 in numbers and n + 1 in numbers
            gap = max(starts[n] - ends[n - 1], starts[n + 1] - ends[n]) if between else STEP
            if place % 2 or gap > STEP / 2 or max(opacities[n - 1 : n + 2 : 2]) >= FAINT:
                found[ray, starts[n]] = light
                light *= 1.0 - opacities[n]
    return found


@pytest.mark.usefixtures("by", "nothing_is_faint")
@pytest.mark.parametrize("density", [0.01, 30.0, 3000.0])
def test_it_asks_from_the_front_and_hardly_further_than_light_goes(density: float) -> None:
    scene, rays = scene_of(density), some_rays(150)
    everything = kept_along(rays)
    with torch.no_grad():
        whole = shade(scene, rays, everything, freeze_gate=True)
    trans, _ = render_transmittance_from_density(
        everything.t_starts / 0.5,
        everything.t_ends / 0.5,
        whole.sigmas,
        packed_info=whole.packed_info,
    )
    _, asked = shade_front_to_back(scene, rays, everything)
    at = {
        (int(ray), float(start)): number
        for number, (ray, start) in enumerate(zip(everything.ray_indices, everything.t_starts))
    }
    found = [at[int(ray), float(start)] for ray, start in zip(asked.ray_indices, asked.t_starts)]
    assert found == sorted(set(found))
    was_asked = torch.zeros(len(trans), dtype=torch.bool)
    was_asked[found] = True
    assert bool(was_asked[trans > 1.01 * LEAST_LIGHT].all())
    hidden = (trans < 0.99 * LEAST_LIGHT) & was_asked
    of_ray = torch.bincount(everything.ray_indices[hidden], minlength=150)
    with torch.no_grad():
        in_c = suits_native(scene, rays, everything)
    assert int(of_ray.max()) < (AT_ONCE_IN_C if in_c else FEWEST_AT_ONCE)
    if density == 3000.0:
        assert float(was_asked.float().mean()) < 0.5
    if density == 0.01:
        assert bool(was_asked.all())


@pytest.mark.parametrize("count", [0, 150])
def test_torch_asks_no_question_about_nothing(count: int, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []

    def counting(scene: Scene, rays: Rays, some: Intervals, freeze_gate: bool) -> Answers:
        asked.append(len(some.t_starts))
        return ask(scene, rays, some, freeze_gate)

    monkeypatch.setattr(front_to_back, "ask", counting)
    rays = some_rays(count)
    shaded, seen = shade_in_torch(scene_of(3000.0), rays, kept_along(rays))
    assert sum(asked) == len(seen.t_starts) and len(shaded.rgb) == count
    assert 0 not in asked[1:]  # one answer gives the others their shapes


@needs_compiler
@pytest.mark.parametrize("density", [1.0, 30.0])
@pytest.mark.parametrize("kind", ["contraction", "box"])
def test_c_asks_and_answers_as_torch_does(
    kind: Literal["contraction", "box"], density: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = scene_of(density)
    scene.space.set(kind, torch.tensor([0.1, 0.0, -0.2]), 0.7)
    scene.field.experts.drop(2)
    for parameter in scene.field.experts.parameters():
        parameter.data.normal_(0.0, 0.3)
    rays = some_rays(150)._replace(images=torch.arange(150) % 3, cut_off=torch.arange(150) % 4 == 0)
    everything = kept_along(rays)
    for parameter in scene.gate.parameters():
        parameter.data.normal_()
    likely = scene.gate.occupancy(mapped_middles(scene.space, rays, everything))
    middle = likely.detach().sort().values[len(likely) // 2 :][:2].mean()  # between two: no tie
    given = scene._replace(routing=Routing(float(middle), False)), rays, everything
    monkeypatch.setattr(native, "RAYS_AT_ONCE", 40)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    monkeypatch.setattr(front_to_back, "FEWEST_AT_ONCE", AT_ONCE_IN_C)  # as many samples a look
    monkeypatch.setattr(front_to_back, "MOST_LOOKS", 1 << 10)
    assert not suits_native(*given)  # where gradients are wanted
    ours, asked = shade_front_to_back(*given)
    monkeypatch.setenv(VARIABLE, "native")
    theirs, expected = shade_front_to_back(*given)
    assert {0, 1} <= set(ours.routes.tolist()) <= {0, 1, 3}
    best = theirs.logits[:, 1:].topk(2).values
    # between equal experts, and at the threshold, rounding chooses
    tied = (best[:, 0] - best[:, 1] < 1e-4) | (
        (occupancy_from_logits(theirs.logits) - middle).abs() < 1e-5
    )
    clear = torch.ones(150, dtype=torch.bool)
    clear[asked[0][tied]] = False
    assert clear.sum() > 140
    theirs = theirs._replace(logits=ours.logits)  # C gives none
    for one, other in zip((*asked, *ours), (*expected, *theirs), strict=True):
        chosen = clear if len(one) == len(clear) else clear[asked[0]]
        torch.testing.assert_close(one[chosen], other[chosen], rtol=1e-4, atol=1e-5)


@pytest.mark.usefixtures("by")
@torch.no_grad()
def test_what_is_kept_is_the_only_expert_s_and_the_gate_is_not_asked() -> None:
    scene, rays = scene_of(3.0), some_rays(40)
    scene.gate.head.bias[0], scene.gate.head.bias[1] = -20.0, 20.0  # else it would say so itself
    asked = shade_front_to_back(scene, rays, kept_along(rays))
    scene.gate.hidden[0].bias[0] = torch.nan
    kept = shade_front_to_back(scene._replace(kept=True), rays, kept_along(rays))
    assert torch.equal(kept[0].routes, torch.ones_like(kept[0].routes)) and kept[0].rgb.sum() > 0.0
    for one, other in zip((*asked[1], *asked[0]), (*kept[1], *kept[0]), strict=True):
        if other.shape != (len(kept[0].routes), 0):
            torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-6)


@needs_compiler
def test_c_does_not_hide_what_is_no_number() -> None:
    scene, rays = scene_of(1.0), some_rays(20)
    scene.gate.hidden[0].bias.data[0] = torch.nan
    shaded, _ = shade_front_to_back(scene, rays, kept_along(rays))
    assert bool(shaded.accumulation.isnan().all())


@needs_compiler
@torch.no_grad()
def test_c_renders_in_float32_whatever_torch_multiplies_in() -> None:
    scene, rays = scene_of(3.0), some_rays(40)
    given = scene._replace(routing=Routing(0.2, False)), rays, kept_along(rays)
    exact, _ = shade_front_to_back(*given)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        shown, _ = shade_front_to_back(*given)
    assert suits_native(*given)
    assert torch.equal(shown.rgb, exact.rgb) and torch.equal(shown.logits, exact.logits)


def test_samples_of_some_rays_are_counted_out() -> None:
    found = samples_of(torch.tensor([3, 10, 20]), torch.tensor([2, 0, 3]), 4)
    assert found.tolist() == [3, 4, 20, 21, 22]


def test_where_torch_was_not_measured_to_be_no_slower_it_shades_everything(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv(VARIABLE, "native")

    def on(count: int, guided: bool, device: str = "cpu") -> bool:
        nothing = Intervals(*torch.empty(3, 0, device=device))
        at, toward = torch.empty(2, count, 3, device=device)
        rays = Rays(at, toward, at[:, 0], at[:, 0], None)
        return is_no_slower(scene_of(1.0), rays, nothing, guided)

    assert on(MANY_RAYS, True)
    assert not on(MANY_RAYS - 1, True)
    assert not on(MANY_RAYS, False)
    assert not on(MANY_RAYS, True, "meta")


def test_another_thread_leaves_a_threads_precision_as_it_is(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rays = some_rays(9)
    given = scene_of(1.0), rays, kept_along(rays)
    suits = native.suits

    def after_another_thread(*tensors: torch.Tensor) -> bool:
        monkeypatch.undo()
        other = Thread(target=suits_native, args=given)
        other.start()
        other.join()
        return suits(*tensors)

    monkeypatch.setattr(native, "suits", after_another_thread)
    with torch.no_grad(), torch.autocast("cpu", torch.bfloat16):
        suits_native(*given)
        assert native.suits is suits
        assert torch.is_autocast_enabled("cpu")
