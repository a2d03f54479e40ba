"""The interface that a packed host calls: `sampling` and `update_every_n_steps`.

The arguments are those of nerfacc's `OccGridEstimator`, so any estimator here can replace one. It
is a plain `nn.Module`: neither nerfacc nor nerfstudio requires another type. A `Snapshot` tells
whether a module has changed since, without reading one tensor.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from leco_plugin.samplers.boxes import checked_box, intersect_box
from leco_plugin.samplers.marching import NearFn, OccupiedFn, Samples, march
from leco_plugin.samplers.packed import (
    render_transmittance_from_alpha,
    render_transmittance_from_density,
)
from leco_plugin.samplers.rays import March, Rays, check_rays


class Snapshot:
    """The tensors of a module at one time: where each lies, and how often it was written to.

    Of an object that is no module only its identity is known. Writes that torch does not count are
    not noticed: through `.data`, to tensors made in `torch.inference_mode`, and those by which
    `DistributedDataParallel` gives one rank's buffers to the others.
    """

    def __init__(self, module: object) -> None:
        self._identity = id(module)  # a reference would keep it in weak dictionaries for ever
        tensors = _tensors(module)
        self._marks = [_mark(tensor) for tensor in tensors]
        # held, so that nothing else comes to lie at the same address
        self._held = [tensor.detach() for tensor in tensors]

    def matches(self, module: object) -> bool:
        """Whether a module has these tensors, unwritten since; False may be a false alarm."""
        same = id(module) == self._identity
        return same and [_mark(tensor) for tensor in _tensors(module)] == self._marks


def _tensors(module: object) -> list[Tensor]:
    """Parameters and buffers, in a fifth of the time that `named_parameters` takes."""
    modules: list[object] = [module]
    found: list[Tensor | None] = []
    for each in modules:  # grows meanwhile
        if isinstance(each, nn.Module):
            modules += each._modules.values()
            found += each._parameters.values()
            found += each._buffers.values()
    return [tensor for tensor in found if tensor is not None]


def _mark(tensor: Tensor) -> tuple[int, int]:
    return tensor.data_ptr(), 0 if tensor.is_inference() else tensor._version


SampleFn = Callable[[Tensor, Tensor, Tensor], Tensor]
"""t_starts [N], t_ends [N], ray_indices [N] to densities or opacities [N]."""


class Estimator(nn.Module):
    """Marches rays and keeps what a subclass calls occupied."""

    _place: Tensor

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.register_buffer("_place", torch.empty(0), persistent=False)

    @property
    def device(self) -> torch.device:
        """Where the estimator lives, and where rays must be."""
        return self._place.device

    def questions(self) -> tuple[OccupiedFn | None, NearFn | None]:
        """What to ask of positions, and the coarse question if there is one, as for `march`."""
        raise NotImplementedError

    def bounds(self) -> Tensor | None:
        """The box outside which nothing is occupied, [6] of (min, max); None is unbounded."""
        raise NotImplementedError

    def alpha_cap(self, alphas: Tensor) -> Tensor:
        """The highest opacity threshold that pruning may use, from the opacities at hand.

        A fixed threshold rejects every sample of a field that has just begun to learn, which then
        gets no gradient and never learns. A tenth of the mean rejects few while all are alike.
        Opacities that are NaN do not count.
        """
        return alphas.nanmean() * 0.1

    def update_every_n_steps(self, *args: Any, **kwargs: Any) -> None:
        """Called by hosts before each training step."""
        raise NotImplementedError

    def march(self, rays: Rays, rule: March) -> Samples:
        """The candidates along rays that are occupied, whether or not they can be seen."""
        return march(rays, rule, *self.questions())

    @torch.no_grad()
    def sampling(
        self,
        rays_o: Tensor,
        rays_d: Tensor,
        sigma_fn: SampleFn | None = None,
        alpha_fn: SampleFn | None = None,
        near_plane: float = 0.0,
        far_plane: float = 1e10,
        t_min: Tensor | None = None,
        t_max: Tensor | None = None,
        render_step_size: float = 1e-3,
        early_stop_eps: float = 1e-4,
        alpha_thre: float = 0.0,
        stratified: bool = False,
        cone_angle: float = 0.0,
    ) -> Samples:
        """Samples along rays in occupied space.

        Args:
            rays_o, rays_d: origins and directions, world units, [n_rays, 3].
            sigma_fn, alpha_fn: density or opacity of samples (t_starts [N], t_ends [N],
                ray_indices [N]) -> [N]; with one of them, samples that cannot be seen are dropped.
            near_plane, far_plane: where all rays begin and end, world units.
            t_min, t_max: where each ray begins and ends, [n_rays]; the narrower range holds.
            render_step_size: shortest step, world units.
            early_stop_eps: transmittance below which a sample is unseen; 0 turns that off.
            alpha_thre: opacity below which a sample is unseen, where that is less than `alpha_cap`
                (nerfacc's cap is ten times as high); 0 turns it off.
            stratified: shift each ray's samples by a random share of a step.
            cone_angle: growth of the step with distance.

        Returns:
            ray_indices int64 [n_samples], t_starts [n_samples], t_ends [n_samples].

        Raises:
            ValueError: rays do not fit each other or this estimator's device, or have no end.
            TypeError: rays or their limits are no tensors.
        """
        rays = self._rays(rays_o, rays_d, (near_plane, far_plane), (t_min, t_max))
        rule = March(render_step_size, cone_angle)
        if stratified:
            rays = rays.shifted(torch.rand_like(rays.t_mins) * render_step_size)
        samples = self.march(rays, rule)
        if early_stop_eps <= 0.0 and alpha_thre <= 0.0:
            return samples
        limits = (early_stop_eps, alpha_thre, self.alpha_cap)
        return prune(samples, len(rays_o), sigma_fn, alpha_fn, *limits)

    def _rays(
        self,
        rays_o: Tensor,
        rays_d: Tensor,
        planes: tuple[float, float],
        limits: tuple[Tensor | None, Tensor | None],
    ) -> Rays:
        """The rays between the narrower of planes and limits, cut to the bounds."""
        given = {"rays_o": rays_o, "rays_d": rays_d, "t_min": limits[0], "t_max": limits[1]}
        for name, value in given.items():
            if not (isinstance(value, Tensor) or (value is None and name.startswith("t_"))):
                raise TypeError(f"{name} must be a tensor, got {type(value).__name__}")
        if rays_o.dim() != 2 or rays_o.shape[-1] != 3:
            raise ValueError(f"rays_o must be [n_rays, 3], got {list(rays_o.shape)}")
        if rays_o.device != self.device:
            raise ValueError(f"rays are on {rays_o.device}, the estimator on {self.device}")
        t_mins, t_maxs = (torch.full_like(rays_o[:, 0], plane) for plane in planes)
        for name, limit in (("t_min", limits[0]), ("t_max", limits[1])):
            if limit is not None and limit.shape != t_mins.shape:
                raise ValueError(f"{name} must be {list(t_mins.shape)}, got {list(limit.shape)}")
            if limit is not None and limit.device != self.device:
                raise ValueError(f"{name} is on {limit.device}, the estimator on {self.device}")
        t_mins = t_mins if limits[0] is None else t_mins.maximum(limits[0].to(t_mins))
        t_maxs = t_maxs if limits[1] is None else t_maxs.minimum(limits[1].to(t_maxs))
        rays = Rays(rays_o, rays_d, t_mins, t_maxs)
        check_rays(rays)
        bounds = self.bounds()
        if bounds is None:
            return rays
        t_enters, t_leaves = intersect_box(rays_o, rays_d, bounds.to(rays_o))
        return rays._replace(t_maxs=t_maxs.minimum(t_leaves), t_enters=t_enters)


@torch.no_grad()
def prune(
    samples: Samples,
    n_rays: int,
    sigma_fn: SampleFn | None = None,
    alpha_fn: SampleFn | None = None,
    early_stop_eps: float = 1e-4,
    alpha_thre: float = 0.0,
    alpha_cap: Callable[[Tensor], Tensor] | None = None,
) -> Samples:
    """Samples but those with T < early_stop_eps or alpha < alpha_thre, in the same order.

    All are asked at once, as nerfacc does; without a function to ask, all are kept. A sample in
    the light whose answer is NaN is kept, so that the loss shows it.

    Args:
        samples: as `march` returns them.
        sigma_fn, alpha_fn: as of `Estimator.sampling`.
        alpha_cap: keeps `alpha_thre` from rejecting everything, see `Estimator.alpha_cap`.

    Raises:
        ValueError: a function's answer is not one number for each sample.
    """
    ray_indices, t_starts, t_ends = samples
    query = alpha_fn if sigma_fn is None else sigma_fn
    if query is None or ray_indices.numel() == 0:
        return samples
    answers = query(t_starts, t_ends, ray_indices)
    if answers.shape != t_starts.shape:
        raise ValueError(
            f"sigma_fn or alpha_fn must answer {list(t_starts.shape)}, got {list(answers.shape)}"
        )
    if sigma_fn is None:
        trans = render_transmittance_from_alpha(answers, ray_indices=ray_indices, n_rays=n_rays)
        alphas = answers
    else:
        trans, alphas = render_transmittance_from_density(
            t_starts, t_ends, answers, ray_indices=ray_indices, n_rays=n_rays
        )
    hidden = trans < early_stop_eps
    if alpha_thre > 0.0:
        threshold = alphas.new_full((), alpha_thre)
        if alpha_cap is not None:
            threshold = threshold.fmin(alpha_cap(alphas).to(threshold))
        hidden |= alphas < threshold
    left = hidden.logical_not_().nonzero()[:, 0]
    ray_indices, t_starts, t_ends = (tensor.index_select(0, left) for tensor in samples)
    return ray_indices, t_starts, t_ends


def midpoints(samples: Samples, rays_o: Tensor, rays_d: Tensor) -> Tensor:
    """Positions in the middle of samples [n_samples, 3], along rays [n_rays, 3]."""
    ray_indices, t_starts, t_ends = samples
    origins, directions = (rays.index_select(0, ray_indices) for rays in (rays_o, rays_d))
    return torch.addcmul(origins, directions, ((t_starts + t_ends) * 0.5)[:, None])


def densities_of_samples(
    density_fn: Callable[[Tensor], Tensor], rays_o: Tensor, rays_d: Tensor
) -> SampleFn:
    """Density of samples from that of positions, [N, 3] to [N] or [N, 1], at the midpoints."""

    def sigma_fn(t_starts: Tensor, t_ends: Tensor, ray_indices: Tensor) -> Tensor:
        return density_fn(midpoints((ray_indices, t_starts, t_ends), rays_o, rays_d)).reshape(-1)

    return sigma_fn


class DenseEstimator(Estimator):
    """Keeps every candidate: the reference that skipping is measured against. Rays are clipped to a
    box (min, max), [6], if there is one: ValueError if it is empty or not finite."""

    aabbs: Tensor

    def __init__(self, aabb: Sequence[float] | Tensor | None = None) -> None:
        super().__init__()
        boxes = torch.empty(0, 6) if aabb is None else checked_box(aabb)[None]
        self.register_buffer("aabbs", boxes)

    def questions(self) -> tuple[OccupiedFn | None, NearFn | None]:
        return None, None

    def bounds(self) -> Tensor | None:
        return self.aabbs[-1] if len(self.aabbs) else None

    def update_every_n_steps(self, *args: Any, **kwargs: Any) -> None:
        """Nothing to learn."""
