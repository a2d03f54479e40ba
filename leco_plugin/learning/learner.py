"""Learning an occupancy, step by step: ramps, freezing, and the price watch after it.

The learner knows no trainer. The training loop calls it at each step; a `Run` stands for the loop.
"""

from __future__ import annotations

import math
from functools import cached_property
from typing import TYPE_CHECKING

from torch import Tensor

from leco_plugin.evaluation.clock import seconds_now
from leco_plugin.learning.calibration import promise_below
from leco_plugin.learning.collapse import STEPS_PER_LOOK, StepPlan, is_dense, plan_of
from leco_plugin.learning.freezing import advice_on, carry_over, leave_field, leave_file
from leco_plugin.learning.held_out import HeldOut
from leco_plugin.learning.history import GateHistory, Probes
from leco_plugin.learning.merging import line_of
from leco_plugin.learning.price_watch import PriceWatch
from leco_plugin.learning.quality import (
    FIELD,
    ONE_COLOUR,
    doubts_of_field,
    doubts_of_occupancy,
    kept_of_seen,
    views_in_words,
)
from leco_plugin.learning.recoveries import KEEPS_NOTHING, Recoveries
from leco_plugin.learning.run import Progress, Run, WatchState, keep_pace
from leco_plugin.learning.schedule import (
    KEPT_ABOVE,
    converged,
    decisions_agree,
    is_unsettled,
    schedule_since,
    steps_in,
    steps_of_an_extension,
)
from leco_plugin.log import note, say, say_all, summarize
from leco_plugin.models.compute.ranks import from_first, mean, share
from leco_plugin.models.gate import occupancy_from_logits
from leco_plugin.models.mixture import Mixture

if TYPE_CHECKING:
    from pathlib import Path

    from leco_plugin.models.leco_config import LecoModelConfig
    from leco_plugin.scenes.learning_data import LearningData

FEWEST_KEPT = 0.5
"""An occupancy that is expected to keep fewer samples a ray than this may rightly keep none in a
batch: no alarm then."""
SHARPENED_FROM = 0.9
"""Share of a run at which a small gate is taught; in what is left the field grows used to it."""
NEARLY_ALL = 0.95
"""Share of the probe positions above which a gate has found nothing empty yet."""


class Learner:
    """Carries one run of a mixture from its first step to its last.

    Args:
        mixture: gate and field; the learner and its recoveries alone freeze and open the gate.
        data: batches, held-out pixels and the scene's place.
        run: what is around the steps.
        config: of the method.
        progress: how far the run has come; changed in place, and stored in checkpoints.

    Attributes:
        past_learning: whether the first phase is over and no gate is ever frozen.
    """

    def __init__(
        self,
        mixture: Mixture,
        data: LearningData,
        run: Run,
        config: LecoModelConfig,
        progress: Progress,
    ) -> None:
        self.mixture, self.data, self.run = mixture, data, run
        self.config, self.progress = config, progress
        self.history, self.past_learning = GateHistory(), False
        restarted = config.schedule.restart
        self.held_out = HeldOut(mixture, data, config.calibration, restarted)
        self.watch = PriceWatch(progress.watch, self.held_out, config.calibration, mixture.device)
        self.recoveries = Recoveries(mixture, run, progress, config)

    def begin(self) -> None:
        """Before the first step of this process: learning time, bounds, and files of the run that
        is gone on with."""
        mixture, progress, run = self.mixture, self.progress, self.run
        configured = most = self.config.schedule.learn_steps
        # a short run still passes through both phases, and a resumed one has steps behind it
        if math.isfinite(run.end):
            steps = int(run.end) - run.start
            most = max(2, int(0.5 * steps)) + max(0, run.start - progress.since)
            if most < configured != progress.configured:  # a resumed run has said so before
                say(
                    f"a run of {steps} steps learns the occupancy in its first half: until step "
                    f"{progress.since + most}, not for the {configured} steps of "
                    "schedule.learn-steps"
                )
        if not mixture.is_frozen:  # else other steps would take it back into the first phase
            progress.begin(configured, most)
            if run.start < progress.learn_steps:
                progress.lengthen(steps_in(run.end, self.config.schedule))
        mixture.routing = self.recoveries.routing()
        if not bool(mixture.region.known):
            found = self.data.survey
            mixture.set_bounds(found.bounds, found.median_length)
            self.data.note_views(mixture.region)
            summarize(found.summary(), found.lines())
            say_all(self.data.doubts())
            self.data.say_what_is_fixed()
        if run.resumed_from is not None and run.folder is not None:
            self._take_along(run.resumed_from, run.folder)

    def _take_along(self, resumed: Path, folder: Path) -> None:
        """What a resumed run leaves in its folder, which may be another one than before."""
        self.history = GateHistory.load_before(resumed, self.run.start, self.mixture.gate)
        if len(self.history):
            self.history.leave(folder)
        if self.mixture.is_frozen:
            self._leave_file()
            carry_over(resumed, folder)

    @cached_property
    def probes(self) -> Probes:
        """The mixture at fixed positions, at which its decisions are compared."""
        return Probes(self.mixture, self.data.survey)

    def before_step(self, step: int) -> StepPlan:
        """Prepares the batch, and says how the step samples and what it teaches. Both follow from
        what checkpoints hold: a resumed run is where it was."""
        config, progress, frozen = self.config, self.progress, self.mixture.is_frozen
        never_frozen = config.homogeneous or not config.schedule.freeze
        self.past_learning = never_frozen and step >= progress.learn_steps
        keep_pace(self.run.optimizers(), progress.pace)
        learning = not (frozen or self.past_learning)
        self.data.prepare_batch(
            self._guided_batch() if frozen else self._learning_batch(step),
            distances=learning and config.termination > 0.0,
            set_aside=config.calibration.cameras if learning and not never_frozen else 0,
        )
        return plan_of(step, config, progress, learning, frozen)

    def _learning_batch(self, step: int) -> float:
        """Rays of a batch as a multiple, while the gate being learned is followed already.

        The same in every process: the mean of their gradients is then that of one large batch.
        """
        progress = self.progress
        if self.past_learning or is_dense(progress, step):
            # no longer followed; and what a gate kept that has collapsed says nothing
            progress.learning_kept = 1.0
        progress.learning_kept = mean(progress.learning_kept, self.mixture.device)
        wanted = min(self.mixture.sizes.guided_batch, 1.0 / progress.learning_kept)
        return round(8 * wanted) / 8  # of few sizes; see `dispatch.steady_size`

    def _guided_batch(self) -> float:
        """Rays of a guided batch as a multiple: about as many samples are shaded as before."""
        sizes = self.mixture.sizes
        kept = 1.0 - float(self.mixture.report.get("empty_fraction", 0.0))
        same_samples = sizes.learn_candidates / max(1.0, kept * sizes.candidates)
        return min(sizes.guided_batch, max(0.5, same_samples))

    def after_step(self, step: int, seconds: float, kept: float) -> None:
        """Looks at the gate now and then, and freezes it when its decisions have settled; then at
        what skipping costs. GateCollapsed if it has collapsed more often than it may be healed.

        Args:
            seconds: that the step took.
            kept: samples a ray that the frozen gate kept of the batch, backdrops excluded.
        """
        if self.past_learning:
            return
        schedule, frozen = self.config.schedule, self.mixture.is_frozen
        if not frozen and (step + 1) % schedule.steps_per_check == 0:
            self.progress.lengthen(steps_in(self.run.end, schedule))
        if self.config.homogeneous:
            return
        if frozen:
            self._watch(step, seconds, kept)
            if self._is_time_to_sharpen(step):
                self._sharpen(step)
        else:
            self.progress.learn_seconds += seconds
            self._after_learning_step(step)
        ends_unfrozen = step + 1 >= self.run.end and not self.mixture.is_frozen
        if schedule.freeze and ends_unfrozen:
            say(
                f"step {step}: the run ends while its occupancy is still learned, to step "
                f"{self.progress.learn_steps}, and nothing is frozen; go on from its checkpoint "
                "with --load-dir"
            )

    def _after_learning_step(self, step: int) -> None:
        schedule, progress = self.config.schedule, self.progress
        if schedule.steps_per_record > 0 and step % schedule.steps_per_record == 0:
            self._record(step)
        last = step + 1 >= progress.learn_steps
        checks = (step + 1) % schedule.steps_per_check == 0 or last
        if not checks and (step + 1) % STEPS_PER_LOOK:
            return
        logits = self.probes.logits()
        kept = occupancy_from_logits(logits) >= KEPT_ABOVE
        if schedule.freeze and self.recoveries.heal_if_collapsed(step, logits, kept, last):
            return
        if checks and self._has_settled(step, kept, last):
            self._freeze(step)

    def _has_settled(self, step: int, kept: Tensor, last: bool) -> bool:
        """Whether to freeze at a check, which is the last of the first phase or not; a gate that
        has not settled is given more steps. `kept` [P] is what it decides at the probes."""
        schedule, progress = self.config.schedule, self.progress
        agreement = decisions_agree(progress.decisions.to(kept.device), kept)
        progress.decisions = kept
        if not schedule.freeze or (progress.suspected_since >= 0 and not last):
            return False
        if not last and float(kept.float().mean()) > NEARLY_ALL:
            return False  # it agrees with itself only because it has found nothing empty yet
        age, of_those = step - progress.began, schedule_since(schedule, progress)
        unsettled = last and is_unsettled(age, agreement, of_those, progress.extensions)
        if unsettled and self._extends(step, agreement):
            return False
        if not converged(age, agreement, of_those):
            return False
        note(
            f"step {step}: {agreement:.1%} of {len(kept)} decisions are those of "
            f"{schedule.steps_per_check} steps ago; freezing the gate"
        )
        return True

    def _extends(self, step: int, agreement: float) -> bool:
        """Gives a gate that has not settled more steps, where the run has any; returns whether."""
        progress = self.progress
        until = step + 1 + steps_of_an_extension(progress.phase or progress.configured)
        until = int(min(until, self.run.end))
        if until <= step + 1:
            return False
        progress.extensions, progress.learn_steps = progress.extensions + 1, until
        say(
            f"step {step}: only {agreement:.1%} of the gate's decisions are those of the last "
            f"check; it learns on until step {until}"
        )
        return True

    def _freeze(self, step: int) -> None:
        """Calibrates and freezes the gate, drops scene experts that nothing needs, leaves files.

        In every process of a data-parallel run the gate is that of the first one, and its price.
        """
        mixture, progress, schedule = self.mixture, self.progress, self.config.schedule
        share(mixture.gate.state_dict().values())
        seconds = round(progress.learn_seconds, 2)
        careful = self._may_sharpen(after=step)
        found = from_first(lambda: (*self.held_out.price(careful), seconds), mixture.device)
        measured, within, report, seconds = found
        report |= {"step": step, "train_seconds": seconds, "recoveries": progress.recoveries}
        mixture.freeze(measured.threshold, report)
        say(
            f"occupancy learned in {progress.learn_seconds:.0f} s: threshold "
            f"{measured.threshold:.4f} {measured.line} ({measured.lost_mass:.2e} of all)"
        )
        if careful:
            note(f"its bounds allow {within.threshold:.4f}; it is lower until a small gate follows")
        if advice := advice_on(within, step + 1 - progress.since, progress.recoveries):
            say(advice)
        if self.recoveries.fall_back(step, within):
            return
        self._leave_file()
        leave_field(mixture, self.run.folder)
        if not schedule.restart and self.run.goes_on:
            self._merge()
        say(views_in_words(report))
        doubts = doubts_of_field(report.get(FIELD, math.inf), report.get(ONE_COLOUR, math.inf))
        say_all(doubts or doubts_of_occupancy(kept_of_seen(mixture, within.threshold)))
        self.data.prepare_batch(1.0, distances=False)  # from now on all photographs train
        progress.watch = self.watch.state = WatchState()
        progress.suspected_since = -1  # of the gate as it is now
        if schedule.steps_per_record > 0:
            self._record(step)
        if schedule.restart:
            self.recoveries.restart_field()
            say("the field starts anew, guided from its first step")
        self.run.save(step)  # a run killed from now on stays frozen

    def _may_sharpen(self, after: int) -> bool:
        """Whether a small gate follows one that guides from step `after` on: the field has to be
        guided for long enough by then. A gate that is learned alone is not sharpened, nor one of
        another kind: samplers are made for the kind that was asked for."""
        config, when = self.config.sharpening, SHARPENED_FROM * self.run.end
        same_kind = self.mixture.gate.config.encoding.kind == config.gate.encoding.kind
        can = config.steps > 0 and self.run.goes_on and same_kind
        return can and config.least_steps <= when - after < math.inf

    def _is_time_to_sharpen(self, step: int) -> bool:
        """Whether so much of the run is over, and the field was guided for long enough by then,
        since freezing or the last time."""
        last, when = self.progress.sharpened_at, SHARPENED_FROM * self.run.end
        now = step + 1 >= when > last + 1  # once in a run, however few steps are enough
        if not now or not self.mixture.is_frozen:
            return False
        return self._may_sharpen(after=max(last, self.mixture.report["step"]))

    def _sharpen(self, step: int) -> None:
        """Has a small gate skip in place of the learned one where it skips more, and says so."""
        mixture, config, started = self.mixture, self.config.sharpening, seconds_now()
        self.progress.sharpened_at = step
        losses = self.config.gate_loss
        found = from_first(lambda: self.held_out.sharpened(losses, config), mixture.device)
        if found is None:
            return
        seconds = seconds_now() - started
        taught = f"a gate of {found.params:,} values, taught in {seconds:.0f} s"
        say(f"step {step}: {taught}, {found.line(mixture.report)}")
        if not found.pays:
            return
        report = found.report(mixture.report, mixture.gate.config)
        report["sharpened"] = [*report.get("sharpened", []), [step, round(seconds, 2)]]
        mixture.sharpen(found.gate.to(mixture.device), found.measured.threshold, report)
        say(views_in_words(report))
        self.watch.state.evidence = {}  # of what guided before
        self.watch.put_off(step)
        self._leave_file()
        self.run.save(step)  # what is killed from now on goes on with the gate of the file

    def _merge(self) -> None:
        """Drops the scene experts that a frozen mixture does not need, and says so.

        All processes of a data-parallel run drop those that the first one finds.
        """
        mixture, config = self.mixture, self.config.merging
        experts, bound = mixture.field.experts, config.image_price_db
        if bound is not None and int(experts.left.sum()) > 1:
            found = from_first(lambda: self.held_out.unneeded(config.rays, bound), mixture.device)
            for trial in found.dropped:
                experts.drop(trial.expert)
            note(line_of(found, int(experts.left.sum())))
        self.run.forget(mixture.parameter_groups())

    def _watch(self, step: int, seconds: float, kept: float) -> None:
        """Looks at a guided step: skips less where skipping costs too much, and opens a gate that
        keeps nothing of what the cameras see."""
        mixture = self.mixture
        expected = (1.0 - mixture.report["empty_fraction"]) * mixture.sizes.candidates
        kept_any = kept > 0.0 or expected < FEWEST_KEPT
        finding = self.watch.after_step(step, seconds, float(kept_any), mixture.skips)
        if finding is None:
            return
        if finding.kind == "beyond":
            why = f"{finding.why} of skipping is beyond its bound for the field as it is now"
            self._skip_less(step, why, float(mixture.threshold))
        elif finding.kind == "nothing kept" and not self.recoveries.reopen_useless(step):
            self._skip_less(step, f"{KEEPS_NOTHING}, and few steps are left", 0.0)

    def _skip_less(self, step: int, why: str, below: float) -> None:
        """Lowers the threshold below another one until the prices are within their bounds, to 0
        where none is low enough; says why, and leaves it in the run's files."""
        mixture, before, watched = self.mixture, float(self.mixture.threshold), self.watch.state
        found = from_first(lambda: self.held_out.lower(below, watched.rechecks), mixture.device)
        lowered = [*mixture.report.get("lowered", []), [step, found.threshold]]
        known = mixture.report | promise_below(mixture.report, found.threshold)
        mixture.freeze(found.threshold, known | found._asdict() | {"lowered": lowered})
        watched.evidence = {}
        now = "no threshold is low enough: " if below > 0.0 else ""
        now += "from now on nothing is skipped"
        if found.threshold > 0.0:
            now = f"threshold {before:.4f} lowered to {found.threshold:.4f}, which {found.line}"
        say(f"step {step}: {why}; {now}")
        self._leave_file()
        self.run.save(step)

    def _leave_file(self) -> None:
        leave_file(self.mixture.occupancy(), self.run.folder)

    def _record(self, step: int) -> None:
        """One more entry in the history of the gate, which is written each time."""
        if self.run.folder is None:
            return
        found = self.probes.routes_and_densities()
        self.history.look(step, self.progress.learn_seconds, self.mixture.gate, *found)
        self.history.leave(self.run.folder)
