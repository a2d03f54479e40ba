"""nerfacc where there is no CUDA: its kernels replaced by this package's plain torch.

nerfacc 0.5.2 packs, scans and traverses grids on CUDA only, so that a stock host such as
nerfstudio's `instant-ngp` cannot run anywhere else. `install` puts a switch in front of each of
these functions: CUDA tensors go to nerfacc's kernels as before, all others to the functions here.
It is called when a model is built, never as a side effect of an import.

What a module imported by name before (`from nerfacc import pack_info`) is replaced there too. A
function that was put elsewhere, in a class, a partial or a default argument, stays nerfacc's own.
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
from leco_plugin.samplers.grid import lookup
from leco_plugin.samplers.marching import march
from leco_plugin.samplers.marching.rays import intersect_box

if TYPE_CHECKING:
    from nerfacc import RayIntervals, RaySamples

Function = Callable[..., Any]

_switches: list[tuple[Function, Function]] = []
"""Functions of nerfacc, and what stands in front of them."""


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
        if not _takes_as_much(replacement, getattr(nerfacc, name, None)):
            raise ImportError(
                f"{name} of nerfacc {nerfacc.__version__} is not that of 0.5.2, for which this is "
                "written: pip install nerfacc==0.5.2, which nerfstudio asks for too"
            )
    originals = {name: getattr(nerfacc, name) for name in replacements}
    _switches.extend((old, _switch(old, replacements[name])) for name, old in originals.items())
    _rebind(dict(_switches))


def uninstall() -> None:
    """Give nerfacc its own functions back."""
    _rebind({switch: original for original, switch in _switches})
    _switches.clear()


def _takes_as_much(replacement: Function, original: Function | None) -> bool:
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
) -> tuple[RayIntervals, RaySamples]:
    """March rays through nested grids (nerfacc's function of that name).

    With a constant step the samples are nerfacc's. With a cone angle nerfacc keeps the step it had
    on entering an empty cell until it leaves it, so that samples behind empty space depend on the
    grid; here the step always grows with distance, as in the rule that nerfacc documents.

    Args:
        rays_o, rays_d: [n_rays, 3].
        binaries: bool [levels, nx, ny, nz].
        aabbs: boxes of the levels, each twice as wide as the one before, [levels, 6].
        near_planes, far_planes: where rays begin and end, [n_rays].
        step_size: shortest step, > 0.
        cone_angle: growth of the step with distance.

    Returns:
        the intervals, neighbours sharing an edge, and the samples at their midpoints.
    """
    from nerfacc import RayIntervals, RaySamples

    t_enters, t_leaves = intersect_box(rays_o, rays_d, aabbs[-1])
    t_mins = torch.zeros_like(t_leaves) if near_planes is None else near_planes
    ray_indices, t_starts, t_ends = march(
        rays_o,
        rays_d,
        t_mins,
        t_leaves if far_planes is None else t_leaves.minimum(far_planes),
        step_size=step_size,
        cone_angle=cone_angle,
        occupied=lambda positions: lookup(binaries, aabbs[0], positions),
        t_enters=t_enters,
    )
    begins = torch.ones_like(ray_indices, dtype=torch.bool)
    begins[1:] = (ray_indices[1:] != ray_indices[:-1]) | (t_starts[1:] != t_ends[:-1])
    right = torch.arange(len(begins), device=begins.device) + begins.cumsum(0)
    n_edges = int(right[-1]) + 1 if len(right) else 0
    values, edge_rays = t_starts.new_empty(n_edges), ray_indices.new_empty(n_edges)
    is_left = torch.zeros(n_edges, dtype=torch.bool, device=begins.device)
    is_right = is_left.clone()
    values[right - 1], values[right] = t_starts, t_ends
    edge_rays[right - 1], edge_rays[right] = ray_indices, ray_indices
    is_left[right - 1], is_right[right] = True, True
    intervals = RayIntervals(
        vals=values,
        packed_info=packed.pack_info(edge_rays, len(rays_o)),
        ray_indices=edge_rays,
        is_left=is_left,
        is_right=is_right,
    )
    samples = RaySamples(
        vals=(t_starts + t_ends) * 0.5,
        packed_info=packed.pack_info(ray_indices, len(rays_o)),
        ray_indices=ray_indices,
    )
    return intervals, samples
