"""Claims about the model itself: what it refuses to learn from, and what a checkpoint restores."""

from __future__ import annotations

import copy
import io
from dataclasses import replace
from typing import Any

import pytest
import torch
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.data.scene_box import SceneBox
from small_learner import small_learner

from leco_plugin.learning.collapse import annealed
from leco_plugin.models import front_to_back
from leco_plugin.models.encodings import EncodingConfig
from leco_plugin.models.field import FieldConfig
from leco_plugin.models.gate import GateConfig
from leco_plugin.models.leco import LecoModel
from leco_plugin.models.leco_config import LecoModelConfig
from leco_plugin.models.losses import color_loss
from leco_plugin.models.mixture import Following
from leco_plugin.models.objective import GateLossConfig
from leco_plugin.models.rendering import Intervals, Rays, backdrop_of
from leco_plugin.models.sizing.sizes import Sizes
from leco_plugin.samplers.kernels import VARIABLE
from leco_plugin.scenes.bounds import SceneBounds
from leco_plugin.scenes.input_error import InputError
from leco_plugin.space import NO_WALL

NUM_RAYS = 12

TINY = Sizes(
    gate=GateConfig(EncodingConfig(octaves=1), width=8, layers=1, scene_experts=2),
    field=FieldConfig(EncodingConfig(kind="hash", log2_table=8)),
    learn_candidates=8,
    candidates=16,
)


@pytest.fixture
def model() -> LecoModel:
    torch.manual_seed(0)
    box = SceneBox(torch.tensor([[-1.0] * 3, [1.0] * 3]))
    made = LecoModelConfig(sizes=TINY).setup(scene_box=box, num_train_data=3)
    assert isinstance(made, LecoModel)
    made.plan = made.plan._replace(ramped=0.5)  # every loss takes part
    return made.train()


def step(model: LecoModel) -> tuple[dict[str, Any], dict[str, torch.Tensor]]:
    """Outputs of a training batch, and the batch."""
    directions = torch.nn.functional.normalize(torch.randn(NUM_RAYS, 3), dim=-1)
    bundle = RayBundle(
        origins=-0.5 * directions,
        directions=directions,
        pixel_area=torch.ones(NUM_RAYS, 1),
        camera_indices=torch.zeros(NUM_RAYS, 1, dtype=torch.int64),
    )
    return model.get_outputs(bundle), {"image": torch.rand(NUM_RAYS, 3)}


def spoil(outputs: dict[str, Any], name: str) -> dict[str, Any]:
    """The outputs with one tensor of the rendering not finite."""
    shaded = outputs["shaded"]
    return outputs | {
        "shaded": shaded._replace(**{name: torch.full_like(getattr(shaded, name), torch.nan)})
    }


def test_a_sound_batch_has_finite_losses(model: LecoModel) -> None:
    losses = model.get_loss_dict(*step(model))
    assert len(losses) >= 5
    assert all(bool(torch.isfinite(loss)) for loss in losses.values())


def test_a_batch_that_is_evaluated_has_the_loss_of_its_colours_alone(model: LecoModel) -> None:
    """nerfstudio asks for it every `steps_per_eval_batch` steps."""
    outputs, batch = step(model.eval())
    image = torch.cat([batch["image"], torch.full((NUM_RAYS, 1), 0.25)], dim=-1)
    losses = model.get_loss_dict(outputs, {"image": image})
    assert losses == {"rgb_loss": color_loss(outputs["rgb"], 0.25 * image[:, :3])}


@pytest.mark.parametrize(
    ("spoiled", "loss", "cause"),
    [
        ("rgb", "rgb_loss", "a colour overflowed"),
        ("weights", "distortion_loss", "all inputs and parameters are finite"),
        ("depth", "nearness_loss", "all inputs and parameters are finite"),
        ("logits", "agreement_loss", "the gate's logits overflowed"),
    ],
)
def test_the_first_loss_that_is_not_finite_stops_the_step(
    model: LecoModel, spoiled: str, loss: str, cause: str
) -> None:
    outputs, batch = step(model)
    with pytest.raises(FloatingPointError, match=f"^{loss} is not finite: {cause}"):
        model.get_loss_dict(spoil(outputs, spoiled), batch)


@pytest.mark.parametrize("training", [True, False])
def test_a_ray_that_misses_a_bounded_scene_has_its_backdrop_and_a_colour(
    model: LecoModel, training: bool
) -> None:
    walls = torch.tensor([-1.0, -1.0, -1.0, 1.0, 1.0, 1.0])
    bounds = SceneBounds("box", torch.zeros(3), 1.0, 0.1, 8.0, walls, "by hand")
    model.mixture.set_bounds(bounds, 2.0)
    ahead = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    origins = torch.tensor([[0.0, 0.0, -3.0], [0.0, 5.0, -3.0], [0.0, 0.0, -3.0]])
    bundle = RayBundle(origins, ahead, torch.ones(3, 1), torch.zeros(3, 1, dtype=torch.int64))
    model.train(training)
    outputs = model.get_outputs(bundle)
    assert bool((outputs["rgb"] > 0.0).all())
    backdrops = 1.0 if training else 0.0  # which losses count, and pictures do not
    assert outputs["accumulation"][1:].flatten().tolist() == pytest.approx([backdrops] * 2)
    assert training or outputs["depth"][1:].flatten().tolist() == [8.0, 8.0]
    intervals = model.intervals_of(model.rays_of(bundle))
    ends = [intervals.t_ends[intervals.ray_indices == ray] for ray in range(3)]
    assert len(ends[0]) > 3 and float(ends[0].max()) == pytest.approx(4.0)
    for missing in ends[1:]:
        assert missing.tolist() == [8.0]


def test_the_backdrop_gives_a_ray_its_colour_and_no_opacity(model: LecoModel) -> None:
    with torch.no_grad():
        model.mixture.field.density_head.bias.fill_(-80.0)  # nothing anywhere
        torch.manual_seed(1)
        ends = step(model)[0]["rays"].t_maxs
        torch.manual_seed(1)
        outputs = step(model.eval())[0]
    assert float(outputs["rgb"].min()) > 0.0
    assert float(outputs["accumulation"].max()) < 1e-3
    assert torch.equal(outputs["depth"][:, 0], ends)


def test_opacities_teach_only_where_there_are_any(model: LecoModel) -> None:
    outputs, batch = step(model)
    assert "transparency_loss" not in model.get_loss_dict(outputs, batch)
    opaque = torch.cat([batch["image"], torch.ones(NUM_RAYS, 1)], dim=-1)
    assert model.get_loss_dict(outputs, {"image": opaque})["transparency_loss"].item() == 0.0
    clear = torch.cat([batch["image"], torch.zeros(NUM_RAYS, 1)], dim=-1)
    assert model.get_loss_dict(outputs, {"image": clear})["transparency_loss"].item() > 0.0


def test_rays_that_end_below_the_lowest_point_are_taught_to_meet_ground(model: LecoModel) -> None:
    """One ends on the floor, one at `far` below the lowest point, one above it, and one misses."""
    walls = torch.tensor([-NO_WALL, -NO_WALL, -1.0, NO_WALL, NO_WALL, 1.0])
    bounds = SceneBounds("box", torch.zeros(3), 4.0, 0.1, 2.0, walls, "")
    ahead = torch.tensor([[0.0, 0.0, -1.0], [1.0, 0.0, -0.7], [1.0, 0.0, -0.4], [0.0, 0.0, 1.0]])
    ahead = torch.nn.functional.normalize(ahead, dim=-1)
    origins = torch.tensor([[0.0, 0.0, 0.5]] * 3 + [[0.0, 0.0, 1.5]])
    bundle = RayBundle(origins, ahead, torch.ones(4, 1), torch.zeros(4, 1, dtype=torch.int64))
    for lowest, expected in ((-0.5, [True, True, False, False]), (None, [False] * 4)):
        model.mixture.set_bounds(replace(bounds, lowest=lowest), 2.0)
        outputs = model.get_outputs(bundle)
        region, rays = model.mixture.region, outputs["rays"]
        assert region.meet_ground(rays).tolist() == expected
        loss = model.get_loss_dict(outputs, {"image": torch.ones(4, 3)})["ground_loss"]
        behind = backdrop_of(outputs["intervals"], rays)
        weights = outputs["shaded"].weights[behind][torch.tensor(expected)]
        assert len(weights) == sum(expected) and bool((weights > 0.0).all())
        torch.testing.assert_close(loss, 0.05 * weights.square().sum() / 4.0)


def test_a_batch_without_rays_says_so(model: LecoModel) -> None:
    outputs, batch = step(model)
    with pytest.raises(ValueError, match="no rays"):
        model.get_loss_dict(outputs, {"image": batch["image"][:0]})


@pytest.mark.parametrize(
    ("unbounded", "brightness", "share"),
    [(True, 0.5, 1.0), (False, 0.0, 1.0), (False, 0.05, 0.5), (False, 0.5, 0.0)],
)
def test_the_nearness_loss_is_its_weight_at_near_and_nothing_at_far(
    model: LecoModel, unbounded: bool, brightness: float, share: float
) -> None:
    """In a box it is of pixels that are nearly black: the others show something for certain."""
    outputs, batch = step(model)
    model.mixture.region.space.unbounded.fill_(unbounded)
    batch = batch | {"image": torch.full_like(batch["image"], brightness)}
    region, weight = model.mixture.region, model.config.nearness * model.plan.ramped
    for place, expected in ((region.near, share * weight), (region.far, 0.0)):
        at = place.expand(NUM_RAYS)
        placed = outputs | {"shaded": outputs["shaded"]._replace(depth=at)}
        loss = model.get_loss_dict(placed, batch)["nearness_loss"]
        assert float(loss) == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize(("everywhere", "shaded"), [(0.0, 0.0), (1.0, 1.0), (0.25, 0.25)])
def test_what_the_gate_calls_empty_is_looked_at_on_some_rays_all_the_same(
    model: LecoModel, everywhere: float, shaded: float
) -> None:
    with torch.no_grad():
        model.mixture.gate.head.bias[0] += 1e3  # empty everywhere
    following = Following(above=model.config.likely_above, everywhere=everywhere)
    rays = 4000
    directions = torch.nn.functional.normalize(torch.randn(rays, 3), dim=-1)
    starts, ends = torch.full((rays,), 0.1), torch.full((rays,), 0.2)
    bundle = Rays(-0.5 * directions, directions, starts, ends, None)
    kept = model.mixture.follow(bundle, Intervals(torch.arange(rays), starts, ends), following)
    assert len(kept.ray_indices) / rays == pytest.approx(shaded, abs=0.03)


def test_the_colours_of_an_image_are_learned_and_their_mean_is_rendered(model: LecoModel) -> None:
    torch.nn.init.normal_(model.mixture.field.color.appearance.weight, std=10.0)
    for parameter in model.mixture.field.parameters():
        parameter.data += 0.1 * torch.randn_like(parameter)

    def colours(image: int) -> torch.Tensor:
        torch.manual_seed(1)
        directions = torch.nn.functional.normalize(torch.randn(NUM_RAYS, 3), dim=-1)
        bundle = RayBundle(
            origins=-0.5 * directions,
            directions=directions,
            pixel_area=torch.ones(NUM_RAYS, 1),
            camera_indices=torch.full((NUM_RAYS, 1), image),
        )
        return model.get_outputs(bundle)["rgb"].detach()

    assert (colours(0) - colours(1)).abs().max() > 1e-3
    model.eval()
    assert torch.equal(colours(0), colours(1))


def test_a_checkpoint_restores_report_and_progress(model: LecoModel) -> None:
    model.mixture.report = {"step": 7, "threshold": 0.25}
    model.progress.begin(200, most=150)
    model.progress.recoveries, model.progress.learn_seconds = 2, 3.5
    model.progress.decisions = torch.tensor([True, False, True])
    buffer = io.BytesIO()
    torch.save(model.state_dict(), buffer)
    model.mixture.report, model.progress.recoveries = {}, 0
    buffer.seek(0)
    restored = LecoModelConfig(sizes=TINY).setup(scene_box=model.scene_box, num_train_data=3)
    restored.load_state_dict(torch.load(buffer, weights_only=True))
    assert restored.mixture.report == {"step": 7, "threshold": 0.25}
    progress = restored.progress
    assert (progress.learn_steps, progress.configured) == (150, 200)
    assert (progress.recoveries, progress.learn_seconds) == (2, 3.5)
    assert progress.decisions.tolist() == [True, False, True]


def test_a_gate_that_has_given_up_the_papers_form_routes_as_the_other_also_when_resumed() -> None:
    config = LecoModelConfig(sizes=TINY, gate_loss=GateLossConfig(form="paper"))
    models = []
    for _ in range(2):
        made = config.setup(scene_box=SceneBox(torch.ones(2, 3)), num_train_data=3)
        assert isinstance(made, LecoModel)
        models.append(made)
    first, resumed = models
    assert first.mixture.routing.empty_below is None
    first.progress.paper_given_up = True
    first.mixture.routing = small_learner(
        progress=first.progress, gate_loss=config.gate_loss
    ).recoveries.routing()
    resumed.load_state_dict(first.state_dict())
    for model in models:
        assert model.mixture.routing.empty_below == config.gate_loss.empty_below
        gate_loss = annealed(config.gate_loss, model.progress, 0)
        model.plan = model.plan._replace(gate_loss=gate_loss)
        outputs, batch = step(model.train())
        assert "contribution_loss" in model.get_loss_dict(outputs, batch)


def test_a_checkpoint_of_an_earlier_version_is_refused_in_a_line(model: LecoModel) -> None:
    state = {name.removeprefix("mixture."): value for name, value in model.state_dict().items()}
    said = "is of another method, or of another version of leco_plugin: train again"
    with pytest.raises(InputError, match=said) as caught:
        model.load_state_dict(state)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("change", ["lacks", "has", "lacks below"])
@pytest.mark.parametrize("place", ["", "mixture."])
def test_an_extra_state_of_another_version_is_refused_in_a_line(
    model: LecoModel, place: str, change: str
) -> None:
    state = model.state_dict()
    extra = copy.deepcopy(state[f"{place}_extra_state"])
    below = extra["progress"]["watch"] if place == "" else extra["routing"]
    if change == "has":
        below["of_old"] = 3
    else:
        held = extra if change == "lacks" else below
        del held[next(reversed(held))]
    with pytest.raises(InputError, match="another version of leco_plugin: train again") as caught:
        model.load_state_dict({**state, f"{place}_extra_state": extra})
    assert "\n" not in str(caught.value)


def test_a_gate_that_skips_nothing_is_not_taken_for_one_that_keeps_nothing(
    model: LecoModel,
) -> None:
    with torch.no_grad():
        model.mixture.gate.head.bias[0] += 1e3  # empty everywhere
    model.mixture.freeze(0.5, {})
    step(model)
    assert model.kept_per_ray == 0.0
    model.mixture.freeze(0.0, {})  # as measuring again does with such a gate
    step(model)
    assert model.kept_per_ray > 0.0


def test_front_to_back_renders_the_same_pixels_from_fewer_samples(model: LecoModel) -> None:
    model.mixture.precision = "float32"  # C renders in no other
    with torch.no_grad():
        model.mixture.field.density_head.bias.fill_(9.0)  # opaque everywhere
    model.eval()
    rendered = []
    for model.config.front_to_back in (False, True):
        torch.manual_seed(0)
        rendered.append({name: value.detach() for name, value in step(model)[0].items()})
    whole, seen = rendered
    torch.testing.assert_close(seen["rgb"], whole["rgb"], atol=2e-4, rtol=0.0)
    torch.testing.assert_close(seen["depth"], whole["depth"], atol=1e-3, rtol=1e-3)
    fewer, all_of_them = (float(one["samples_per_ray"].mean()) for one in (seen, whole))
    assert fewer < 0.5 * all_of_them


def test_guided_batches_of_many_rays_are_rendered_from_the_front_by_default(
    model: LecoModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(VARIABLE, "native")  # C always renders from the front
    with torch.no_grad():
        model.mixture.field.density_head.bias.fill_(9.0)  # opaque everywhere
    model.eval()

    def samples() -> float:
        torch.manual_seed(0)
        return float(step(model)[0]["samples_per_ray"].mean())

    monkeypatch.setattr(front_to_back, "MANY_RAYS", NUM_RAYS)
    dense = samples()
    model.mixture.freeze(1e-3, {})
    assert samples() < 0.5 * dense
    monkeypatch.setattr(front_to_back, "MANY_RAYS", NUM_RAYS + 1)
    assert samples() == dense  # the gate keeps all
