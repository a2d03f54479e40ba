"""Learning, freezing and guided training on the procedural city, against a dense host.

The fields, losses and calibration of `leco-occupancy-paper` without nerfstudio's trainer; while it
learns, every ray shades all of its candidates, and no experts are merged. The dense host is the
same mixture without an empty-space expert, as in Switch-NeRF: every candidate goes through a scene
expert, and nothing is ever skipped.
"""

from __future__ import annotations

import gc
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from gpu_city import Photographed, Pixels, take_photographs
from gpu_floor import seconds
from gpu_sampling import march_answers
from gpu_scale import Scale, figure
from torch import Tensor

from leco_plugin.evaluation.clock import peak_process_bytes
from leco_plugin.learning.calibration import CalibrationConfig, Measured, calibrate
from leco_plugin.learning.dense import DenseRendering, Reference, reference_of
from leco_plugin.learning.schedule import ScheduleConfig, ramp
from leco_plugin.models.field import HMoEField
from leco_plugin.models.gate import Gate
from leco_plugin.models.objective import GateLossConfig, field_losses, gate_losses
from leco_plugin.models.rendering import (
    Intervals,
    Rays,
    Routing,
    Scene,
    Shaded,
    shade,
    with_backdrop,
)
from leco_plugin.occupancy import Occupancy, gate_precision
from leco_plugin.samplers import marching
from leco_plugin.samplers.boxes import intersect_box
from leco_plugin.samplers.estimator import LearnedOccupancyEstimator
from leco_plugin.samplers.kernels import fused
from leco_plugin.space import Space


class Weights(NamedTuple):
    """Of the field's losses in `leco-occupancy-paper`, whose configuration needs nerfstudio."""

    distortion: float = 0.05
    distortion_after: float = 0.04
    termination: float = 0.03
    nearness: float = 0.03
    transparency: float = 1.0
    ground: float = 0.1


RATE = 5e-4
"""Learning rate of `leco-occupancy-paper`."""
RAYS_AT_ONCE, STEPS_PER_LOOK = 1024, 10
"""Rays rendered at a time, and steps between two looks at the clock, each of which waits."""


class Run:
    """One field and its gate on one city."""

    def __init__(self, scene: Photographed, scale: Scale, homogeneous: bool) -> None:
        torch.manual_seed(0)
        self.scene, self.scale, self.device = scene, scale, scale.device
        sizes, low, high = scale.sizes, *scene.box.view(2, 3)
        half_extent = float((high - low).max()) / 2.0
        self.space = Space("box", tuple(((low + high) / 2.0).tolist()), half_extent)
        self.space.to(self.device)
        self.gate = Gate(sizes.gate).to(self.device)
        self.field = HMoEField(sizes.field, scene.num_images).to(self.device)
        ends = torch.tensor([0.0, 2.0 * half_extent], device=self.device)
        self.span = ends[0], ends[1]
        self.losses = GateLossConfig()
        self.routing = Routing(None if homogeneous else self.losses.empty_below, homogeneous)
        parameters = [*self.gate.parameters(), *self.field.parameters()]
        self.optimizer = torch.optim.Adam(parameters, RATE, eps=1e-15, fused=True)
        self.estimator: LearnedOccupancyEstimator | None = None
        self.learning, self.ramped = True, 0.0
        self.steps = 0

    def rays_of(self, pixels: Pixels) -> Rays:
        """Rays of pixels, cut to the box of the city."""
        enters, leaves = intersect_box(pixels.origins, pixels.directions, self.scene.box)
        enters = enters.clamp(min=0.0)
        return Rays(pixels.origins, pixels.directions, enters, leaves.maximum(enters), None)

    def intervals_of(self, rays: Rays, candidates: int, jittered: bool) -> Intervals:
        """Candidates along rays; once guided, those that the occupancy keeps."""
        along, rule = marching.Rays(*rays[:4]), marching.March(self.scene.length / candidates)
        if jittered:
            along = along.shifted(torch.rand_like(rays.t_mins) * rule.step_size)
        guided = self.estimator is not None
        samples = self.estimator.march(along, rule) if guided else marching.march(along, rule)
        return with_backdrop(Intervals(*samples), rays, *rule)

    def shaded(self, rays: Rays, intervals: Intervals) -> Shaded:
        """Renders intervals in bfloat16."""
        frozen = self.estimator is not None
        with gate_precision(self.device.type, "bfloat16"):
            whole = Scene(self.field, self.gate, self.space, self.routing)
            return shade(whole, rays, intervals, frozen)

    def step(self, candidates: int) -> None:
        """One training step on random pixels."""
        pixels = self.scene.train
        chosen = torch.randint(len(pixels.images), (self.scale.batch,), device=self.device)
        pixels = pixels.some(chosen)
        rays = self.rays_of(pixels)._replace(images=pixels.images)
        intervals = self.intervals_of(rays, candidates, jittered=True)
        shaded = self.shaded(rays, intervals)
        losses = field_losses(
            Weights(),
            shaded,
            intervals,
            rays,
            pixels.colors,
            None,
            None,
            grounded=torch.zeros_like(rays.t_mins, dtype=torch.bool),  # a void is below
            span=self.span,
            unbounded=self.space.unbounded,
            learning=self.learning,
            ramped=self.ramped,
        )
        if self.estimator is None:
            losses |= gate_losses(
                self.losses,
                shaded,
                intervals,
                rays,
                self.space.half_extent,
                self.routing.homogeneous,
                ramped=self.ramped,
            )
        loss = torch.stack(list(losses.values())).sum()
        self.optimizer.zero_grad()
        loss.backward()
        self.optimizer.step()
        self.steps += 1

    def train(self, duration: float, candidates: int) -> float:
        """Steps for so many seconds; the seconds it took."""
        started, passed = time.perf_counter(), 0.0
        while passed < duration:
            if self.learning:  # the distortion loss comes in with time, as in `phases.ramp`
                self.ramped = ramp(int(1000 * passed / duration), ScheduleConfig(learn_steps=1000))
            for _ in range(STEPS_PER_LOOK):
                self.step(candidates)
            wait(self.device)
            passed = time.perf_counter() - started
        return passed

    def end_learning(self) -> None:
        """Detail is wanted from now on: little is left of the distortion loss."""
        self.learning, self.ramped = False, 1.0

    @torch.no_grad()
    def freeze(self) -> Measured:
        """Finds the threshold on pixels that are never trained on; from now on it guides."""
        pixels = self.scene.calibration
        chunks = [
            Pixels(*parts)
            for parts in zip(
                *(part[: self.scale.calibration].split(RAYS_AT_ONCE) for part in pixels)
            )
        ]
        rays = [self.rays_of(chunk) for chunk in chunks]
        references = [self.reference(of_chunk) for of_chunk in rays]

        def render_kept(number: int, mask: Tensor) -> Tensor:
            kept = Intervals(*(part[mask] for part in references[number].intervals))
            return self.shaded(rays[number], kept).rgb

        truths = [chunk.colors for chunk in chunks]
        rendering = DenseRendering(references, truths, render_kept)
        measured = calibrate(rendering, CalibrationConfig())
        self.end_learning()
        self.gate.requires_grad_(False)
        box = self.scene.box
        occupancy = Occupancy(self.gate, self.space, measured.threshold, "bfloat16", walls=box)
        self.estimator = LearnedOccupancyEstimator(
            occupancy.to(self.device),
            box,
            cache_bytes=self.scale.cache_bytes,
            tolerance=self.scale.tolerance,
        )
        return measured

    def reference(self, rays: Rays) -> Reference:
        """All candidates of rays, rendered."""
        intervals = self.intervals_of(rays, self.scale.sizes.candidates, jittered=False)
        shaded = self.shaded(rays, intervals)
        return reference_of(shaded, intervals, rays)

    @torch.no_grad()
    def psnr(self) -> float:
        """Of pixels of held-out pictures, dB."""
        pixels, generator = self.scene.test, torch.Generator().manual_seed(0)
        order = torch.randperm(len(pixels.images), generator=generator)[: self.scale.test]
        errors = []
        for chosen in order.to(self.device).split(RAYS_AT_ONCE):
            some = pixels.some(chosen)
            rays = self.rays_of(some)
            intervals = self.intervals_of(rays, self.scale.sizes.candidates, jittered=False)
            errors.append((self.shaded(rays, intervals).rgb - some.colors).square())
        return float(-10.0 * torch.cat(errors).mean().log10())


def train_guided(scale: Scale, before: dict[str, Any]) -> dict[str, Any]:
    """Learns the occupancy, freezes it, and goes on guided by it."""
    scene = take_photographs(scale.city, scale.capture, scale.device)
    run, sizes = Run(scene, scale, homogeneous=False), scale.sizes
    started = time.perf_counter()
    run.train(scale.learning, sizes.learn_candidates)
    learn_steps, learn_step = run.steps, timed(run, sizes.learn_candidates)
    learning = time.perf_counter() - started  # steps that are timed teach, too
    started = time.perf_counter()
    measured = run.freeze()
    wait(scale.device)
    freezing = time.perf_counter() - started
    guided = run.train(scale.guided, sizes.candidates)
    psnr, step = run.psnr(), timed(run, sizes.candidates)
    assert run.estimator is not None
    place = torch.zeros(1, 3, device=scale.device)
    running = {
        "gate": fused.decide(run.estimator.occupancy, place) is not None,
        "march": march_answers(run.estimator),
    }
    return {
        "seconds": {"learning": learning, "freezing": freezing, "guided": guided},
        "steps": {"learning": learn_steps, "all": run.steps},
        "learning_step": learn_step,
        "guided_step": step,
        "occupancy": measured._asdict(),
        "psnr": psnr,
        "running": running,
    }


def train_dense(scale: Scale, before: dict[str, Any]) -> dict[str, Any]:
    """The dense host for as long as the guided run took, learning included, beside that run."""
    guided = before["learned"]
    if "guided_step" not in guided:
        return {"left_out": "there is no guided run to compare with"}
    scene = take_photographs(scale.city, scale.capture, scale.device)
    run = Run(scene, scale, homogeneous=True)
    first = guided["seconds"]["learning"]
    took = run.train(first, scale.sizes.candidates)
    run.end_learning()  # its losses change when those of the guided run did
    took += run.train(sum(guided["seconds"].values()) - first, scale.sizes.candidates)
    psnr, steps = run.psnr(), run.steps
    step = timed(run, scale.sizes.candidates)
    ours = guided["guided_step"]
    times = {"dense": step["seconds"], "guided": ours["seconds"]}
    figures = [
        figure(
            "steps per second: guided / dense",
            times["dense"] / times["guided"],
            2.5,
            False,
            **times,
        ),
        figure("peak memory: guided / dense", ours["peak_bytes"] / step["peak_bytes"], 0.5, True),
        figure("PSNR at equal time: guided - dense, dB", guided["psnr"] - psnr, 0.0, False),
    ]
    return {"seconds": took, "steps": steps, "step": step, "psnr": psnr, "figures": figures}


def timed(run: Run, candidates: int) -> dict[str, float]:
    """A step's median seconds and steps per second, and the most memory that it took."""
    memory = peak_of(run.device)
    took = seconds(lambda: run.step(candidates), run.device, max(2, run.scale.rounds // 3))
    return {"seconds": took, "steps_per_second": 1.0 / took, "peak_bytes": memory()}


def peak_of(device: torch.device) -> Callable[[], int]:
    """Answers with the most bytes that tensors have held since; on a CPU the whole process ever."""
    gc.collect()  # a run that is over holds nothing
    if device.type != "cuda":
        return peak_process_bytes
    torch.cuda.reset_peak_memory_stats()  # CUDA only
    return torch.cuda.max_memory_allocated  # CUDA only


def wait(device: torch.device) -> None:
    """Until the device has done everything."""
    if device.type == "cuda":
        torch.cuda.synchronize()  # CUDA only
