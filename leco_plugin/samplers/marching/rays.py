"""What counts as a ray: shapes, types and devices that fit, and which rays can be marched at all.

A ray that is not finite, has no direction or ends before it begins gets no samples rather than an
error: one bad pixel of a batch must not end a training run.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor


def check_rays(
    origins: Tensor,
    directions: Tensor,
    t_mins: Tensor,
    t_maxs: Tensor,
    jitter: Tensor | None = None,
    t_enters: Tensor | None = None,
) -> None:
    """Raise unless the tensors describe one batch of rays.

    Raises:
        ValueError: a tensor is not [n_rays, 3] or [n_rays] as it should be, its type or device
            differs from that of `origins`, or the type is not float32 or float64 (half precision
            cannot tell neighbouring steps apart).
    """
    if origins.dtype not in (torch.float32, torch.float64):
        raise ValueError(f"rays must be float32 or float64, got {origins.dtype}")
    n_rays = origins.shape[0] if origins.dim() else 0
    named = {"t_mins": t_mins, "t_maxs": t_maxs, "jitter": jitter, "t_enters": t_enters}
    shapes: dict[str, tuple[Tensor | None, tuple[int, ...]]] = {
        "rays_o": (origins, (n_rays, 3)),
        "rays_d": (directions, (n_rays, 3)),
        **{name: (tensor, (n_rays,)) for name, tensor in named.items()},
    }
    for name, (tensor, shape) in shapes.items():
        if tensor is None:
            continue
        if tensor.shape != shape:
            raise ValueError(f"{name} must be {list(shape)}, got {list(tensor.shape)}")
        if tensor.dtype != origins.dtype or tensor.device != origins.device:
            raise ValueError(
                f"{name} is {tensor.dtype} on {tensor.device}, but rays_o is {origins.dtype} on "
                f"{origins.device}"
            )


def usable_rays(coordinates: Tensor, t_mins: Tensor, t_maxs: Tensor) -> Tensor:
    """Which rays are finite, go somewhere and begin before they end: bool [n_rays].

    Args:
        coordinates: origins and directions, [2, 3, n_rays].
        t_mins, t_maxs: where each ray begins and ends, [n_rays].
    """
    origins, directions = coordinates.abs().amax(dim=1)
    largest = torch.maximum(origins, directions).maximum(t_mins.abs())  # NaN if anything is
    return (largest < torch.inf) & (directions > 0.0) & (t_mins < t_maxs)


def checked_box(aabb: Sequence[float] | Tensor) -> Tensor:
    """A box as float32 [6] of (min, max), where it is.

    Raises:
        ValueError: it is not six finite numbers, or it is empty.
    """
    try:
        box = torch.as_tensor(aabb).detach().float().reshape(-1)
    except (TypeError, ValueError, RuntimeError):
        raise ValueError(f"aabb must be a finite box (min, max), got {aabb!r}") from None
    if box.shape != (6,) or not bool((box[:3] < box[3:]).all() and box.isfinite().all()):
        raise ValueError(f"aabb must be a finite box (min, max), got {box.tolist()}")
    return box


def intersect_box(origins: Tensor, directions: Tensor, aabb: Tensor) -> tuple[Tensor, Tensor]:
    """Where rays enter and leave an axis-aligned box (the slab method).

    Args:
        origins, directions: [n_rays, 3].
        aabb: (min, max) corners, [6].

    Returns:
        t of entry and of exit, [n_rays]; a ray that misses enters after it leaves. Entry is
        negative where the origin lies inside.
    """
    to_low, to_high = (aabb[:3] - origins) / directions, (aabb[3:] - origins) / directions
    # 0/0 on a face that the ray runs along: neither bound on this axis.
    near = torch.minimum(to_low, to_high).nan_to_num(nan=-torch.inf)
    far = torch.maximum(to_low, to_high).nan_to_num(nan=torch.inf)
    return near.amax(dim=-1), far.amin(dim=-1)
