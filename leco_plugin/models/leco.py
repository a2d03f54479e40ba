"""`leco-occupancy` as a nerfstudio model: an adapter of a mixture and its learner."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.engine import callbacks
from nerfstudio.model_components.renderers import RGBRenderer
from nerfstudio.models.base_model import Model
from torch import Tensor, nn

from leco_plugin.evaluation.clock import seconds_now
from leco_plugin.learning.collapse import StepPlan, annealed
from leco_plugin.learning.learner import Learner
from leco_plugin.learning.run import Progress, Run
from leco_plugin.learning.schedule import KEPT_ABOVE
from leco_plugin.models import figures
from leco_plugin.models.compute.device import fast_precision, keep_freed_memory
from leco_plugin.models.leco_config import LecoModelConfig
from leco_plugin.models.losses import color_loss, require_finite
from leco_plugin.models.mixture import Mixture
from leco_plugin.models.objective import field_losses, gate_losses
from leco_plugin.models.rendering import Intervals, Rays, Routing, Shaded
from leco_plugin.models.sizing.scene_sizes import complete
from leco_plugin.scenes.input_error import InputError, state_of_this_version
from leco_plugin.scenes.learning_data import LearningData
from leco_plugin.scenes.pixels.known_distances import DISTANCE
from leco_plugin.scenes.survey import places_of
from leco_plugin.studio.checkpoints import prepare_checkpoints, refuse_earlier
from leco_plugin.studio.occupancy_view import Drawn, DrawnInViewer, OccupancyView, is_viewer_drawing
from leco_plugin.studio.run_folder import run_of


class LecoModel(DrawnInViewer, Model):
    """A mixture behind nerfstudio's model interface.

    Attributes:
        mixture: gate, field and region.
        progress: how far its run has come.
        vouching: how many photographs taught the gate nothing so far; None before its run begins.
        plan: what the next training step does.
        kept_per_ray: mean kept samples per ray in the last batch, backdrop excluded; 1 while
            nothing is skipped.
    """

    config: LecoModelConfig

    def populate_modules(self) -> None:
        """Builds the mixture, in sizes of the scene where none are given."""
        super().populate_modules()
        prepare_checkpoints()
        config, device = self.config, self.kwargs.get("device", "cpu")
        keep_freed_memory(device)
        metadata = self.kwargs.get("metadata") or {}
        sizes = complete(config.sizes, config.bounds, metadata, self.num_train_data, device)
        losses = config.gate_loss
        below = losses.empty_below if losses.form == "logit" else None
        precision = config.precision or fast_precision(device)
        routing = Routing(below, config.homogeneous)
        places = places_of(metadata)
        self.mixture = Mixture(sizes, self.num_train_data, precision, routing, places)
        self._keep_sizes()
        self.leco_view = OccupancyView()
        # nerfstudio's name for it: photographs with alpha are blended over black
        self.renderer_rgb = RGBRenderer(background_color="random")
        self.progress = Progress()
        self.vouching: int | None = None
        self.plan = StepPlan(0, True, 0.0, None, annealed(losses, self.progress, 0))
        self.kept_per_ray = 1.0
        self.register_load_state_dict_post_hook(lambda model, _: model._keep_sizes())

    def _keep_sizes(self) -> None:
        """Puts the mixture's sizes into a config of its own: others may share the given one."""
        self.num_train_data = self.mixture.num_images
        if self.mixture.sizes != self.config.sizes:
            self.config = replace(self.config, sizes=self.mixture.sizes)

    def get_param_groups(self) -> dict[str, list[nn.Parameter]]:
        """As `Mixture.parameter_groups`; an optimizer needs a parameter, and may have a dummy."""
        groups = self.mixture.parameter_groups()
        return {name: group or [self.device_indicator_param] for name, group in groups.items()}

    def get_training_callbacks(
        self, training_callback_attributes: callbacks.TrainingCallbackAttributes
    ) -> list[callbacks.TrainingCallback]:
        """Finds the scene's bounds now, and returns what runs around each step."""
        attributes = training_callback_attributes
        assert attributes.pipeline is not None
        learner = self.learner(attributes.pipeline.datamanager, run_of(attributes.trainer))
        learner.begin()
        where, around = callbacks.TrainingCallbackLocation, callbacks.TrainingCallback
        started = seconds_now()

        def before_step(step: int) -> None:
            nonlocal started
            self.plan = learner.before_step(step)
            started = seconds_now()

        def after_step(step: int) -> None:
            learner.after_step(step, seconds_now() - started, self.kept_per_ray)

        return [
            around([where.BEFORE_TRAIN_ITERATION], before_step),
            around([where.AFTER_TRAIN_ITERATION], after_step),
        ]

    def learner(self, manager: Any, run: Run) -> Learner:
        """What carries the mixture through a run on the data of a data manager."""
        config = self.config
        asked = config.bounds, config.near, config.far
        if bool(self.mixture.region.known):
            self.mixture.region.refuse_others(*asked)
        data = LearningData(manager, *asked)
        if not self.mixture.is_frozen:
            self._note_vouching(data)
        return Learner(self.mixture, data, run, config, self.progress)

    def _note_vouching(self, data: LearningData) -> None:
        """Notes how many photographs vouch. InputError if others would than before the run was
        resumed: they have taught its gate."""
        freezes = self.config.schedule.freeze and not self.config.homogeneous
        asked, before = self.config.calibration.cameras if freezes else 0, self.vouching
        self.vouching = len(data.vouching(asked))
        if before is not None and self.vouching not in (0, before):
            raise InputError(
                f"--pipeline.model.calibration.cameras is {asked}, and of the run that is gone on "
                f"with {before} photographs vouch: give that, or begin a new run"
            )

    def leco_drawn(self) -> Drawn | None:
        """See `DrawnInViewer`."""
        return Drawn(self.mixture.occupancy(), None) if self.mixture.is_frozen else None

    def rays_of(self, bundle: RayBundle) -> Rays:
        """The bundle's rays, cut to the region and to a crop; see `Region.rays`. In the viewer they
        reach the ground from wherever somebody looks."""
        region = self.mixture.region
        rays = region.of_bundle(bundle, self.training, self.mixture.steps.min())
        whole = is_viewer_drawing() and bundle.nears is None
        return region.down_to_the_floor(rays) if whole else rays

    def intervals_of(self, rays: Rays) -> Intervals:
        """What is shaded along rays: candidates, or those that the gate lets through."""
        mixture, plan = self.mixture, self.plan
        coarse = self.training and plan.coarse
        jitter = torch.rand_like(rays.t_mins) if self.training else None
        intervals = mixture.kept(rays, coarse, jitter)
        following = None if mixture.skips else plan.following
        if following is not None and (self.training or is_viewer_drawing()):
            candidates = len(intervals.t_starts)
            intervals = mixture.follow(rays, intervals, following)
            if self.training:
                self.progress.has_shaded(len(intervals.t_starts) / max(candidates, 1))
        if not (self.training or mixture.skips):
            intervals = mixture.seen(rays, intervals)
        return mixture.with_backdrops(rays, intervals, coarse)

    def get_outputs(self, ray_bundle: RayBundle) -> dict[str, Any]:  # type: ignore[override]
        """Pixels of rays; in training also what losses and log need: `shaded`, `intervals`, `rays`,
        and `kept_rule`, the last three arguments of `kept_fraction`.

        In training accumulation and depth are those that losses see, with the backdrop; in
        evaluation the backdrop is nothing met.
        """
        mixture, rays = self.mixture, self.rays_of(ray_bundle)
        intervals = self.intervals_of(rays)
        if self.training:
            kept = len(intervals.t_starts) / max(len(rays.origins), 1) - 1.0
            self.kept_per_ray = kept if mixture.skips else 1.0
            shaded = mixture.shade(rays, intervals, kept=True)
            likely = max(KEPT_ABOVE, self.config.likely_above)
            above = 0.0 if mixture.is_frozen else likely  # a frozen gate has left out the others
            return {
                "rgb": shaded.rgb,
                "depth": shaded.depth[:, None],
                "accumulation": shaded.accumulation[:, None],
                "shaded": shaded,
                "intervals": intervals,
                "rays": rays,
                "kept_rule": (above, *mixture.rule(self.plan.coarse)),
            }
        shaded, intervals = mixture.show(rays, intervals, self.config.front_to_back)
        met, shown = figures.before_the_backdrop(shaded, intervals, rays)
        colors = figures.over_background(shaded, rays)
        ends = rays.origins + rays.directions * met.depth[:, None]
        occupancies = mixture.occupancies(mixture.region.space.map(ends))
        of_gate = met, intervals.ray_indices, occupancies, 1 + mixture.sizes.gate.scene_experts
        return {"rgb": colors, **shown, **figures.gate_pictures(*of_gate)}

    get_rgba_image = staticmethod(figures.with_alpha)
    get_image_metrics_and_images = figures.image_figures

    def get_loss_dict(
        self, outputs: dict[str, Any], batch: dict[str, Tensor], metrics_dict: Any = None
    ) -> dict[str, Tensor]:
        """Colour loss, distortion loss, and before the gate is frozen what teaches it. ValueError
        if the batch holds no rays, FloatingPointError if a loss is not finite: no step is taken.
        Of a batch that is evaluated the colour loss alone."""
        image = batch["image"].to(self.device)
        if "shaded" not in outputs:
            truth = self.renderer_rgb.blend_background(image)
            return {"rgb_loss": color_loss(outputs["rgb"], truth)}
        shaded: Shaded = outputs["shaded"]
        batch_of = shaded, outputs["intervals"], outputs["rays"]
        config, region, plan = self.config, self.mixture.region, self.plan
        if len(image) == 0:
            raise ValueError("a training batch holds no rays: are all pixels masked?")
        known = batch.get(DISTANCE)
        losses = field_losses(
            config,
            *batch_of,
            self.renderer_rgb.blend_background(image),
            image[:, 3] if image.shape[-1] == 4 else None,
            None if known is None else known.to(self.device),
            grounded=region.meet_ground(outputs["rays"]),
            span=(region.near, region.far),
            unbounded=region.space.unbounded,
            learning=plan.coarse,
            ramped=plan.ramped,
        )
        if plan.gate_loss is not None and not self.mixture.is_frozen:
            unit, equal = region.space.half_extent, config.homogeneous
            losses |= gate_losses(plan.gate_loss, *batch_of, unit, equal, ramped=plan.ramped)
        require_finite(losses, self, outputs, image)
        return losses

    @torch.no_grad()
    def get_metrics_dict(
        self, outputs: dict[str, Any], batch: dict[str, Tensor]
    ) -> dict[str, Tensor]:
        """PSNR of the batch; of the gate: kept fraction, share and density per expert; once it is
        frozen, what skipping costs."""
        truth = self.renderer_rgb.blend_background(batch["image"].to(self.device))
        found = figures.batch_figures(outputs, truth, self.mixture.sizes.gate.scene_experts)
        return found | figures.prices(self.mixture.report)

    def get_extra_state(self) -> dict[str, Any]:
        """How far the run has come travels with a checkpoint, as plain values."""
        return {"progress": self.progress.to_dict(), "vouching": self.vouching}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Restores what `get_extra_state` gave. InputError if it is of another version."""
        with state_of_this_version():
            self.progress = Progress.from_dict(state["progress"])
            self.vouching = state["vouching"]

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *rest: Any) -> None:
        """As torch's. InputError if the checkpoint is of an earlier version of this package."""
        refuse_earlier(state_dict, prefix, "mixture.region.lowest")
        super()._load_from_state_dict(state_dict, prefix, *rest)
