"""What guides a host: an occupancy with its place in the host's checkpoints.

A host keeps stand-ins where it had its own samplers (`stand_ins`). They are made before there is an
occupancy: it may still have to be learned, or to come with a checkpoint whose gate has a shape of
its own.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cached_property
from typing import Any

import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.model_components.ray_samplers import Sampler
from nerfstudio.viewer_legacy.server.viewer_utils import IOChangeException
from torch import Tensor, nn

from leco_plugin.hosts.stand_ins import GuidedEstimator, GuidedProposal
from leco_plugin.learning.run import WatchState
from leco_plugin.models.gate import Gate, GateConfig
from leco_plugin.models.region import FARTHEST, SIDE, Region, SeenBackdrops
from leco_plugin.occupancy import SHOWN, Occupancy
from leco_plugin.on_cpu import on_cpu
from leco_plugin.samplers.registry import (
    OURS,
    SamplerSpec,
    build_estimator,
    has_option,
    sampler_spec,
    spec_for,
)
from leco_plugin.scenes.frames import moved, turned
from leco_plugin.scenes.input_error import InputError, one_line, require_keys, state_of_this_version
from leco_plugin.scenes.survey import covering_rays
from leco_plugin.space import Space

STATE = ("gate", "precision", "report", "watched", "first_density")
"""What a checkpoint holds of a guide with an occupancy, beside tensors."""


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

    Attributes:
        occupancy: None until there is one.
        dense: whether packed samplers keep every candidate for the moment, as a reference.
        cropped: whether the limits of the rays that are rendered now are those of a crop.
        without_proposals: whether the host's proposal networks are gone.
        listener: what answers packed samplers for the moment, in place of what they build; called
            with origins and directions [R, 3] in the occupancy's coordinates, and the options.
        kept: samples that a packed sampler kept when it was last asked in training.
        watched: what is known of the price of skipping; travels with a checkpoint.
        first_density: with which the host's field began, None for its own; see `first_steps`.
        frame: [3, 4] takes positions of the host to those of the occupancy: a rotation times a
            scale, and a translation.
        backdrops: those that training has seen, in the occupancy's coordinates.
        without_backdrop: [R, 1], of the rays that a proposal host renders now, those whose backdrop
            was never seen; None while it trains.
    """

    frame: Tensor

    def __init__(
        self, sampler: str = "learned-occupancy", options: Mapping[str, Any] | None = None
    ) -> None:
        super().__init__()
        self.sampler = sampler
        self.options = dict(options or {})
        self.occupancy: Occupancy | None = None
        self.version = 0
        self.dense = self.cropped = self.without_proposals = False
        self.kept: int | None = None
        self.listener: Callable[[Tensor, Tensor, dict[str, Any]], Any] | None = None
        self.watched = WatchState()
        self.first_density: float | None = None
        self.register_buffer("frame", torch.eye(3, 4))
        self.backdrops = SeenBackdrops()
        self.without_backdrop: Tensor | None = None
        self.register_load_state_dict_post_hook(lambda guide, _: guide.changed())

    @cached_property
    def needs_occupancy(self) -> bool:
        """Whether the sampler asks a gate at all; a grid does not. InputError if there is no such
        one. Looked up once: hosts ask in every step, and to find another package's takes 30 ms."""
        return self._spec().needs_occupancy

    def _spec(self, kind: str | None = None) -> SamplerSpec:
        """What is registered under the sampler's name, and serves this kind of hosts."""
        try:
            if kind is None:
                return sampler_spec(self.sampler)
            return spec_for(self.sampler, kind, self.options)
        except ValueError as error:
            raise InputError(str(error)) from None

    def changed(self) -> None:
        """Samplers that were made are made anew when they are next asked."""
        self.version += 1

    def set_occupancy(self, occupancy: Occupancy, frame: Tensor | None = None) -> None:
        """Guides by this occupancy from now on; `frame` as the attribute, None for no change."""
        self.occupancy = occupancy.to(self.frame.device).eval().requires_grad_(False)
        if frame is not None:
            self.frame.copy_(frame)
        self.changed()

    def the_occupancy(self) -> Occupancy:
        """The occupancy. NoOccupancyYet if there is none yet."""
        if self.occupancy is None:
            raise NoOccupancyYet(
                "this model has no occupancy yet: train it, load a checkpoint, or give a file with "
                "--pipeline.model.occupancy.path"
            )
        return self.occupancy

    def followed(self) -> Occupancy:
        """The occupancy with the threshold that samplers follow now. NoOccupancyYet for none."""
        occupancy, shown = self.the_occupancy(), SHOWN.get()
        threshold = self.watched.lower if shown is None else shown
        return occupancy if threshold is None else occupancy.with_threshold(threshold)

    def same_frame(self) -> bool:
        """Whether host and occupancy share their coordinates."""
        return torch.equal(on_cpu(self.frame), torch.eye(3, 4))

    def look(self, cameras: Cameras) -> None:
        """Notes the backdrops that these training cameras see."""
        origins, directions = (part.reshape(-1, 3) for part in covering_rays(cameras, SIDE))
        frame = self.frame.cpu()
        unit = torch.nn.functional.normalize(turned(directions, frame), dim=-1)
        self._region().note_backdrops(moved(origins, frame), unit)

    def _region(self) -> Region:
        """Where the occupancy lies, with the backdrops that were seen there."""
        occupancy, region = self.the_occupancy(), Region().to(self.frame.device)
        region.space, region.backdrops = occupancy.space, self.backdrops
        region.aabb.copy_(occupancy.walls)
        region.near.zero_()
        region.far.copy_(FARTHEST * occupancy.space.half_extent)
        return region

    @torch.no_grad()
    def lacks_backdrop(self, origins: Tensor, directions: Tensor) -> Tensor:
        """Whether training has never seen the backdrop of rays: bool [R]. Origins and directions
        [R, 3], of any length, are in the occupancy's coordinates."""
        unit = torch.nn.functional.normalize(directions.float(), dim=-1)
        region = self._region()
        return ~region.shows_backdrop(region.cut(origins.float(), unit))

    def estimator(
        self, aabb: Tensor | None, outermost: Tensor | None = None, levels: int = 1
    ) -> nn.Module:
        """What goes where a packed host has its estimator.

        Args:
            aabb: box of that estimator, [6]; None where the host cuts its rays itself.
            outermost: the box in which the host's own samples at all, [6]; None is `aabb`. In an
                unbounded scene, rays whose steps do not grow end there.
            levels: nested boxes of that estimator, each twice as wide as the one before. A sampler
                with an option `levels` has as many, unless its options set it.
        Raises:
            InputError: the sampler has no estimator, or not all of its options.
        """
        if self._spec("estimator").needs_occupancy:
            return GuidedEstimator(self, aabb, aabb if outermost is None else outermost)

        def build(name: str, **options: Any) -> nn.Module:
            boxes = {"levels": levels} if has_option(name, "estimator", "levels") else {}
            return build_estimator(name, **boxes | options)

        return self.built(build, aabb=aabb, occupancy=None)

    def built(self, build: Callable[..., nn.Module], **given: Any) -> nn.Module:
        """The sampler that the registry builds of what this host gives, with its options.
        InputError if it cannot be built so."""
        # cells would be made anew for each threshold that the viewer shows
        without_cells = SHOWN.get() is not None and self.sampler in OURS
        uncached = {"cache_bytes": 0} if without_cells else {}
        try:
            return build(self.sampler, **{**given, **self.options, **uncached})
        except (ValueError, TypeError, OverflowError, RuntimeError) as error:
            options = f" (its options: {self.options})" if self.options else ""
            why = one_line(error) or type(error).__name__
            raise InputError(
                f"the sampler {self.sampler!r} cannot be built: {why}{options}"
            ) from error

    def proposal(self, **options: Any) -> Sampler:
        """What goes where a proposal host has its sampler; options as for the registry.

        Raises:
            InputError: the sampler has nothing for proposal hosts, or not all of its options.
        """
        spec, made = self._spec("proposal"), GuidedProposal(self, options)
        if not spec.needs_occupancy:
            _ = made.sampler  # what is wrong with its options is said now
        return made

    def get_extra_state(self) -> dict[str, Any]:
        """What a checkpoint must say before the gate's weights can be read."""
        if self.occupancy is None:
            return {}
        return {
            "gate": self.occupancy.gate.config.to_dict(),
            "precision": self.occupancy.precision,
            "report": self.occupancy.report,
            "watched": dict(vars(self.watched)),
            "first_density": self.first_density,
        }

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Makes an occupancy of the checkpoint's shape; torch then reads its weights. InputError if
        the state is of another version of this package."""
        if state == {}:
            return
        with state_of_this_version():
            require_keys(state, STATE)
            watched = WatchState.from_dict(state["watched"])
            config = GateConfig.from_dict(state["gate"])
        self.watched, self.first_density = watched, state["first_density"]
        self.set_occupancy(
            Occupancy(Gate(config), Space(), 0.0, state["precision"], state["report"])
        )
