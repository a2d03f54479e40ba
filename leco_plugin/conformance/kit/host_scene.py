"""The scene of the kit as nerfstudio shows one to a model: cameras, rays, a batch, no data on disk.

What needs nerfstudio imports it when it is called: a sampler is checked without.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor
from torch.nn.functional import normalize

from leco_plugin.conformance.kit.scene import CENTRE, DISTANCE, Rays, Slab, box
from leco_plugin.samplers.boxes import intersect_box

if TYPE_CHECKING:
    from nerfstudio.cameras.cameras import Cameras
    from nerfstudio.cameras.rays import RayBundle

FROM = ((1.0, 0.4, 0.5), (0.3, 1.0, 0.6), (-0.8, -0.9, -0.1), (-0.4, -0.6, -1.0))
"""Directions in which cameras lie from the centre of the box, to both sides of the slab."""
CAMERAS, SIDE = len(FROM), 4
"""Cameras, and pixels along each side of their images."""
SEEN = 0.8
"""World units to each side of the box's centre that an image shows: all rays cross the slab."""

NOTHING = Slab((0.0, 0.0, 1.0), -1.0)
"""A scene in which all is empty."""


def cameras() -> Cameras:
    """Around the box, looking at its centre."""
    from nerfstudio.cameras.cameras import Cameras

    backward = normalize(torch.tensor(FROM), dim=-1)
    upward = torch.tensor([0.0, 0.0, 1.0]).expand_as(backward)
    right = normalize(torch.linalg.cross(upward, backward), dim=-1)
    position = torch.tensor(CENTRE) + DISTANCE * backward
    focal, middle = SIDE / 2.0 * DISTANCE / SEEN, SIDE / 2.0
    return Cameras(
        torch.stack([right, torch.linalg.cross(backward, right), backward, position], dim=-1),
        fx=focal,
        fy=focal,
        cx=middle,
        cy=middle,
        width=SIDE,
        height=SIDE,
    )


def bundle() -> RayBundle:
    """Rays through all pixels of all cameras, [CAMERAS * SIDE^2], as a data manager gives them."""
    pixels = torch.cartesian_prod(*map(torch.arange, (CAMERAS, SIDE, SIDE)))
    rays: RayBundle = cameras().generate_rays(
        camera_indices=pixels[:, :1], coords=pixels[:, 1:] + 0.5
    )
    return rays


def turned_away() -> RayBundle:
    """The same rays in the opposite direction, where there is nothing."""
    rays = bundle()
    rays.directions = -rays.directions
    return rays


def inside_the_box() -> RayBundle:
    """The same rays, which begin and end within the box."""
    rays = bundle()
    enters, leaves = intersect_box(rays.origins, rays.directions, box())
    rays.nears, rays.fars = (enters + 0.01)[:, None], (leaves - 0.01)[:, None]
    return rays


def as_rays(rays: RayBundle) -> Rays:
    """The bundle as the kit has rays."""
    along = torch.zeros(len(rays.origins))
    return Rays(rays.origins, rays.directions, along, along + 2.0 * DISTANCE)


def batch() -> dict[str, Tensor]:
    """What the pixels of `bundle` show: `image` [N, 3], `depth_image` [N, 1], `indices` [N, 3]."""
    rays = bundle()
    pixels = torch.cartesian_prod(*map(torch.arange, (CAMERAS, SIDE, SIDE)))
    return {
        "image": 0.5 + 0.5 * torch.sin(3.0 * rays.directions),
        "depth_image": torch.full((len(pixels), 1), DISTANCE),
        "indices": pixels,
    }


def model_arguments() -> dict[str, Any]:
    """What nerfstudio's pipeline gives a model when it builds it."""
    from nerfstudio.data.scene_box import SceneBox

    return {
        "scene_box": SceneBox(box().view(2, 3)),
        "num_train_data": CAMERAS,
        "metadata": {},
        "device": "cpu",
        "grad_scaler": None,
        "seed_points": None,
    }


class CamerasOnly:
    """A data set as far as models and their callbacks look at one."""

    def __init__(self) -> None:
        arguments = model_arguments()
        self.cameras, self.scene_box = cameras(), arguments["scene_box"]
        self.metadata: dict[str, Any] = arguments["metadata"]

    def __len__(self) -> int:
        return CAMERAS


def pipeline_of(model: Any) -> Any:
    """What stands where callbacks expect nerfstudio's pipeline."""
    manager = SimpleNamespace(train_dataset=CamerasOnly())
    return SimpleNamespace(model=model, _model=model, device=model.device, datamanager=manager)
