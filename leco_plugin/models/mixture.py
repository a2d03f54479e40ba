"""The mixture that learns an occupancy: gate, field and region, and how rays pass through them.

It knows no schedule and no trainer. Beside a checkpoint, only `freeze`, `sharpen` and `reopen`
write whether the gate is frozen, and its threshold.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from leco_plugin.models.field import HMoEField
from leco_plugin.models.front_to_back import is_no_slower, shade_front_to_back
from leco_plugin.models.gate import Gate, GateConfig
from leco_plugin.models.region import Region, marching_rule
from leco_plugin.models.rendering import (
    Answers,
    Intervals,
    Rays,
    Routing,
    Scene,
    Shaded,
    ask,
    ask_at,
    backdrop_of,
    mapped_middles,
    shade,
    weigh,
    with_backdrop,
)
from leco_plugin.models.sizing.sizes import SIZES, Sizes, check, from_stored, to_store
from leco_plugin.occupancy import SHOWN, Occupancy, Precision, gate_precision
from leco_plugin.on_cpu import on_cpu
from leco_plugin.samplers import marching
from leco_plugin.samplers.estimator import LearnedOccupancyEstimator
from leco_plugin.scenes.bounds import SceneBounds
from leco_plugin.scenes.input_error import require_keys, state_of_this_version


class Following(NamedTuple):
    """How candidates are left out while the gate is learned."""

    above: float
    """o(x) from which a candidate is shaded."""
    everywhere: float
    """Share of rays that shade all their candidates."""


class Mixture(nn.Module):
    """Gate, field and region.

    Args:
        sizes: of gate, field and marches.
        num_images: training images, each with an appearance code.
        places: [num_images, 3] where they were taken, if that is known.
        precision: of matrix products; the gate decides otherwise in another one than it was
            taught in, so that a checkpoint restores it.
        routing: which expert each point is sent to.

    Attributes:
        frozen: scalar bool, whether the gate is frozen.
        threshold: scalar, o(x) from which a frozen gate keeps a candidate; at 0 all are kept.
        report: what the frozen gate costs and saves, as its file has it.
        small: a gate that says in place of the frozen one what is empty; None where there is none.
        steps, cones: [2] shortest steps, scene units, and their growth with distance, of the fine
            march and of the coarse one.
    """

    frozen: Tensor
    threshold: Tensor
    steps: Tensor
    cones: Tensor

    def __init__(
        self,
        sizes: Sizes,
        num_images: int,
        precision: Precision,
        routing: Routing,
        places: Tensor | None = None,
    ) -> None:
        super().__init__()
        self.places = torch.empty(0, 3) if places is None else places
        self.precision, self.routing = precision, routing
        self._build(sizes, num_images)
        self.region = Region()
        self.register_buffer("frozen", torch.tensor(False))
        self.register_buffer("threshold", torch.tensor(0.0))
        self.register_buffer("steps", torch.tensor([0.03, 0.06]))
        self.register_buffer("cones", torch.tensor([0.0, 0.0]))
        self.report: dict[str, Any] = {}
        self.small: Gate | None = None
        # in a tuple: the estimator shares the gate, which must not be registered twice
        self._estimator: tuple[LearnedOccupancyEstimator, ...] = ()

    def _build(self, sizes: Sizes, num_images: int) -> None:
        check(sizes)
        self.sizes, self.num_images = sizes, num_images
        self.gate = Gate(sizes.gate)
        self.field = HMoEField(sizes.field, num_images)
        self.field.color.places = self.places

    @property
    def device(self) -> torch.device:
        """Where its weights are."""
        return self.frozen.device

    @property
    def is_frozen(self) -> bool:
        """`frozen`, asked without waiting for the device."""
        return bool(on_cpu(self.frozen))

    @property
    def skips(self) -> bool:
        """Whether a frozen gate leaves out any candidate."""
        shown = SHOWN.get()
        return self.is_frozen and float(on_cpu(self.threshold) if shown is None else shown) > 0.0

    @torch.no_grad()
    def occupancies(self, mapped: Tensor, gate: Gate | None = None) -> Tensor:
        """o(x) by the gate that skips, or by another one: mapped positions [M, 3] in [-1, 1] to
        [M]."""
        with gate_precision(self.device.type, self.precision):
            return (gate or self.small or self.gate).occupancy(mapped)

    def set_bounds(self, bounds: SceneBounds, median_length: float) -> None:
        """Fixes the region and the marches; see `marching_rule`."""
        self.region.set(bounds)
        for number, candidates in enumerate((self.sizes.candidates, self.sizes.learn_candidates)):
            rule = marching_rule(bounds.kind, bounds.near, bounds.far, candidates, median_length)
            self.steps[number], self.cones[number] = rule

    def rule(self, coarse: bool = False) -> marching.March:
        """By which candidates follow one another: finely in renderings, coarsely while learning."""
        step, cone = (float(on_cpu(each)[int(coarse)]) for each in (self.steps, self.cones))
        return marching.March(step, cone)

    def rays(self, origins: Tensor, directions: Tensor, images: Tensor | None) -> Rays:
        """Rays cut to the region; see `Region.rays`."""
        return self.region.rays(origins, directions, images, self.steps.min())

    def candidates(
        self, rays: Rays, coarse: bool = False, jitter: Tensor | None = None
    ) -> Intervals:
        """Candidates along rays, without backdrops.

        Args:
            coarse: whether to take the march of learning.
            jitter: [R] in [0, 1), by which share of a step each ray's march is shifted.
        """
        return Intervals(*marching.march(*self._along(rays, coarse, jitter)))

    def kept(self, rays: Rays, coarse: bool = False, jitter: Tensor | None = None) -> Intervals:
        """Those candidates that the frozen gate keeps; all where it skips nothing."""
        if not self.skips:
            return self.candidates(rays, coarse, jitter)
        return Intervals(*self.estimator().march(*self._along(rays, coarse, jitter)))

    def _along(
        self, rays: Rays, coarse: bool, jitter: Tensor | None
    ) -> tuple[marching.Rays, marching.March]:
        along, rule = marching.Rays(*rays[:4]), self.rule(coarse)
        return along if jitter is None else along.shifted(jitter * rule.step_size), rule

    @torch.no_grad()
    def follow(self, rays: Rays, intervals: Intervals, following: Following) -> Intervals:
        """Leaves out what the gate, as far as it has learned, calls empty; some rays keep all."""
        mapped = mapped_middles(self.region.space, rays, intervals)
        likely = self.occupancies(mapped, self.gate) >= following.above
        dense = torch.rand_like(rays.t_mins) < following.everywhere
        shaded = (likely | dense.index_select(0, intervals.ray_indices)).nonzero()[:, 0]
        return Intervals(*(part.index_select(0, shaded) for part in intervals))

    def seen(self, rays: Rays, intervals: Intervals) -> Intervals:
        """Leaves out what lies in space that no training ray crosses."""
        mapped = mapped_middles(self.region.space, rays, intervals)
        chosen = self.region.seen(mapped).nonzero()[:, 0]
        return Intervals(*(part.index_select(0, chosen) for part in intervals))

    def with_backdrops(self, rays: Rays, intervals: Intervals, coarse: bool = False) -> Intervals:
        """Ends each ray in its backdrop, which no gate skips."""
        return with_backdrop(intervals, rays, *self.rule(coarse))

    def shade(self, rays: Rays, intervals: Intervals, kept: bool = False) -> Shaded:
        """Renders intervals; no gradient reaches a frozen gate. `kept` is as of `scene`."""
        with gate_precision(self.device.type, self.precision):
            return shade(self.scene(kept), rays, intervals, freeze_gate=self.is_frozen)

    @torch.no_grad()
    def weigh(self, rays: Rays, intervals: Intervals) -> Tensor:
        """The rendering weights [M] of intervals, whose colours nobody wants."""
        with gate_precision(self.device.type, self.precision):
            sigmas = ask(self.scene(), rays, intervals, freeze_gate=True).sigmas
        backdrops, half_extent = backdrop_of(intervals, rays), self.region.space.half_extent
        return weigh(sigmas, backdrops, intervals, half_extent, len(rays.origins))[0]

    @torch.no_grad()
    def answers(self, mapped: Tensor) -> Answers:
        """What gate and field say at mapped positions [M, 3] in [-1, 1]."""
        with gate_precision(self.device.type, self.precision):
            return ask_at(self.scene(), mapped, freeze_gate=True)

    def scene(self, kept: bool = False) -> Scene:
        """Whom renderings ask, and how. Where a gate skips and there is one scene expert, that
        expert has all that is kept, and the gate that skips says of the rest what is empty.

        Args:
            kept: whether only backdrops, and what `kept` returns, is asked about.
        """
        gate, routing = self.gate, self.routing
        by_threshold = routing.empty_below is not None and not routing.homogeneous
        alone = self.skips and by_threshold and self.sizes.gate.scene_experts == 1
        if alone and not kept:
            gate = self.small or gate
            below = min(float(on_cpu(self.threshold)), routing.empty_below or 0.0)
            routing = routing._replace(empty_below=below)
        return Scene(self.field, gate, self.region.space, routing, alone and kept)

    def show(
        self, rays: Rays, intervals: Intervals, front_to_back: bool | None
    ) -> tuple[Shaded, Intervals]:
        """As `shade`, of backdrops and what `kept` returns, with the intervals that were shaded.

        Args:
            front_to_back: whether to leave out what lies behind opaque surfaces, without gradients;
                None does so where that was measured to be no slower.
        """
        given = self.scene(kept=True), rays, intervals
        with gate_precision(self.device.type, self.precision):
            if front_to_back is None:
                front_to_back = is_no_slower(*given, self.skips)
            if front_to_back:
                return shade_front_to_back(*given)
        return self.shade(rays, intervals, kept=True), intervals

    @torch.no_grad()
    def freeze(self, threshold: float, report: dict[str, Any]) -> None:
        """Freezes the gate, or gives a frozen one another threshold; 0 keeps all candidates. The
        report says what that costs and saves."""
        self.threshold.fill_(threshold)
        self.frozen.fill_(True)
        self.gate.requires_grad_(False)
        self.gate.zero_grad()  # gradients that are still being gathered would move it once more
        self.report = report
        self._estimator = ()

    def sharpen(self, small: Gate, threshold: float, report: dict[str, Any]) -> None:
        """Has a small gate say from now on what is empty, with a threshold and report of its own;
        the frozen one goes on routing."""
        self.small = small.requires_grad_(False)
        self.freeze(threshold, report)

    @torch.no_grad()
    def reopen(self) -> None:
        """Has a frozen gate learn again; a small one leaves."""
        self.small = None
        self.threshold.fill_(0.0)
        self.frozen.fill_(False)
        self.gate.requires_grad_(True)
        self.report = {}
        self._estimator = ()

    def restart_field(self) -> None:
        """Gives the field the weights of a new one; dropped scene experts stay dropped."""
        fresh = HMoEField(self.field.config, self.num_images)
        for number, remains in enumerate(self.field.experts.left.tolist(), 1):
            if not remains:
                fresh.experts.drop(number)
        self.field.load_state_dict(fresh.state_dict())

    def restart_gate(self) -> None:
        """Gives the gate the weights of a new one."""
        self.gate.load_state_dict(Gate(self.gate.config).state_dict())

    def occupancy(self) -> Occupancy:
        """The gate that skips as an `Occupancy`; it shares the gate's parameters."""
        gate, region, said = self.small or self.gate, self.region, (self.precision, self.report)
        given = region.space, float(self.threshold), *said, region.aabb, region.seen
        return Occupancy(gate, *given).to(self.device)

    def estimator(self) -> LearnedOccupancyEstimator:
        """Samples where the frozen gate says so; built on first use, also after a checkpoint.

        No property: nerfstudio's viewer reads all that it finds, before the first step.
        """
        shown = SHOWN.get()
        if shown is not None:  # cells would be made anew for each threshold
            return LearnedOccupancyEstimator(self.occupancy().with_threshold(shown), cache_bytes=0)
        if not self._estimator:
            self._estimator = (LearnedOccupancyEstimator(self.occupancy()).to(self.device),)
        return self._estimator[0]

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """`encoding` (tables of both, if any), and what else there is in `field` and `gate`."""
        tables = [*self.field.encoding.parameters(), *self.gate.encoding.parameters()]
        known = {id(parameter) for parameter in tables}
        groups = {
            name: [p for p in module.parameters() if id(p) not in known]
            for name, module in (("field", self.field), ("gate", self.gate))
        }
        return groups | {"encoding": tables}

    def get_extra_state(self) -> dict[str, Any]:
        """What travels with a checkpoint beside tensors, as plain values."""
        return {
            SIZES: to_store(self.sizes, self.num_images),
            "precision": self.precision,
            "routing": self.routing._asdict(),
            "report": self.report,
            "small": None if self.small is None else self.small.config.to_dict(),
        }

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *rest: Any) -> None:
        """Gate and field are first built as they were stored, whatever the scene is now.
        InputError if the state is of another release."""
        extra = state_dict.get(f"{prefix}_extra_state")
        if extra is not None:
            with state_of_this_version():
                sizes, small = extra[SIZES], extra["small"]
                gate = None if small is None else Gate(GateConfig.from_dict(small))
            stored = from_stored(sizes, self.sizes)
            if stored != (self.sizes, self.num_images):
                device = self.device
                self._build(*stored)
                self.to(device)
            self.small = None if gate is None else gate.to(self.device)
        super()._load_from_state_dict(state_dict, prefix, *rest)

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Restores what `get_extra_state` gave. InputError if it is of another version."""
        with state_of_this_version():
            require_keys(state, (SIZES, "precision", "routing", "report", "small"))
            self.precision, self.report = state["precision"], dict(state["report"])
            self.routing = Routing(**state["routing"])
        self.gate.requires_grad_(not self.is_frozen)
        if self.small is not None:
            self.small.requires_grad_(False)
        self._estimator = ()
