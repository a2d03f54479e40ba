"""A crop cuts rays off, and behind what is cut off nerfstudio's background shows."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.data.scene_box import OrientedBox, SceneBox
from nerfstudio.model_components.renderers import background_color_override_context
from torch import nn

from leco_plugin.host_configs import switch_nerf_host
from leco_plugin.method_configs import LEARNING
from leco_plugin.models.region import SIDE, Region
from leco_plugin.models.sizing.scene_sizes import complete
from leco_plugin.scenes.bounds import SceneBounds
from leco_plugin.scenes.survey import covering_rays
from leco_plugin.space import NO_WALL

MAGENTA = torch.tensor([1.0, 0.0, 1.0])
BOX = SceneBox(torch.tensor([[-1.0] * 3, [1.0] * 3]))
WALLS = {
    "box": torch.tensor([-1.0] * 3 + [1.0] * 3),
    "contraction": torch.tensor([-NO_WALL] * 3 + [NO_WALL] * 3),
}


def model_of(name: str, kind: Any) -> Any:
    """A new model of a scene of half extent 1 in which rays go from 0.1 to 4."""
    torch.manual_seed(0)
    if name == "leco-occupancy":
        sizes = complete(LEARNING.sizes, LEARNING.bounds, {}, 3, "cpu")
        field = replace(sizes.field, encoding=replace(sizes.field.encoding, log2_table=8))
        config: Any = replace(LEARNING, sizes=replace(sizes, field=field, candidates=32))
    else:
        config = switch_nerf_host
    model = config.setup(scene_box=BOX, num_train_data=3, metadata={}, device="cpu").eval()
    bounds = SceneBounds(kind, torch.zeros(3), 1.0, 0.1, 4.0, WALLS[kind], "")
    part_of(model, name).set_bounds(bounds, 2.0)
    return model


def part_of(model: Any, name: str) -> Any:
    """What has the bounds."""
    return model.mixture if name == "leco-occupancy" else model


def camera() -> Cameras:
    """On +z, 2 above the middle of the scene, looking down."""
    pose = torch.eye(4)[None, :3].clone()
    pose[0, 2, 3] = 2.0
    return Cameras(pose, 12.0, 12.0, 6.0, 6.0, 12, 12)


def render(model: Any, middle: float | None, size: float) -> dict[str, torch.Tensor]:
    """Pictures with a cube of this size as a crop, around a z; None is no crop."""
    box = None
    if middle is not None:
        box = OrientedBox.from_params((0.0, 0.0, middle), (0.0, 0.0, 0.0), (size,) * 3)
    with background_color_override_context(MAGENTA):
        outputs: dict[str, torch.Tensor] = model.get_outputs_for_camera(camera(), obb_box=box)
    return outputs


@pytest.mark.parametrize("kind", ["box", "contraction"])
@pytest.mark.parametrize("name", ["leco-occupancy", "switch-nerf"])
def test_a_crop_ends_rays_and_shows_the_background_behind(name: str, kind: str) -> None:
    model = model_of(name, kind)
    whole = render(model, None, 0.0)
    for middle in (-50.0, 50.0):  # beyond the scene, and behind the camera
        away = render(model, middle, 1.0)
        torch.testing.assert_close(away["rgb"], MAGENTA.expand(12, 12, 3))
        assert float(away["accumulation"].max()) == 0.0
        assert all(bool(picture.isfinite().all()) for picture in away.values())
    around = render(model, 0.0, 100.0)
    for picture in ("rgb", "depth", "accumulation"):
        torch.testing.assert_close(around[picture], whole[picture])
    cut = render(model, 0.0, 1.0)  # z from -0.5 to 0.5, which the rays at the border pass by
    inside = cut["accumulation"][6, 6]
    assert 0.0 < float(inside) < float(whole["accumulation"][6, 6])
    assert float(cut["accumulation"][0, 0]) == 0.0
    torch.testing.assert_close(cut["rgb"][0, 0], MAGENTA)
    through = (1.0 - inside) * MAGENTA
    assert bool((cut["rgb"][6, 6] >= through - 1e-5).all())
    assert bool((cut["rgb"][6, 6] <= through + inside + 1e-5).all())
    assert 1.4 < float(cut["depth"][6, 6]) < 2.6


def test_without_a_crop_a_background_is_nowhere_seen() -> None:
    model = model_of("leco-occupancy", "box")
    with background_color_override_context(MAGENTA):
        over = model.get_outputs_for_camera(camera())["rgb"]
    torch.testing.assert_close(over, model.get_outputs_for_camera(camera())["rgb"])


SLAB = torch.tensor([-NO_WALL, -NO_WALL, -1.0, NO_WALL, NO_WALL, -0.5])


def looking(down: float, count: int = 9) -> Cameras:
    """Cameras above a slab that look along +x and so many degrees below the horizon."""
    angle = math.radians(down)
    ahead = torch.tensor([math.cos(angle), 0.0, -math.sin(angle)])
    right = torch.tensor([0.0, -1.0, 0.0])
    pose = torch.stack([right, torch.linalg.cross(right, ahead), -ahead, torch.zeros(3)], dim=1)
    poses = pose.repeat(count, 1, 1)
    poses[:, 1, 3] = torch.linspace(-1.0, 1.0, count)
    return Cameras(poses, 40.0, 40.0, 20.0, 20.0, 40, 40)


def see(region: Region, cameras: Cameras) -> None:
    """Has cameras be those of the training images."""
    origins, directions = covering_rays(cameras, SIDE)
    region.note_backdrops(origins.reshape(-1, 3), directions.reshape(-1, 3))


def shows_a_backdrop(region: Region, cameras: Cameras) -> torch.Tensor:
    """Whether each pixel of the middle camera has one, by rows."""
    bundle: RayBundle = cameras.generate_rays(camera_indices=len(cameras) // 2).flatten()
    rays = region.rays(bundle.origins, bundle.directions, None, torch.tensor(0.5))
    assert rays.cut_off is not None
    return ~rays.cut_off.view(40, 40)


def test_a_backdrop_is_shown_where_training_saw_one_and_nowhere_else() -> None:
    region = Region()
    region.set(SceneBounds("box", torch.tensor([0.0, 0.0, -0.75]), 3.0, 0.1, 3.0, SLAB, ""))
    steep, tilted = looking(80.0), looking(20.0)
    assert bool(shows_a_backdrop(region, tilted).all())  # nothing is known yet
    see(region, steep)
    assert bool(shows_a_backdrop(region, steep).all())  # the floor
    shown = shows_a_backdrop(region, tilted)
    assert not bool(shown[:20].any()) and bool(shown[-1].all())  # over the horizon, and the floor
    see(region, tilted)  # which photographs a sky
    assert bool(shows_a_backdrop(region, tilted).all())
    assert not bool(shows_a_backdrop(region, looking(-50.0)).any())  # higher than it does


def test_a_checkpoint_without_seen_backdrops_shows_every_one() -> None:
    model, loaded = (model_of("leco-occupancy", "box") for _ in range(2))
    state = model.state_dict()
    del state["mixture.region.backdrops.limits"]
    loaded.load_state_dict(state)
    assert bool((loaded.mixture.region.backdrops.limits == 2.0).all())


def test_a_checkpoint_keeps_the_backdrops_that_were_seen_as_nerfstudio_loads_it() -> None:
    model, loaded = (model_of("leco-occupancy", "box") for _ in range(2))
    model.mixture.region.backdrops.limits.fill_(0.5)
    loaded.load_state_dict(model.state_dict())
    nn.ModuleDict({"_model": loaded}).load_state_dict({}, strict=False)  # the pipeline's own state
    assert bool((loaded.mixture.region.backdrops.limits == 0.5).all())


@pytest.mark.parametrize("name", ["leco-occupancy", "switch-nerf"])
def test_a_ray_whose_backdrop_was_never_seen_is_black(name: str) -> None:
    model = model_of(name, "box")
    up = camera()
    up.camera_to_worlds = up.camera_to_worlds * torch.tensor([1.0, -1.0, -1.0, 1.0])[None, None]
    bundle = up.generate_rays(camera_indices=0, keep_shape=True)
    assert float(model.get_outputs_for_camera_ray_bundle(bundle)["rgb"].min()) > 0.0
    see(part_of(model, name).region, camera())
    outputs = model.get_outputs_for_camera_ray_bundle(bundle)
    assert float(outputs["rgb"].max()) == float(outputs["accumulation"].max()) == 0.0
