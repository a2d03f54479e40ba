"""A host that teaches its own gate while it trains, in place of an HMoE that learns before it.

It begins within the scene's bounds, where it keeps whatever a training ray can reach. From time to
time its own rendering weights teach a small gate, as a frozen field does in `learning.sharpening`.
The gate is calibrated on held-out rays, and guides from then on if it skips more. The bounds hold
what all gates of a run cost together. Weights are read at the seam of packed hosts, which ask for
densities while they train.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from functools import cached_property
from itertools import accumulate
from typing import Any, NamedTuple

import torch
from torch import Tensor

from leco_plugin.evaluation.clock import seconds_now
from leco_plugin.hosts.guide import Guide
from leco_plugin.hosts.host_watch import end_probation, squared_errors
from leco_plugin.hosts.stand_ins import DEFAULTS, is_packed
from leco_plugin.learning.calibration import (
    ERRORS,
    LOSSES,
    THRESHOLDS,
    CalibrationConfig,
    Measured,
    image_price,
    measure,
)
from leco_plugin.learning.dense import DenseRendering, Reference, evaluating, near_surface
from leco_plugin.learning.freezing import leave_file
from leco_plugin.learning.run import Run
from leco_plugin.learning.sharpening import SharpeningConfig, lesson_from_weights, teach
from leco_plugin.log import note, say
from leco_plugin.models.compute.device import fast_precision
from leco_plugin.models.gate import Gate
from leco_plugin.models.leco_config import LecoModelConfig
from leco_plugin.models.region import Region
from leco_plugin.models.rendering import Intervals
from leco_plugin.occupancy import CALIBRATED_AT, CAMERAS_THAT_VOUCH, TESTS_LOSE, Occupancy
from leco_plugin.samplers.base import midpoints, prune
from leco_plugin.samplers.estimator import LearnedOccupancyEstimator
from leco_plugin.samplers.packed import accumulate_along_rays, pack_info, render_weight_from_density
from leco_plugin.scenes.input_error import InputError
from leco_plugin.scenes.learning_data import LearningData, held_out_bundle, training_bundles

OPEN = 1e-4
"""Threshold of bounds alone, below all that calibration tries."""
FIRST = 250
"""Steps of a host before it teaches for the first time."""
SHARE_OF_TIME = 0.1
"""Of training, about the most that teaching takes after that."""
HELD_OUT_RAYS = 2048
"""Rays on which a gate is calibrated; each threshold that is tried renders them."""
NO_ERROR = 1e-12
"""Summed squared error of rays that is as good as none."""
BOUNDED = ("lost_surface_mass", "image_price_db")
"""What calibration bounds, by its names in a config and in a report."""
OF_A_GATE = (CALIBRATED_AT, CAMERAS_THAT_VOUCH, TESTS_LOSE)
"""What a report says of one gate alone, and not of the next."""
LOWER = 3
"""Steps of `THRESHOLDS` from one that costs too much to the next that is tried."""

INSTEAD = "leave --pipeline.model.occupancy.learned at first"
NO_DENSITIES = f"this host asks for no densities along rays to teach with: {INSTEAD}"


def open_occupancy(data: LearningData, config: SharpeningConfig) -> Occupancy:
    """Bounds alone: walls, and the space that training rays cross, in which nothing is skipped."""
    region = Region()
    region.set(data.survey.bounds)
    data.note_views(region)
    report = {"aabb": region.aabb.tolist(), "empty_fraction": 0.0, **data.facts()}
    report |= {"near": float(region.near), "far": float(region.far)}
    report |= dict.fromkeys((*LOSSES, *ERRORS), 0.0)
    precision, walls = fast_precision(region.aabb.device), region.aabb
    made = Occupancy(Gate(config.gate), region.space, OPEN, precision, report, walls, region.seen)
    return bounds_of(made.eval())


def bounds_of(occupancy: Occupancy) -> Occupancy:
    """The bounds of an occupancy, within which nothing is skipped."""
    gate = Gate(occupancy.gate.config)
    for parameter in gate.parameters():
        parameter.data.zero_()  # o(x) is one half everywhere, of which cells are sure
    return occupancy.with_gate(gate, OPEN, occupancy.report)


class Heard(NamedTuple):
    """What a host's field says along some rays."""

    mapped: Tensor
    """[M, 3] middles of all candidates within the bounds, in [-1, 1]."""
    intervals: Intervals
    weights: Tensor
    """[M] rendering weights; 0 where the present occupancy skips."""
    kept: Tensor
    """[M] bool, by that."""
    rays: int

    def reference(self, occupancies: Tensor) -> Reference:
        """As `measure` takes it, without an image."""
        nothing = torch.zeros_like(self.kept)
        of_ray = self.intervals.ray_indices
        accumulation = accumulate_along_rays(self.weights, None, of_ray, self.rays)[:, 0]
        packed_info = pack_info(of_ray, self.rays)
        near = near_surface(self.weights, accumulation, packed_info, self.intervals, nothing)
        rgb = self.weights.new_zeros(self.rays, 3)
        return Reference(self.intervals, self.weights, occupancies, near, rgb, nothing)


class Along:
    """Stands around the steps of a packed host that teaches its own gate, as its config says, whose
    field is not built. InputError if the host draws a fixed number of samples, several processes
    train it, or sharpening is off."""

    def __init__(
        self, host: Any, guide: Guide, config: LecoModelConfig, pipeline: Any, run: Run
    ) -> None:
        if not is_packed(host):
            raise InputError(NO_DENSITIES)
        if config.sharpening.steps == 0:
            raise InputError(f"with sharpening.steps 0 a host teaches its gate nothing: {INSTEAD}")
        if getattr(pipeline, "world_size", 1) > 1:
            raise InputError(f"a host that teaches its own gate trains in one process: {INSTEAD}")
        self.host, self.guide, self.config, self.run = host, guide, config, run
        self.manager = pipeline.datamanager
        self.steps, self.began, self.spent = 0, seconds_now(), 0.0
        self.march: dict[str, float] = {}

    def begin(self) -> None:
        """Guides the host by bounds alone, where it has no occupancy yet; where it has taught one,
        as in a run that goes on, the next is due once that has been its share of the time."""
        given = self.guide.occupancy
        if given is not None and given.report.get("learned") == "along":
            self.steps, self.spent = FIRST, float(given.report["train_seconds"])
        elif given is None:
            config = self.config
            data = LearningData(self.manager, config.bounds, config.near, config.far)
            self.guide.set_occupancy(open_occupancy(data, config.sharpening))
            say("the host begins within the scene's bounds and teaches its gate while it trains")

    def after_step(self, step: int) -> None:
        """Teaches where that is due: first after `FIRST` steps, then as often as `SHARE_OF_TIME`
        allows, and at the end of a run."""
        self.steps += 1
        last = step + 1 >= self.run.end
        passed = seconds_now() - self.began
        due = self.steps == FIRST if self.spent == 0.0 else self.spent < SHARE_OF_TIME * passed
        if due or (last and self.steps > FIRST):
            started = seconds_now()
            self._teach(step)
            self.spent += seconds_now() - started

    def _teach(self, step: int) -> None:
        """Teaches and calibrates a gate; follows it where it skips more."""
        end_probation(self.guide)  # else each threshold is tried at the lower one of the beginning
        config, before, started = self.config, self.guide.the_occupancy(), seconds_now()
        device = self.guide.frame.device
        cards = [device] if device.type == "cuda" else []
        with torch.random.fork_rng(cards):  # batches are those of a run that teaches nothing
            torch.default_generator.manual_seed(step)  # `torch.manual_seed` seeds all cards too
            taught = self._hear(training_bundles(self.manager, config.sharpening.rays))
            bundle, truth = held_out_bundle(self.manager, HELD_OUT_RAYS, step, "calibration")
            held_out = self._hear([bundle])
            gate = teach(
                config.sharpening.gate,
                lesson_from_weights(
                    taught.mapped, taught.weights, taught.intervals.ray_indices, config.gate_loss
                ),
                config.sharpening.steps,
                before.precision,
                seed=step,
            )
            allowed = self._allowed(before.report, last=step + 1 >= self.run.end)
            found = self._calibrated(gate, held_out, bundle, truth, allowed)
        seconds = seconds_now() - started
        skipped = 1.0 - float(held_out.kept.float().mean())
        what = f"step {step}: a gate taught by the host in {seconds:.0f} s"
        if found is None or found.empty_fraction <= skipped:
            note(f"{what} skips no more within its bounds than the {skipped:.1%} that are skipped")
            return
        say(f"{what} {found.line_beside(before.report, skipped)}")
        costs = found.on_top_of(before.report)._asdict()
        known = {name: value for name, value in before.report.items() if name not in OF_A_GATE}
        report = {**known, **costs, **self.march, "step": step, "learned": "along"}
        report |= {"params": sum(p.numel() for p in gate.parameters())}
        report |= {"train_seconds": round(self.spent + seconds, 2), "calibration_rays": len(truth)}
        made = before.with_gate(gate, found.threshold, report)
        self.guide.set_occupancy(made)
        self.guide.watched.evidence = {}
        leave_file(made, self.run.folder)

    def _hear(self, bundles: Any) -> Heard:
        """The host's weights along rays, rendered as it renders in training."""
        heard: list[Heard] = []
        with self._listening(heard), torch.no_grad():
            for bundle in bundles:
                self.host(bundle.to(self.host.device))
        mapped, intervals, weights, kept, rays = zip(*heard)
        of_rays, *ends = zip(*intervals)
        firsts = accumulate(rays, initial=0)
        numbered = [numbers + first for numbers, first in zip(of_rays, firsts)]
        together = Intervals(torch.cat(numbered), *(torch.cat(parts) for parts in ends))
        return Heard(torch.cat(mapped), together, torch.cat(weights), torch.cat(kept), sum(rays))

    @cached_property
    def _bounds(self) -> LearnedOccupancyEstimator:
        """Keeps all candidates within the bounds, which stay as they are."""
        bounds = bounds_of(self.guide.the_occupancy())
        return LearnedOccupancyEstimator(bounds).to(self.guide.frame.device)

    @contextmanager
    def _listening(self, heard: list[Heard]) -> Iterator[None]:
        """Meanwhile what the host's field says along rays is noted."""
        guide, occupancy, bounds = self.guide, self.guide.the_occupancy(), self._bounds

        def hear(rays_o: Tensor, rays_d: Tensor, options: dict[str, Any]) -> Any:
            asked = DEFAULTS | options
            self.march = {"step_size": asked["render_step_size"], "cone_angle": asked["cone_angle"]}
            limits = {"early_stop_eps": 0.0, "alpha_thre": 0.0}
            samples = bounds.sampling(rays_o, rays_d, **options | limits)
            one = _heard_of(occupancy, samples, rays_o, rays_d, asked["sigma_fn"])
            heard.append(one)
            of_rays, starts, ends = (part[one.kept] for part in samples)
            names = ("sigma_fn", "alpha_fn", "early_stop_eps", "alpha_thre")
            return prune((of_rays, starts, ends), len(rays_o), *(asked[name] for name in names))

        was_training = self.host.training
        self.host.train()  # only then a host asks for densities
        kept, guide.listener = guide.kept, hear
        try:
            yield
        finally:
            guide.listener, guide.kept = None, kept
            self.host.train(was_training)

    def _allowed(self, report: Mapping[str, Any], last: bool) -> CalibrationConfig:
        """What a gate may cost together with those before it, whose report this is. Half of what
        they have left of the bounds is kept for later gates, which a better field teaches; the last
        gate of a run may spend all."""
        config = self.config.calibration
        bounds: dict[str, Any] = {name: getattr(config, name) for name in BOUNDED}
        for name, bound in bounds.items():
            left = max(0.0, bound - max(0.0, float(report.get(name) or 0.0)))
            bounds[name] = bound if last else bound - 0.5 * left
        return replace(config, **bounds)

    def _calibrated(
        self, gate: Gate, heard: Heard, bundle: Any, truth: Tensor, config: CalibrationConfig
    ) -> Measured | None:
        """The largest threshold within the bounds of a config, together with what gates before it
        have cost, and what it costs; None where none is."""
        before = self.guide.the_occupancy()
        asked = before.with_gate(gate, THRESHOLDS[0], {})
        with torch.no_grad():
            reference = heard.reference(asked.of_mapped(heard.mapped))
        nothing = truth.new_zeros(heard.rays, 3)
        rendering = DenseRendering([reference], [nothing], lambda *_: nothing)
        errors = self._errors(bundle, truth)
        number = 0
        try:
            while number < len(THRESHOLDS):
                threshold = THRESHOLDS[number]
                found = measure(rendering, threshold, with_image=False)
                cheap = found._replace(image_price_db=0.0, price_error_db=0.0)
                if not cheap.on_top_of(before.report).within(config):
                    number += 1
                    continue
                self.guide.set_occupancy(asked.with_threshold(threshold))
                price, error = image_price(self._errors(bundle, truth), errors, NO_ERROR)
                found = found._replace(image_price_db=price, price_error_db=error)
                if found.on_top_of(before.report).within(config):
                    return found
                number += LOWER
        finally:
            self.guide.set_occupancy(before)
        return None

    @torch.no_grad()
    def _errors(self, bundle: Any, truth: Tensor) -> Tensor:
        """Squared error of rendered rays: [R]."""
        device = self.host.device
        with evaluating(self.host):
            return squared_errors(self.host, bundle.to(device), truth.to(device).float())


def _heard_of(
    occupancy: Occupancy, samples: Any, rays_o: Tensor, rays_d: Tensor, density: Any
) -> Heard:
    """What a field says at candidates: it is asked where the occupancy keeps them."""
    if density is None:
        raise InputError(NO_DENSITIES)
    of_rays, starts, ends = samples
    middles = midpoints(samples, rays_o, rays_d)
    kept = occupancy.occupied(middles)
    asked = [part[kept] for part in (starts, ends, of_rays)]
    weights = torch.zeros_like(starts)
    rays = len(rays_o)
    weights[kept] = render_weight_from_density(
        asked[0], asked[1], density(*asked).reshape(-1), ray_indices=asked[2], n_rays=rays
    )[0].to(weights)
    mapped = occupancy.space.map(middles).clamp(-1.0, 1.0)
    return Heard(mapped, Intervals(of_rays, starts, ends), weights, kept, rays)
