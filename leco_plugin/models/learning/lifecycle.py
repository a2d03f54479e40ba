"""What happens around training steps: bounds before the first, ramps, freezing, healing."""

from __future__ import annotations

import time
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from nerfstudio.engine.callbacks import (
    TrainingCallback,
    TrainingCallbackAttributes,
    TrainingCallbackLocation,
)
from torch import Tensor

from leco_plugin.compat.nerfstudio_changes import end_of
from leco_plugin.compat.optimizers import forget_the_gone
from leco_plugin.models.compute.ranks import is_first, say, share
from leco_plugin.models.field import HMoEField
from leco_plugin.models.freezing.field_at_freezing import carry_over, leave_field
from leco_plugin.models.freezing.freezing import freeze, write_occupancy
from leco_plugin.models.freezing.guided_watch import GuidedWatch
from leco_plugin.models.freezing.held_out_rendering import calibration_rays
from leco_plugin.models.freezing.merging import merge
from leco_plugin.models.gate import occupancy_from_logits
from leco_plugin.models.learning.batches import Batches
from leco_plugin.models.learning.healing import STEPS_PER_LOOK
from leco_plugin.models.learning.history import GateHistory
from leco_plugin.models.learning.pace import keep_pace
from leco_plugin.models.learning.phases import (
    PROBES,
    ScheduleConfig,
    converged,
    decisions_agree,
    is_unsettled,
    ramp,
    steps_of_an_extension,
)
from leco_plugin.models.learning.progress import NO_EVIDENCE, Progress
from leco_plugin.models.learning.recoveries import Recoveries
from leco_plugin.models.learning.statistics import KEPT_ABOVE
from leco_plugin.models.rendering import gate_values_and_routes
from leco_plugin.occupancy import gate_precision
from leco_plugin.scenes.pixels.known_distances import sampler_here
from leco_plugin.scenes.survey import announce, survey

if TYPE_CHECKING:
    from leco_plugin.models.leco import LecoModel


class Lifecycle:
    """Carries one run of a `LecoModel` from its first step to its last."""

    def __init__(self, model: LecoModel, attributes: TrainingCallbackAttributes) -> None:
        assert attributes.pipeline is not None
        self.model = model
        self.pipeline: Any = attributes.pipeline
        self.trainer: Any = attributes.trainer
        most = configured = model.config.schedule.learn_steps
        if self.trainer is not None:
            # a short run still passes through both phases, and a resumed one has steps behind it
            steps = self.end() - self.trainer._start_step
            most = max(2, int(0.5 * steps))
            most += max(0, self.trainer._start_step - self.progress.since)
            self._say_if_short(configured, most, steps)
        # nerfstudio makes callbacks after it has loaded a checkpoint
        if not bool(model.frozen):  # else other steps would take it back into the first phase
            self.progress.begin(configured, most)
        self.batches = Batches(model, self.pipeline.datamanager)
        config = model.config
        self.survey = survey(self.pipeline.datamanager, config.bounds, config.near, config.far)
        if not bool(model.bounds_known):
            model.set_bounds(self.survey.bounds, self.survey.median_length)
            dataset: Any = self.pipeline.datamanager.train_dataset
            model.backdrops.look(dataset.cameras, model.space, model.aabb, *model.march_range[:2])
            announce(self.survey)
            if sampler_here(self.pipeline.datamanager) is None:
                say("batches come from elsewhere: they keep their size, and no pixel's distance")
        self.optimizers: list[Any] = []
        """Those of the model, where they are not a trainer's."""
        self.step_started = 0.0
        self.history = GateHistory()
        self.guided = GuidedWatch(self)
        resumed = None
        if self.trainer is not None:
            resumed = self.trainer.config.load_checkpoint or self.trainer.config.load_dir
        if resumed is not None and self.folder is not None:
            self._take_along(Path(resumed), self.folder)

    def _take_along(self, resumed: Path, folder: Path) -> None:
        """What a resumed run leaves in its folder, which may be another one than before."""
        model = self.model
        self.history = GateHistory.gone_on_from(resumed, self.trainer._start_step, model.gate)
        if len(self.history):
            self._save_history(folder)
        if bool(model.frozen):
            write_occupancy(model, folder)
            carry_over(resumed, folder)

    def _say_if_short(self, configured: int, most: int, steps: int) -> None:
        """Says so before a run of few steps that learns for fewer than are configured."""
        if most < configured != self.progress.configured:
            say(
                f"a run of {steps} steps learns the occupancy in "
                f"its first half: until step {self.progress.since + most}, not for the "
                f"{configured} steps of schedule.learn-steps"
            )

    @cached_property
    def recoveries(self) -> Recoveries:
        """What is done about a gate that collapses."""
        return Recoveries(self)

    @property
    def progress(self) -> Progress:
        """Of the model, because that is what a checkpoint restores."""
        return self.model.progress

    @property
    def schedule(self) -> ScheduleConfig:
        """The config's, with the learning steps of this run."""
        return replace(self.model.config.schedule, learn_steps=self.progress.learn_steps)

    @property
    def schedule_since(self) -> ScheduleConfig:
        """The same, of what has begun at `Progress.began`."""
        steps = self.progress.learn_steps - self.progress.began
        return replace(self.model.config.schedule, learn_steps=steps)

    @property
    def folder(self) -> Path | None:
        """The run's folder; None where no file is to be left, as by all processes but the first."""
        return Path(self.trainer.base_dir) if self.trainer is not None and is_first() else None

    def callbacks(self) -> list[TrainingCallback]:
        """What nerfstudio's trainer calls before and after each step."""
        before, after = (
            TrainingCallbackLocation.BEFORE_TRAIN_ITERATION,
            TrainingCallbackLocation.AFTER_TRAIN_ITERATION,
        )
        return [
            TrainingCallback([before], self.before_step),
            TrainingCallback([after], self.after_step),
        ]

    def before_step(self, step: int) -> None:
        """Sets what follows from the step alone, so that a resumed run is where it was."""
        model = self.model
        model.step = step
        model.ramped = ramp(step - self.progress.began, self.schedule_since)
        never_frozen = model.config.homogeneous or not self.schedule.freeze
        model.learned = never_frozen and step >= self.schedule.learn_steps
        keep_pace(self._optimizers(), self.progress.pace)
        past_learning = bool(model.frozen) or model.learned
        self.batches.prepare(learning=not past_learning)
        self.step_started = time.monotonic()

    def after_step(self, step: int) -> None:
        """Looks at the gate now and then, and freezes it when its decisions have settled; then at
        what skipping costs."""
        model = self.model
        if model.learned or model.config.homogeneous:
            return
        seconds = time.monotonic() - self.step_started
        if bool(model.frozen):
            self.guided.after_step(step, seconds)
        else:
            self.progress.learn_seconds += seconds
            self._after_learning_step(step)
        if self.schedule.freeze and not bool(model.frozen) and self._ends_after(step):
            say(
                f"step {step}: the run ends while its occupancy is still learned, to step "
                f"{self.progress.learn_steps}, and nothing is frozen; go on from its checkpoint "
                "with --load-dir"
            )

    def _ends_after(self, step: int) -> bool:
        return self.trainer is not None and step + 1 >= self.end()

    def end(self) -> int:
        """Steps of the run when it ends, those before it was resumed included."""
        return end_of(self.trainer)

    def _after_learning_step(self, step: int) -> None:
        model, schedule, progress = self.model, self.schedule, self.progress
        if schedule.steps_per_record > 0 and step % schedule.steps_per_record == 0:
            self._record(step)
        last = step + 1 >= schedule.learn_steps
        checks = (step + 1) % schedule.steps_per_check == 0 or last
        if not checks and (step + 1) % STEPS_PER_LOOK:
            return
        logits = self._probe()
        kept = occupancy_from_logits(logits) >= KEPT_ABOVE
        if schedule.freeze and self.recoveries.after_look(step, logits, kept, last):
            return
        if not checks:
            return
        agreement = decisions_agree(progress.decisions.to(kept.device), kept)
        progress.decisions = kept
        if not schedule.freeze or (progress.suspected_since >= 0 and not last):
            return
        if not last and float(kept.float().mean()) > 0.95:
            return  # it agrees with itself only because it has not yet found anything empty
        since, of_those = step - progress.began, self.schedule_since
        unsettled = last and is_unsettled(since, agreement, of_those, progress.extensions)
        if unsettled and self._learns_on(step, agreement):
            return
        if converged(since, agreement, of_those):
            say(
                f"step {step}: {agreement:.1%} of {len(kept)} decisions are those of "
                f"{schedule.steps_per_check} steps ago; freezing the gate"
            )
            data, seconds = self.pipeline.datamanager, progress.learn_seconds
            measured = freeze(model, data, self.survey, step, seconds)
            if self.recoveries.falls_back(step, measured):
                return
            if self.folder is not None:
                write_occupancy(model, self.folder)
                leave_field(model, self.folder)
            if self.trainer is not None and not schedule.restart:
                merge(model, lambda count: calibration_rays(model, data, count))
                forget_the_gone(self.trainer.optimizers, model.get_param_groups())
            progress.recheck_due, progress.surface, progress.image = 0, NO_EVIDENCE, NO_EVIDENCE
            progress.suspected_since = -1  # of the gate as it is now
            if schedule.steps_per_record > 0:
                self._record(step)
            if schedule.restart:
                self.restart_field()
                say("the field starts anew, guided from its first step")
            self.save(step)  # a run killed from now on stays frozen

    def _learns_on(self, step: int, agreement: float) -> bool:
        """Gives a gate that has not settled more steps, where the run has any; returns whether."""
        progress = self.progress
        until = step + 1 + steps_of_an_extension(progress.phase or progress.configured)
        if self.trainer is not None:
            until = min(until, self.end())
        if until <= step + 1:
            return False
        progress.extensions += 1
        progress.learn_steps = until
        say(
            f"step {step}: only {agreement:.1%} of the gate's decisions are those of the last "
            f"check; it learns on until step {progress.learn_steps}"
        )
        return True

    def save(self, step: int) -> None:
        """A checkpoint, where the run saves any."""
        if self.trainer is not None and self.trainer.config.steps_per_save > 0:
            self.trainer.save_checkpoint(step)

    @torch.no_grad()
    def _record(self, step: int) -> None:
        """One more entry in the history of the gate, which is written each time."""
        if self.folder is None:
            return
        model, positions = self.model, self.probe_positions
        with gate_precision(model.device.type, model.precision):
            gate_values, routes = gate_values_and_routes(
                model.gate(positions), model.routing, model.field.experts.those_left()
            )
            sigmas, _ = model.field.density(positions, routes, gate_values)
        self.history.look(step, self.progress.learn_seconds, model.gate, routes, sigmas)
        self._save_history(self.folder)

    def _save_history(self, folder: Path) -> None:
        try:
            self.history.save(folder)
        except OSError as error:
            say(f"the history of the gate could not be written ({error})")

    def restart_field(self) -> None:
        """Gives the field the weights of a new one, and its optimizers nothing to remember."""
        field = self.model.field
        fresh = HMoEField(field.config, self.model.num_train_data)
        for number, left in enumerate(field.experts.left.tolist(), 1):
            if not left:
                fresh.experts.drop(number)
        field.load_state_dict(fresh.state_dict())
        share(field.parameters())
        for optimizer in self._optimizers():
            optimizer.state.clear()

    def _optimizers(self) -> list[Any]:
        if self.trainer is None:
            return self.optimizers
        return list(self.trainer.optimizers.optimizers.values())

    @cached_property
    def probe_positions(self) -> Tensor:
        """Mapped candidates of a fixed set of training rays: [P, 3] in [-1, 1]."""
        model = self.model
        rays = self.survey.probe_rays(model.device, model.aabb, model.march_range)
        generator = torch.Generator().manual_seed(0)
        which = torch.randint(len(rays.origins), (PROBES,), generator=generator)
        along = torch.rand(PROBES, generator=generator).to(model.device)
        which = which.to(model.device)
        distance = torch.lerp(rays.t_mins[which], rays.t_maxs[which], along)
        positions = rays.origins[which] + rays.directions[which] * distance[:, None]
        return model.space.map(positions).clamp(-1.0, 1.0)

    @torch.no_grad()
    def _probe(self) -> Tensor:
        """The gate's logits [P, 1 + n] at the probe positions, the same ones in every process."""
        with gate_precision(self.model.device.type, self.model.precision):
            logits: Tensor = self.model.gate(self.probe_positions)
        share([logits])
        return logits
