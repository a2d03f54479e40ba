"""What stands where a host had its own grid or proposal networks.

Behind it is a sampler of the registry, built when it is first asked and again when the occupancy
has changed. It is asked in the occupancy's coordinates, and the host is answered in its own.
"""

from __future__ import annotations

import functools
import inspect
from typing import TYPE_CHECKING, Any, cast

import torch
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.model_components.ray_samplers import Sampler
from torch import Tensor, nn

from leco_plugin.models.region import within_crop
from leco_plugin.models.rendering import Intervals, Rays, with_backdrop
from leco_plugin.occupancy import SHOWN
from leco_plugin.samplers.base import Estimator
from leco_plugin.samplers.boxes import cell_centers, intersect_box
from leco_plugin.samplers.estimator import LearnedOccupancyEstimator
from leco_plugin.samplers.rays import usable_rays
from leco_plugin.samplers.registry import build_estimator, build_proposal
from leco_plugin.scenes.frames import box_around, inverse, moved, turned

if TYPE_CHECKING:
    from leco_plugin.hosts.guide import Guide


class _StandIn(nn.Module):
    """Builds the real sampler when it is first asked, and again when the occupancy has changed."""

    def __init__(self, guide: Guide) -> None:
        super().__init__()
        # in a tuple and a dict: neither guide nor samplers are a part of this module's state
        self._guide = (guide,)
        self._built: dict[bool, tuple[Any, nn.Module]] = {}

    @property
    def guide(self) -> Guide:
        """Of the host."""
        return self._guide[0]

    def _build(self, guide: Guide) -> nn.Module:
        raise NotImplementedError

    def __dir__(self) -> list[str]:
        """Without properties: nerfstudio's viewer takes the value of every name that it finds here,
        and these build a sampler, for which there may be no occupancy yet, and ask it at length."""
        found = {name: getattr(type(self), name, None) for name in super().__dir__()}
        return [name for name, value in found.items() if not isinstance(value, property)]

    @property
    def sampler(self) -> nn.Module:
        """The sampler behind this; its mode follows the host's."""
        guide, shown = self.guide, SHOWN.get()
        key, is_own = (guide.version, guide.frame.device, shown), shown is None
        if is_own not in self._built or self._built[is_own][0] != key:
            self._built[is_own] = (key, self._build(guide).to(guide.frame.device))
        return self._built[is_own][1].train(self.training)


_SAMPLING = inspect.signature(Estimator.sampling)
_RAYS = ("self", "rays_o", "rays_d")
DEFAULTS = {name: parameter.default for name, parameter in _SAMPLING.parameters.items()}
"""Of a host's sampling, where it does not say."""


def _ending_in_a_backdrop(
    samples: tuple[Tensor, Tensor, Tensor],
    rays_o: Tensor,
    rays_d: Tensor,
    options: dict[str, Any],
    walls: Tensor,
    crop: tuple[Tensor | None, Tensor | None],
    cut_off: Tensor | None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Packed samples whose rays, some without any, end in one interval that no gate skips.

    The gate was learned before such a backdrop, and skips what that shows: a host without one would
    have no place for the sky. It begins where a ray leaves the occupancy's walls [6], or, of one
    that misses them, at its end; a ray that a crop ends, or that is cut off [R], has none.
    """
    options = DEFAULTS | options
    ends = rays_o.new_full((len(rays_o),), float(options["far_plane"]))
    ends = ends if options["t_max"] is None else ends.minimum(options["t_max"])
    enters, leaves = intersect_box(rays_o, rays_d, walls)
    begins = torch.full_like(ends, float(options["near_plane"]))
    begins = begins if options["t_min"] is None else begins.maximum(options["t_min"])
    meets = leaves > enters.maximum(begins).clamp(min=0.0)
    ends = torch.where(meets, leaves.minimum(ends), ends)
    rays = within_crop(Rays(rays_o, rays_d, begins, ends, None, cut_off), *crop)
    ended = with_backdrop(
        Intervals(*samples), rays, options["render_step_size"], options["cone_angle"]
    )
    usable = usable_rays(torch.stack([rays_o.t(), rays_d.t()]), rays.t_mins, rays.t_maxs)
    kept = usable[ended.ray_indices] | (ended.t_ends < rays.t_maxs[ended.ray_indices])
    chosen = (kept & (ended.t_ends > ended.t_starts)).nonzero()[:, 0]
    ray_indices, t_starts, t_ends = (part.index_select(0, chosen) for part in ended)
    return ray_indices, t_starts, t_ends


class GuidedEstimator(_StandIn):
    """A packed sampler of the registry, in the host's coordinates."""

    def __init__(self, guide: Guide, aabb: Tensor | None, outermost: Tensor | None = None) -> None:
        super().__init__(guide)
        self._aabb = None if aabb is None else aabb.detach().cpu()
        self._outermost = None if outermost is None else outermost.detach().cpu()

    def _build(self, guide: Guide) -> nn.Module:
        aabb = self._aabb
        if aabb is not None and not guide.same_frame():
            aabb = box_around(aabb, guide.frame.cpu())
        return guide.built(build_estimator, aabb=aabb, occupancy=guide.followed())

    @torch.no_grad()
    @functools.wraps(Estimator.sampling)
    def sampling(self, rays_o: Tensor, rays_d: Tensor, *args: Any, **kwargs: Any) -> Any:
        guide = self.guide
        bound = _SAMPLING.bind(self, rays_o, rays_d, *args, **kwargs).arguments
        given = {name: value for name, value in bound.items() if name not in _RAYS}
        options = uncropped = self._with_an_end(rays_o, rays_d, given)
        crop: tuple[Tensor | None, Tensor | None] = (None, None)
        if guide.cropped:
            crop = given.get("t_min"), given.get("t_max")
            limitless = given | {"t_min": None, "t_max": None}
            uncropped = self._with_an_end(rays_o, rays_d, limitless)
        if not guide.same_frame():
            # a direction carries the scale, so that distances along the ray stay the host's
            frame = guide.frame.to(rays_o)
            rays_o, rays_d = moved(rays_o, frame), turned(rays_d, frame)
        if guide.listener is not None:
            samples = guide.listener(rays_o, rays_d, options)
        else:
            estimator: Any = self.dense if guide.dense else self.sampler
            samples = estimator.sampling(rays_o, rays_d, **options)
        if self.training:
            guide.kept = len(samples[0])
        occupancy = guide.the_occupancy()
        if occupancy.shows_a_backdrop() and not (guide.dense and self._is_endless()):
            cut_off = None if self.training else guide.lacks_backdrop(rays_o, rays_d)
            samples = _ending_in_a_backdrop(
                samples, rays_o, rays_d, uncropped, occupancy.walls, crop, cut_off
            )
        return samples

    @property
    def dense(self) -> nn.Module:
        """Keeps every candidate that the sampler behind this asks about; of one that is no
        `Estimator` and names no bounds, those within the occupancy's."""
        sampler = self.sampler
        if not isinstance(sampler, Estimator):
            sampler = LearnedOccupancyEstimator(self.guide.the_occupancy(), cache_bytes=0)
        box = sampler.bounds()
        return build_estimator("dense", aabb=box).to(self.guide.frame.device).train(self.training)

    def _with_an_end(self, rays_o: Tensor, rays_d: Tensor, given: dict[str, Any]) -> dict[str, Any]:
        """The options of `sampling`; rays that would go on for ever end at the host's box, on which
        a host whose steps do not grow relies, and an unbounded occupancy has none."""
        if not self._is_endless() or self._outermost is None or given.get("cone_angle"):
            return given
        _, leaves = intersect_box(rays_o, rays_d, self._outermost.to(rays_o))
        t_max = given.get("t_max")
        return given | {"t_max": leaves if t_max is None else leaves.minimum(t_max)}

    def _is_endless(self) -> bool:
        """Whether the occupancy goes on into the distance."""
        return self.guide.the_occupancy().space.kind == "contraction"

    def update_every_n_steps(self, *args: Any, **kwargs: Any) -> None:
        """Called by hosts before each training step; a frozen gate has nothing to update."""
        estimator: Any = self.sampler
        estimator.update_every_n_steps(*args, **kwargs)

    def mark_invisible_cells(self, *args: Any, **kwargs: Any) -> None:
        """Called by hosts before training; a gate has no cells to mark."""

    @property
    def aabbs(self) -> Tensor:
        """Boxes of the sampler behind this, in the host's coordinates, [n_boxes, 6]."""
        boxes: Tensor = cast(Any, self.sampler).aabbs
        if self.guide.same_frame():
            return boxes
        back = inverse(self.guide.frame)
        return torch.stack([box_around(box, back) for box in boxes])

    @property
    def occs(self) -> Tensor:
        """o at the centres of the cells of `aabbs`, [n_boxes * cells]."""
        guide, sampler = self.guide, cast(Any, self.sampler)
        if guide.same_frame():
            return cast(Tensor, sampler.occs)
        cells = cell_centers(self.aabbs, sampler.resolution)
        with torch.no_grad():
            return guide.the_occupancy().query(moved(cells, guide.frame))

    @property
    def binaries(self) -> Tensor:
        """Decisions at the centres of the cells of `aabbs`, bool [n_boxes, n, n, n]."""
        sampler: Any = self.sampler
        if self.guide.same_frame():
            return cast(Tensor, sampler.binaries)
        occupied = self.occs >= self.guide.followed().threshold
        return occupied.view(-1, *sampler.resolution.tolist())

    def __getattr__(self, name: str) -> Any:
        if name in ("resolution", "levels", "cells_per_lvl", "device"):
            return getattr(self.sampler, name)
        return super().__getattr__(name)


def is_packed(host: nn.Module) -> bool:
    """Whether a guided host shades only what its sampler keeps, and not a fixed number a ray."""
    return any(isinstance(module, GuidedEstimator) for module in host.modules())


class GuidedProposal(_StandIn, Sampler):
    """A proposal sampler of the registry, in the host's coordinates."""

    def __init__(self, guide: Guide, options: dict[str, Any]) -> None:
        super().__init__(guide)
        self._options = options

    def _build(self, guide: Guide) -> nn.Module:
        options = {**self._options, "occupancy": None}
        if guide.needs_occupancy:
            shown = SHOWN.get() is not None
            options["occupancy"] = guide.followed() if shown else guide.the_occupancy()
            if not guide.same_frame():
                options["frame"] = guide.frame
        return guide.built(build_proposal, **options)

    def forward(self, *args: Any, **kwargs: Any) -> Any:
        """As of the sampler behind this. Rendered rays that meet nothing occupied, and whose
        backdrop training has never seen, have samples without length: the field has learned nothing
        there."""
        guide = self.guide
        made, guide.without_backdrop = self.sampler(*args, **kwargs), None
        if self.training or not guide.needs_occupancy:
            return made
        rays: RayBundle = args[0] if args else kwargs["ray_bundle"]
        frame = guide.frame.to(rays.origins)
        unseen = guide.lacks_backdrop(moved(rays.origins, frame), turned(rays.directions, frame))
        guide.without_backdrop = unseen[:, None]
        samples, weights, _ = made
        if len(weights) > 0:
            nowhere = (unseen & (weights[0].sum(dim=(-2, -1)) <= 0.0))[:, None, None]
            frustums = samples.frustums
            frustums.ends = torch.where(nowhere, frustums.starts, frustums.ends)
            samples.deltas = samples.deltas.masked_fill(nowhere, 0.0)
        return made

    generate_ray_samples = forward

    def set_anneal(self, anneal: float) -> None:
        """Called by hosts for proposal networks, of which there are none."""

    def step_cb(self, step: int) -> None:
        """Called by hosts after a training step; nothing is scheduled here."""
