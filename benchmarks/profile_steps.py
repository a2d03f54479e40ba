"""Where the time of a step goes: `python benchmarks/profile_steps.py --data SCENE --methods ...`.

Each method trains once on a scene. Profiled are some steps while it learns its occupancy, some once
that guides it, and the rendering of one test view. Hosts learn an occupancy first, or take that of
`--occupancy`, and are profiled once it guides them. `profile_parts.py` says which part an operation
belongs to, `profile_floors.py` what each part must cost at least. A step is nerfstudio's
`train_iteration`; looks at the gate between steps are left out. Stored in `results/profile.json`,
by scene and method.
"""

from __future__ import annotations

import os
import statistics
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import checkout  # noqa: F401
import profile_floors as floors
import torch
import tyro
from gpu_floor import Ceilings, measure_ceilings
from nerfstudio.fields.base_field import Field
from nerfstudio.model_components.ray_samplers import Sampler
from page_parts import RESULTS
from profile_parts import REST, Parts, Times, Work, profiler, split

from leco_plugin.chart.contender import LEARNED, Contender, config_of
from leco_plugin.evaluation.clock import Budget, synchronize
from leco_plugin.evaluation.report import (
    describe_code,
    describe_machine,
    made_by,
    read_object,
)
from leco_plugin.evaluation.timed_run import RAYS_AT_ONCE, set_up
from leco_plugin.learning.schedule import steps_in
from leco_plugin.models import front_to_back, rendering
from leco_plugin.models.compute.device import fast_precision
from leco_plugin.models.gate import Gate
from leco_plugin.models.leco import LecoModel
from leco_plugin.occupancy import Occupancy
from leco_plugin.scenes.whole_files import write_json
from leco_plugin.studio.host_models import run_training

COPIED, SIDE = 1 << 26, 2048
"""float32 that are copied, and side of the matrices that are multiplied, to measure the machine."""


@dataclass
class Options:
    """Settings of the benchmark."""

    data: Path
    """The scene."""
    methods: tuple[str, ...] = ("leco-occupancy",)
    """Names as `ns-train` knows them: leco-occupancy, and hosts."""
    occupancy: Path | None = None
    """An occupancy of the scene that guides hosts; None learns it first."""
    learn_steps: int | None = None
    """Steps of learning; None is as many as the method has."""
    steps: int = 20
    """Steps of each phase that are profiled."""
    settle: int = 20
    """Guided steps before those, at least one."""
    seed: int = 0
    """Of the run."""
    out: Path = RESULTS / "profile.json"
    """Where the figures go; those of other scenes and methods stay."""


def name_parts(parts: Parts, trainer: Any) -> None:
    """Names what every method has, and then what its model has."""
    model, optimizers = trainer.pipeline.model, trainer.optimizers
    parts.name(trainer, "train_iteration", REST)
    parts.name(model, "get_outputs_for_camera", REST)
    parts.name(model, "forward", REST, floors.of_rays)
    parts.name(trainer.pipeline.datamanager, "next_train", "data", floors.of_data)
    parts.name(model, "get_loss_dict", "loss", floors.of_loss)
    parts.name(model, "get_metrics_dict", "loss")
    adam = floors.of_adam(optimizers)
    parts.name(optimizers, "optimizer_scaler_step_some", "optimizer", adam)
    for name in ("zero_grad_some", "scheduler_step_all"):
        parts.name(optimizers, name, "optimizer")
    if isinstance(model, LecoModel):
        name_mixture(parts, model)
    else:
        name_host(parts, model)


def name_mixture(parts: Parts, model: LecoModel) -> None:
    """Names the parts of `leco-occupancy`."""
    field = model.mixture.field
    parts.name(model, "rays_of", "candidates")
    parts.name(model, "intervals_of", "candidates", floors.of_samples)
    parts.name_everywhere(rendering.mapped_middles, "candidates")
    parts.name_everywhere(rendering.gate_values_and_routes, "gate")
    parts.name(field, "density", "experts", floors.of_experts(field))
    parts.name(field.encoding, "forward", "encoding", floors.of_encoding(field.encoding))
    parts.name(field.color, "forward", "colour", floors.of_colour(field.color))
    parts.name_everywhere(rendering.weigh, "weights", floors.of_weights)
    parts.name_everywhere(rendering.composite, "colour", floors.of_composite)
    parts.name_everywhere(rendering.sum_up, "weights")
    parts.name_everywhere(front_to_back.shade_natively, "front to back", floors.of_shaded)
    name_gates(parts, "gate")


def name_gates(parts: Parts, part: str) -> None:
    """Names what all gates are asked, those of an occupancy among them."""
    for owner, name in ((Gate, "forward"), (Occupancy, "query"), (Occupancy, "occupied")):
        parts.name(owner, name, part, floors.of_gate)


def name_host(parts: Parts, model: Any) -> None:
    """Names sampling and field of a host; what proposal networks say is sampling."""
    for module in model.modules():
        if isinstance(module, Sampler):
            parts.name(module, "forward", "sampling", floors.of_samples)
        elif callable(getattr(type(module), "sampling", None)):
            parts.name(module, "sampling", "sampling", floors.of_samples)
    name_gates(parts, "sampling")
    field = model.field
    if isinstance(field, Field):
        parts.name(field, "get_density", "field", floors.of_places)
        parts.name(field, "get_outputs", "field")
    else:
        parts.name(field, "forward", "field", floors.of_places)
        parts.name(field.color, "forward", "field")
    for module in field.modules():
        if isinstance(module, torch.nn.Linear):
            parts.name(module, "forward", "field", floors.of_linear(module))
        elif hasattr(module, "hash_table"):
            parts.name(module, "forward", "field", floors.of_host_table(module))


def phase_of(model: Any) -> str:
    """`guided` once there is an occupancy, else `learning`."""
    if isinstance(model, LecoModel):
        return "guided" if bool(model.mixture.frozen) else "learning"
    return "guided" if model.leco_guide.occupancy is not None else "learning"


class Course:
    """Stands around the steps of a run: profiles some of each phase, and ends it after them.

    Args:
        begins: at which step of each phase the first is profiled.
        steps: so many of each phase.
    """

    def __init__(
        self, trainer: Any, parts: Parts, begins: dict[str, int], steps: int, ceilings: Ceilings
    ) -> None:
        self.trainer, self.parts, self.ceilings = trainer, parts, ceilings
        self.begins, self.steps = begins, steps
        self.phase, self.done = "", 0
        self.seconds: list[float] = []
        self.running: Any = None
        self.found: dict[str, dict[str, Any]] = {}
        self.step_once = trainer.train_iteration
        trainer.train_iteration = self.step

    def step(self, step: int) -> Any:
        """In place of the trainer's."""
        phase = phase_of(self.trainer.pipeline.model)
        if phase != self.phase:
            self.phase, self.done, self.seconds = phase, 0, []
        if self.done == self.begins[phase]:
            self.parts.work.clear()
            self.running = profiler()
            self.running.__enter__()
        synchronize()
        started = time.perf_counter()
        outputs = self.step_once(step)
        synchronize()
        self.seconds.append(time.perf_counter() - started)
        self.done += 1
        if self.running is not None and self.done == self.begins[phase] + self.steps:
            self.running.__exit__(None, None, None)
            before = self.seconds[-2 * self.steps : -self.steps]
            self.found[phase] = {
                "unprofiled_ms": round(1e3 * statistics.median(before), 2),
                **figures(self.running, self.parts, self.steps, self.ceilings),
            }
            self.running = None
            self.trainer.stop_training = phase == "guided"
        return outputs


def figures(finished: Any, parts: Parts, calls: int, ceilings: Ceilings) -> dict[str, Any]:
    """Rays, samples and milliseconds of one of so many calls, and of each part beside its floor."""
    times: Times = split(finished.events(), of_device=torch.cuda.is_available())
    work, rows = parts.work, {}
    for part in sorted({*times.forward, *times.backward, *work}):
        needed: Work = work[part]
        floor = floors.milliseconds(needed.bytes, needed.operations, ceilings, calls)
        back = needed.backward_bytes, needed.backward_operations
        rows[part] = {
            "forward": 1e3 * times.forward.get(part, 0.0) / calls,
            "backward": 1e3 * times.backward.get(part, 0.0) / calls,
            "forward_floor": floor,
            "backward_floor": floors.milliseconds(*back, ceilings, calls),
        }
    return {
        "rays": round(sum(each.rays for each in work.values()) / calls, 1),
        "samples": round(sum(each.samples for each in work.values()) / calls, 1),
        "ms": round(1e3 * times.total / calls, 2),
        "parts": {
            part: {name: round(ms, 4) for name, ms in row.items()} for part, row in rows.items()
        },
    }


@torch.no_grad()
def profile_rendering(trainer: Any, parts: Parts, ceilings: Ceilings) -> dict[str, Any]:
    """The first test view; figures are of the whole of it."""
    pipeline = trainer.pipeline
    pipeline.eval()
    camera = pipeline.datamanager.eval_dataset.cameras[:1].to(pipeline.device)
    some = camera.generate_rays(camera_indices=0, keep_shape=False)[:RAYS_AT_ONCE]
    pipeline.model(some)  # what is built on the way
    parts.work.clear()
    synchronize()
    started = time.perf_counter()
    with profiler() as finished:
        pipeline.model.get_outputs_for_camera(camera)
        synchronize()
        seconds = time.perf_counter() - started
    found = figures(finished, parts, 1, ceilings)
    return {"rays_a_second": round(found["rays"] / seconds), **found}


def profile_method(method: str, options: Options, ceilings: Ceilings) -> dict[str, Any]:
    """All phases of one method: its steps, and the rendering of a test view."""
    learner = "" if method == "leco-occupancy" else "occupancy.learning."
    changes: dict[str, Any] = {}
    if options.learn_steps is not None:
        learning = {"learn_steps": options.learn_steps, "learn_share": 0.0}
        changes |= {f"{learner}schedule.{name}": value for name, value in learning.items()}
    if learner and options.occupancy is not None:
        changes["occupancy.path"] = options.occupancy
    parts = Parts()
    with tempfile.TemporaryDirectory() as folder:
        contender = Contender(method, method, LEARNED, changes)
        config = config_of(contender, options.data, Path(folder))
        trainer = set_up(config, Budget(steps=config.max_num_iterations), options.seed)
        name_parts(parts, trainer)
        earliest = 0
        if not learner:
            schedule = config.pipeline.model.schedule
            earliest = int(schedule.earliest * steps_in(config.max_num_iterations, schedule))
        begins = {"learning": max(1, earliest - options.steps), "guided": options.settle}
        course = Course(trainer, parts, begins, options.steps, ceilings)
        try:
            run_training(trainer)
            rendered = profile_rendering(trainer, parts, ceilings)
        finally:
            parts.close()
    return {**course.found, "rendering": rendered}


def main(options: Options) -> None:
    """Profiles the methods, one after the other, and stores what was found of each."""
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    dtype = getattr(torch, fast_precision(device))
    known = read_object(options.out, "is damaged; delete it") if options.out.exists() else {}
    scenes: dict[str, Any] = known.get("scenes", {})
    code = describe_code()
    for method in options.methods:
        load = round(os.getloadavg()[0], 1)
        tried = [measure_ceilings(device, SIDE, 1, dtype, COPIED) for _ in range(3)]
        best = (max(vars(each)[name] for each in tried) for name in vars(tried[0]))
        ceilings = Ceilings(*best)
        found = profile_method(method, options, ceilings)
        row = {"load": load, "ceilings": vars(ceilings), **found, **made_by(code)}
        scenes.setdefault(options.data.name, {})[method] = row
        write_json(options.out, {"format": 1, "machine": describe_machine(), "scenes": scenes})
        print(method, row, flush=True)


if __name__ == "__main__":
    main(tyro.cli(Options))
