"""Images of a nerfstudio model as its commands and its viewer can draw them, and photographs as it
is compared with them."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

if TYPE_CHECKING:
    from nerfstudio.models.base_model import Model


def with_counts_as_floats(model: Model) -> Model:
    """Has a model render its counts as floating-point numbers; returns the model.

    ns-render and the viewer end with an exception at an image of integers, such as the samples per
    ray of nerfstudio's own `instant-ngp`.
    """
    render = model.get_outputs_for_camera_ray_bundle

    @functools.wraps(render)
    def get_outputs_for_camera_ray_bundle(*args: Any, **kwargs: Any) -> dict[str, Tensor]:
        return {name: _drawable(image) for name, image in render(*args, **kwargs).items()}

    model.get_outputs_for_camera_ray_bundle = get_outputs_for_camera_ray_bundle  # type: ignore[method-assign]
    return model


def true_colours(host: Any, image: Tensor) -> Tensor:
    """What the host should show of pixels [..., 3 or 4]: before its own background, [..., 3].

    nerfstudio's models render premultiplied colours, and photographs have straight ones.
    """
    blend = getattr(getattr(host, "renderer_rgb", None), "blend_background", None)
    blended: Tensor = image[..., :3] if blend is None else blend(image)
    return blended


def _drawable(image: Tensor) -> Tensor:
    counts = not image.is_floating_point() and image.dtype != torch.bool
    return image.float() if counts else image
