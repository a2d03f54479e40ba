"""nerfacc where there is no CUDA: its kernels replaced by this package's plain torch.

nerfacc 0.5.2 and 0.5.3 pack, scan and traverse grids on CUDA only, so that a stock host such as
nerfstudio's `instant-ngp` cannot run anywhere else. `install` puts a switch in front of each of
these functions: CUDA tensors go to nerfacc's kernels as before, all others to the functions here.
A model that is built for another device than CUDA calls `install_for`; no import installs anything.

Names that a module imported earlier (`from nerfacc import pack_info`) are replaced too. Functions
stored in a class, a partial or a default argument stay nerfacc's own.
"""

from __future__ import annotations

import functools
import inspect
import sys
from collections.abc import Callable
from types import ModuleType
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from leco_plugin.samplers import packed
from leco_plugin.samplers.boxes import intersect_box, lookup
from leco_plugin.samplers.marching import March, OccupiedFn, Rays, Samples, march, number
from leco_plugin.samplers.rays import candidate_edges

if TYPE_CHECKING:
    from nerfacc import RayIntervals, RaySamples

Function = Callable[..., Any]

_switches: list[tuple[Function, Function]] = []
"""Functions of nerfacc, and what stands in front of them."""


def install_for(device: torch.device | str | None) -> None:
    """`install` for a model that is built for this device, unless that is CUDA; for None, which is
    not known, on machines without CUDA. ImportError as of `install`."""
    if torch.device(device or ("cuda" if torch.cuda.is_available() else "cpu")).type != "cuda":
        install()


def install() -> None:
    """Let nerfacc work on tensors of any device. Doing it twice does it once.

    Raises:
        ImportError: nerfacc is not installed, or in a version whose functions are others.
    """
    import nerfacc

    if _switches:
        return
    replacements = {name: getattr(packed, name) for name in packed.__all__}
    replacements |= {"traverse_grids": traverse_grids, "ray_aabb_intersect": ray_aabb_intersect}
    for name, replacement in replacements.items():
        if not _has_same_arguments(replacement, getattr(nerfacc, name, None)):
            raise ImportError(
                f"{name} of nerfacc {nerfacc.__version__} is not that of 0.5.2 or 0.5.3, for which "
                "this is written: pip install nerfacc==0.5.2, which nerfstudio asks for too"
            )
    for name, replacement in replacements.items():
        original = getattr(nerfacc, name)
        _switches.append((original, _switch(original, replacement)))
    _rebind(dict(_switches))


def uninstall() -> None:
    """Give nerfacc its own functions back."""
    _rebind({switch: original for original, switch in _switches})
    _switches.clear()


def _has_same_arguments(replacement: Function, original: Function | None) -> bool:
    """Whether arguments for a function of nerfacc mean the same to its replacement."""
    if original is None:
        return False
    theirs, ours = (list(inspect.signature(each).parameters) for each in (original, replacement))
    return ours[: len(theirs)] == theirs


def _rebind(replacements: dict[Function, Function]) -> None:
    """Replace functions by others in every module that has one of them, nerfacc's or not."""
    by_identity = {id(old): new for old, new in replacements.items()}
    for module in [each for each in list(sys.modules.values()) if isinstance(each, ModuleType)]:
        # not vars: that would load a module which waits for its first use
        for name, value in list(object.__getattribute__(module, "__dict__").items()):
            if id(value) in by_identity:
                setattr(module, name, by_identity[id(value)])


def _switch(original: Function, replacement: Function) -> Function:
    @functools.wraps(original)
    def by_device(*args: Any, **kwargs: Any) -> Any:
        tensors = [value for value in (*args, *kwargs.values()) if isinstance(value, Tensor)]
        if tensors and tensors[0].is_cuda:
            return original(*args, **kwargs)
        return replacement(*args, **kwargs)

    return by_device


def ray_aabb_intersect(
    rays_o: Tensor,
    rays_d: Tensor,
    aabbs: Tensor,
    near_plane: float = -float("inf"),
    far_plane: float = float("inf"),
    miss_value: float = float("inf"),
) -> tuple[Tensor, Tensor, Tensor]:
    """Where rays [n_rays, 3] enter and leave boxes [m, 6], and whether they hit (nerfacc's).

    Returns:
        t_mins, t_maxs and hits, [n_rays, m]; a box behind the origin is missed.
    """
    spans = [intersect_box(rays_o, rays_d, aabb) for aabb in aabbs]
    t_mins, t_maxs = (torch.stack(bound, dim=-1) for bound in zip(*spans, strict=True))
    hits = (t_mins <= t_maxs) & (t_maxs > 0.0)
    t_mins, t_maxs = t_mins.clamp(min=near_plane), t_maxs.clamp(max=far_plane)
    return t_mins.where(hits, miss_value), t_maxs.where(hits, miss_value), hits


@torch.no_grad()
def traverse_grids(
    rays_o: Tensor,
    rays_d: Tensor,
    binaries: Tensor,
    aabbs: Tensor,
    near_planes: Tensor | None = None,
    far_planes: Tensor | None = None,
    step_size: float = 1e-3,
    cone_angle: float = 0.0,
    traverse_steps_limit: int | None = None,
    over_allocate: bool = False,
    rays_mask: Tensor | None = None,
    t_sorted: Tensor | None = None,
    t_indices: Tensor | None = None,
    hits: Tensor | None = None,
) -> tuple[RayIntervals, RaySamples] | tuple[RayIntervals, RaySamples, Tensor]:
    """March rays through nested grids (nerfacc's function of that name).

    With a constant step the samples are nerfacc's. With a cone angle nerfacc does not let the step
    grow within an empty cell; here it always grows, as in the rule that nerfacc documents.

    Args:
        rays_o, rays_d: [n_rays, 3].
        binaries: bool [levels, nx, ny, nz].
        aabbs: boxes of the levels, each twice as wide as the one before, [levels, 6].
        near_planes, far_planes: where rays begin and end, [n_rays].
        traverse_steps_limit: most samples of a ray, its first ones; None or 0 for all.
        over_allocate: needs a limit, as in nerfacc, and changes nothing: no padding is made.
        rays_mask: rays to march, bool [n_rays]. nerfacc obeys it with `over_allocate` only.
        t_sorted, t_indices, hits: where rays cross the boxes, if that is known: sorted
            [n_rays, 2 levels], the box of each (leaving is counted from `levels` on), and
            bool [n_rays, levels]. A ray is marched from its first to its last crossing.

    Returns:
        the intervals, neighbours sharing an edge, and the samples at their midpoints. From nerfacc
        0.5.3 on also where each ray was left, [n_rays]: the end of its last step, or of its last
        sample where it met the limit; its near plane if it was not marched.

    Raises:
        ValueError: a step is not positive, tensors do not fit, or `over_allocate` has no limit.
    """
    limit = traverse_steps_limit or 0
    if over_allocate and limit <= 0:
        raise ValueError("over_allocate needs a positive traverse_steps_limit")
    if t_sorted is None or t_indices is None or hits is None:
        t_enters, t_leaves = intersect_box(rays_o, rays_d, aabbs[-1])
    else:
        crossed = hits.gather(1, t_indices % len(aabbs))
        t_enters = t_sorted.where(crossed, torch.inf).amin(dim=1)
        t_leaves = t_sorted.where(crossed, -torch.inf).amax(dim=1)
    if far_planes is not None:
        t_leaves = t_leaves.minimum(far_planes)
    if rays_mask is not None:
        t_leaves = t_leaves.where(rays_mask, -torch.inf)
    t_mins = torch.zeros_like(t_leaves) if near_planes is None else near_planes
    rays = Rays(rays_o, rays_d, t_mins, t_leaves, t_enters)
    occupied = functools.partial(lookup, binaries, aabbs[0])
    samples, left = _first_samples(rays, March(step_size, cone_angle), occupied, limit)
    intervals, middles = _shared_edges(*samples, len(rays_o))
    return (intervals, middles, left) if hasattr(middles, "is_valid") else (intervals, middles)


def _first_samples(
    rays: Rays, rule: March, occupied: OccupiedFn, limit: int
) -> tuple[Samples, Tensor]:
    """The first `limit` samples of each ray, 0 for all, and where each ray was left, [n_rays]."""
    ray_indices, t_starts, t_ends = march(rays, rule, occupied)
    steps = number(rays, rule)
    n_steps = steps.first + steps.counts
    left = candidate_edges(steps.t_mins, n_steps, *rule).where(n_steps > 0, rays.t_mins)
    if limit <= 0:
        return (ray_indices, t_starts, t_ends), left
    firsts = packed.pack_info(ray_indices, len(left))[:, 0]
    place = torch.arange(len(ray_indices), device=firsts.device) - firsts[ray_indices]
    left[ray_indices[place == limit - 1]] = t_ends[place == limit - 1]
    within = place < limit
    return (ray_indices[within], t_starts[within], t_ends[within]), left


def _shared_edges(
    ray_indices: Tensor, t_starts: Tensor, t_ends: Tensor, n_rays: int
) -> tuple[RayIntervals, RaySamples]:
    """Samples [n_samples] as nerfacc has them: neighbours share an edge."""
    from nerfacc import RayIntervals, RaySamples

    begins = torch.ones_like(ray_indices, dtype=torch.bool)
    begins[1:] = (ray_indices[1:] != ray_indices[:-1]) | (t_starts[1:] != t_ends[:-1])
    right = torch.arange(len(begins), device=begins.device) + begins.cumsum(0)
    n_edges = int(right[-1]) + 1 if len(right) else 0
    values, edge_rays = t_starts.new_empty(n_edges), ray_indices.new_empty(n_edges)
    is_left, is_right = torch.zeros(2, n_edges, dtype=torch.bool, device=begins.device)
    values[right - 1], values[right] = t_starts, t_ends
    edge_rays[right - 1], edge_rays[right] = ray_indices, ray_indices
    is_left[right - 1], is_right[right] = True, True
    of_edges, of_samples = (packed.pack_info(rays, n_rays) for rays in (edge_rays, ray_indices))
    samples = RaySamples((t_starts + t_ends) * 0.5, of_samples, ray_indices)
    if hasattr(samples, "is_valid"):  # from 0.5.3 on
        samples.is_valid = torch.ones_like(begins)
    return RayIntervals(values, of_edges, edge_rays, is_left, is_right), samples
