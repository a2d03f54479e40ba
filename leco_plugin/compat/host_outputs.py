"""Photographs as a nerfstudio model is compared with them."""

from __future__ import annotations

from typing import Any

from torch import Tensor


def true_colours(host: Any, image: Tensor) -> Tensor:
    """What the host should show of pixels [..., 3 or 4]: before its own background, [..., 3].

    nerfstudio's models render premultiplied colours, and photographs have straight ones.
    """
    blend = getattr(getattr(host, "renderer_rgb", None), "blend_background", None)
    blended: Tensor = image[..., :3] if blend is None else blend(image)
    return blended
