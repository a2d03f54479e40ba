"""What guides a host: an occupancy, and the samplers that are made from it when they are asked.

A host keeps stand-ins where it had its own samplers. They are made before there is an occupancy: it
may still have to be learned, or to come with a checkpoint whose gate has a shape of its own.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Mapping
from typing import Any, cast

import torch
from nerfstudio.model_components.ray_samplers import Sampler
from nerfstudio.viewer_legacy.server.viewer_utils import IOChangeException
from torch import Tensor, nn

from leco_plugin.models.gate import Gate, GateConfig
from leco_plugin.occupancy import Occupancy
from leco_plugin.samplers.base import Estimator
from leco_plugin.samplers.estimator import cell_centers
from leco_plugin.samplers.rays import intersect_box
from leco_plugin.samplers.registry import (
    SamplerSpec,
    build_estimator,
    build_proposal,
    sampler_spec,
)
from leco_plugin.scenes.frames import box_around, inverse
from leco_plugin.scenes.input_error import InputError
from leco_plugin.space import Space

DensityFn = Callable[[Tensor], Tensor]
"""Positions [N, 3] to densities [N] or [N, 1]."""


class NoOccupancyYet(RuntimeError, IOChangeException):
    """A guided host was asked before it had an occupancy.

    As an `IOChangeException` it tells nerfstudio's viewer, which may have a client before the first
    step, that there is no picture for now; any other exception would end its rendering for good.
    """


class Guide(nn.Module):
    """The occupancy of a host, with its place in the host's checkpoints.

    Args:
        sampler: name in the registry of samplers.
        options: of that sampler.
        front_to_back: whether packed hosts render so, see `Estimator.density_fn`.

    Attributes:
        occupancy: None until there is one.
        dense: whether packed samplers keep every candidate for the moment, as a reference.
        kept: samples that a packed sampler kept when it was last asked in training.
        watched: what was found of the price of skipping; travels with a checkpoint.
        first_density: with which the host's field began, None for its own; see `opaque_start`.
        frame: [3, 4] takes positions of the host to those of the occupancy: a rotation times a
            scale, and a translation.
    """

    frame: Tensor

    def __init__(
        self,
        sampler: str = "learned-occupancy",
        options: Mapping[str, Any] | None = None,
        front_to_back: bool = False,
    ) -> None:
        super().__init__()
        self.sampler, self.front_to_back = sampler, front_to_back
        self.options = dict(options or {})
        self.occupancy: Occupancy | None = None
        self.version = 0
        self.dense = False
        self.kept: int | None = None
        self.watched: dict[str, Any] = {}
        self.first_density: float | None = None
        self.register_buffer("frame", torch.eye(3, 4))
        self.register_load_state_dict_post_hook(lambda guide, _: guide.changed())

    @property
    def needs_occupancy(self) -> bool:
        """Whether the sampler asks a gate at all; a grid does not.

        Raises:
            InputError: there is no such sampler.
        """
        return self._spec().needs_occupancy

    def _spec(self, kind: str | None = None) -> SamplerSpec:
        """What is registered under the sampler's name, and serves this kind of hosts."""
        try:
            spec = sampler_spec(self.sampler)
        except ValueError as error:
            raise InputError(str(error)) from None
        if kind is not None and getattr(spec, kind) is None:
            raise InputError(
                f"the sampler {self.sampler!r} cannot go into this host: it has no {kind}"
            )
        return spec

    def changed(self) -> None:
        """Samplers that were made are made anew when they are next asked."""
        self.version += 1

    def set_occupancy(self, occupancy: Occupancy, frame: Tensor | None = None) -> None:
        """Guides by this occupancy from now on; `frame` as the attribute, None for no change."""
        self.occupancy = occupancy.to(self.frame.device).eval()
        self.occupancy.requires_grad_(False)
        if frame is not None:
            self.frame.copy_(frame)
        self.changed()

    def the_occupancy(self) -> Occupancy:
        """The occupancy.

        Raises:
            NoOccupancyYet: there is none yet.
        """
        if self.occupancy is None:
            raise NoOccupancyYet(
                "this model has no occupancy yet: train it, load a checkpoint, or give a file with "
                "--pipeline.model.occupancy.path"
            )
        return self.occupancy

    def the_occupancy_skips(self) -> bool:
        """Whether it skips anything; at threshold 0 it does not, and need not be asked."""
        return not self.needs_occupancy or self.the_occupancy().threshold > 0.0

    def same_frame(self) -> bool:
        """Whether host and occupancy share their coordinates."""
        return torch.equal(self.frame, torch.eye(3, 4, device=self.frame.device))

    def estimator(
        self,
        aabb: Tensor | None,
        outermost: Tensor | None = None,
        density_fn: DensityFn | None = None,
    ) -> nn.Module:
        """What goes where a packed host has its estimator.

        Args:
            aabb: box of that estimator, [6]; None where the host cuts its rays itself.
            outermost: the box in which the host's own samples at all, [6]; None is no such box.
            density_fn: the host's density at positions [N, 3], for rendering front to back.
        Raises:
            InputError: the sampler has no estimator.
        """
        if self._spec("estimator").needs_occupancy:
            return GuidedEstimator(self, aabb, outermost, density_fn)
        estimator = build_estimator(self.sampler, aabb=aabb, occupancy=None, **self.options)
        if self.front_to_back and isinstance(estimator, Estimator):
            estimator.density_fn = density_fn
        return estimator

    def proposal(self, **options: Any) -> Sampler:
        """What goes where a proposal host has its sampler; options as for the registry.

        Raises:
            InputError: the sampler has nothing for proposal hosts.
        """
        self._spec("proposal")
        return GuidedProposal(self, {**options, **self.options})

    def get_extra_state(self) -> dict[str, Any]:
        """What a checkpoint must say before the gate's weights can be read."""
        if self.occupancy is None:
            return {}
        return {
            "gate": self.occupancy.gate.config.to_dict(),
            "precision": self.occupancy.precision,
            "report": self.occupancy.report,
            "watched": self.watched,
            "first_density": self.first_density,
        }

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Makes an occupancy of the checkpoint's shape; torch then reads its weights."""
        if state:
            self.watched = dict(state.get("watched", {}))
            self.first_density = state.get("first_density")
            gate = Gate(GateConfig.from_dict(state["gate"]))
            occupancy = Occupancy(gate, Space(), 0.0, state["precision"], state["report"])
            self.set_occupancy(occupancy)


def turned(directions: Tensor, frame: Tensor) -> Tensor:
    """Directions [N, 3] by turn and scale of a frame [3, 4], in whatever precision a host is."""
    with torch.autocast(directions.device.type, enabled=False):
        return directions @ frame[:, :3].T


def moved(positions: Tensor, frame: Tensor) -> Tensor:
    """Positions [N, 3] taken to another frame [3, 4]."""
    return turned(positions, frame) + frame[:, 3]


class _StandIn(nn.Module):
    """Builds the real sampler when it is first asked, and again when the occupancy has changed."""

    def __init__(self, guide: Guide) -> None:
        super().__init__()
        # in tuples: neither the guide nor the sampler is a part of this module's state
        self._guide = (guide,)
        self._built: tuple[Any, tuple[nn.Module, ...]] = (None, ())

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
        (guide,) = self._guide
        key = (guide.version, guide.frame.device)
        if self._built[0] != key:
            self._built = (key, (self._build(guide).to(guide.frame.device),))
        return self._built[1][0].train(self.training)


_SAMPLING = inspect.signature(Estimator.sampling)


class GuidedEstimator(_StandIn):
    """A packed sampler of the registry, in the host's coordinates."""

    def __init__(
        self,
        guide: Guide,
        aabb: Tensor | None,
        outermost: Tensor | None = None,
        density_fn: DensityFn | None = None,
    ) -> None:
        super().__init__(guide)
        self._density_fn = density_fn
        self._aabb = None if aabb is None else aabb.detach().cpu()
        self._outermost = None if outermost is None else outermost.detach().cpu()

    def _build(self, guide: Guide) -> nn.Module:
        aabb = self._aabb
        if aabb is not None and not guide.same_frame():
            aabb = box_around(aabb, guide.frame.cpu())
        estimator = build_estimator(
            guide.sampler, aabb=aabb, occupancy=guide.the_occupancy(), **guide.options
        )
        if guide.front_to_back and isinstance(estimator, Estimator):
            estimator.density_fn = self._density_of(guide)
        return estimator

    def _density_of(self, guide: Guide) -> DensityFn | None:
        """The host's density, asked at positions of the occupancy."""
        ask = self._density_fn
        if ask is None or guide.same_frame():
            return ask
        back = inverse(guide.frame)
        return lambda positions: ask(moved(positions, back))

    @functools.wraps(Estimator.sampling)
    def sampling(self, rays_o: Tensor, rays_d: Tensor, *args: Any, **kwargs: Any) -> Any:
        (guide,) = self._guide
        estimator: Any = self.dense if guide.dense else self.sampler
        options = self._with_an_end(_SAMPLING.bind(self, rays_o, rays_d, *args, **kwargs).arguments)
        if not guide.same_frame():
            # a direction carries the scale, so that distances along the ray stay the host's
            frame = guide.frame.to(rays_o)
            rays_o, rays_d = moved(rays_o, frame), turned(rays_d, frame)
        samples = estimator.sampling(rays_o, rays_d, **options)
        if self.training:
            guide.kept = len(samples[0])
        return samples

    @property
    def dense(self) -> nn.Module:
        """Keeps every candidate that the sampler behind this asks about."""
        (guide,) = self._guide
        box = self.sampler.bounds() if isinstance(self.sampler, Estimator) else None
        return build_estimator("dense", aabb=box).to(guide.frame.device).train(self.training)

    def _with_an_end(self, arguments: dict[str, Any]) -> dict[str, Any]:
        """The options of `sampling`; rays that would go on for ever end at the host's box.

        A host whose steps do not grow relies on the box of its own estimator, and an unbounded
        occupancy has none.
        """
        (guide,) = self._guide
        _, rays_o, rays_d = (arguments.pop(name) for name in ("self", "rays_o", "rays_d"))
        endless = guide.the_occupancy().space.kind == "contraction"
        if endless and self._outermost is not None and not arguments.get("cone_angle"):
            _, leaves = intersect_box(rays_o, rays_d, self._outermost.to(rays_o))
            t_max = arguments.get("t_max")
            arguments["t_max"] = leaves if t_max is None else leaves.minimum(t_max)
        return arguments

    def update_every_n_steps(self, *args: Any, **kwargs: Any) -> None:
        """Called by hosts before each training step; a frozen gate has nothing to update."""
        estimator: Any = self.sampler
        estimator.update_every_n_steps(*args, **kwargs)

    @property
    def aabbs(self) -> Tensor:
        """Boxes of the sampler behind this, in the host's coordinates, [n_boxes, 6]."""
        (guide,) = self._guide
        boxes: Tensor = cast(Any, self.sampler).aabbs
        if guide.same_frame():
            return boxes
        back = inverse(guide.frame)
        return torch.stack([box_around(box, back) for box in boxes])

    @property
    def occs(self) -> Tensor:
        """o at the centres of the cells of `aabbs`, [n_boxes * cells]."""
        (guide,) = self._guide
        sampler: Any = self.sampler
        if guide.same_frame():
            return cast(Tensor, sampler.occs)
        cells = cell_centers(self.aabbs, sampler.resolution)
        with torch.no_grad():
            return guide.the_occupancy().query(moved(cells, guide.frame))

    @property
    def binaries(self) -> Tensor:
        """Decisions at the centres of the cells of `aabbs`, bool [n_boxes, n, n, n]."""
        (guide,) = self._guide
        sampler: Any = self.sampler
        if guide.same_frame():
            return cast(Tensor, sampler.binaries)
        occupied = self.occs >= guide.the_occupancy().threshold
        return occupied.view(-1, *sampler.resolution.tolist())

    def __getattr__(self, name: str) -> Any:
        if name in ("resolution", "device"):
            return getattr(self.sampler, name)
        return super().__getattr__(name)


class GuidedProposal(_StandIn, Sampler):
    """A proposal sampler of the registry, in the host's coordinates."""

    def __init__(self, guide: Guide, options: dict[str, Any]) -> None:
        super().__init__(guide)
        self._options = options

    def _build(self, guide: Guide) -> nn.Module:
        options = {**self._options, "occupancy": None}
        if guide.needs_occupancy:
            options["occupancy"] = guide.the_occupancy()
            if not guide.same_frame():
                options["frame"] = guide.frame
        return build_proposal(guide.sampler, **options)

    def forward(self, *args: Any, **kwargs: Any) -> Any:
        return self.sampler(*args, **kwargs)

    def generate_ray_samples(self, *args: Any, **kwargs: Any) -> Any:
        """As of the sampler behind this."""
        return self.sampler(*args, **kwargs)

    def set_anneal(self, anneal: float) -> None:
        """Called by hosts for proposal networks, of which there are none."""

    def step_cb(self, step: int) -> None:
        """Called by hosts after a training step; nothing is scheduled here."""
