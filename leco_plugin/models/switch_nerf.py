"""`switch-nerf` as a nerfstudio model: a host whose own sampling an estimator can replace."""

from __future__ import annotations

from typing import Any

import torch
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.engine import callbacks
from nerfstudio.model_components.renderers import RGBRenderer
from nerfstudio.models.base_model import Model
from torch import Tensor, nn

from leco_plugin.log import summarize
from leco_plugin.models.compute.device import fast_precision, keep_freed_memory
from leco_plugin.models.figures import image_figures, leading_expert, over_background, with_alpha
from leco_plugin.models.losses import require_finite
from leco_plugin.models.region import Region, marching_rule
from leco_plugin.models.rendering import (
    Answers,
    Intervals,
    Rays,
    Shaded,
    backdrop_starts,
    mapped_middles,
    render,
    with_backdrop,
)
from leco_plugin.models.switch.field import (
    NEW_DENSITY,
    NearestOnTheGround,
    SwitchField,
    SwitchNerfModelConfig,
)
from leco_plugin.models.switch.rendering import coarse_and_fine, switch_losses, switch_statistics
from leco_plugin.occupancy import gate_precision
from leco_plugin.on_cpu import on_cpu
from leco_plugin.samplers.base import densities_of_samples
from leco_plugin.samplers.grid import OccupancyGridEstimator
from leco_plugin.scenes.bounds import SceneBounds
from leco_plugin.scenes.learning_data import LearningData
from leco_plugin.scenes.survey import places_of
from leco_plugin.space import Space
from leco_plugin.studio.checkpoints import prepare_checkpoints


def scene_grid(space: Space, aabb: Tensor, resolution: int, levels: int) -> OccupancyGridEstimator:
    """An empty grid, whose innermost box is what the space maps without contraction; it ends where
    the box [6] does in which rays are marched. A bounded scene needs one level."""
    low, high = aabb.view(2, 3)
    low = low.maximum(space.center - space.half_extent)
    high = high.minimum(space.center + space.half_extent)
    return OccupancyGridEstimator(torch.cat([low, high]), resolution, levels)


class SwitchNerfModel(Model):
    """A packed host with its own way of sampling beside.

    The seam is `occupancy_grid`: None is coarse and fine sampling, and anything with nerfacc's two
    verbs, `sampling` and `update_every_n_steps`, takes its place. `sample_with` sets it, on a new
    model or on one that has been trained; nothing else has to be known or changed. The estimator is
    a submodule like any other: it follows the model to its device, into evaluation and into the
    state dict, and is in no parameter group.
    """

    config: SwitchNerfModelConfig
    step: Tensor
    cone: Tensor
    occupancy_grid: nn.Module | None

    def populate_modules(self) -> None:
        """Builds the field, the sampler and the buffers that a checkpoint restores."""
        super().populate_modules()
        prepare_checkpoints()
        device = self.kwargs.get("device", "cpu")
        keep_freed_memory(device)
        self.precision = fast_precision(device)
        self.field = SwitchField(self.config.sizes.field, self.num_train_data)
        if (places := places_of(self.kwargs.get("metadata") or {})) is not None:
            self.field.color.places = places
        self.region = Region()
        self.register_buffer("step", torch.tensor(0.03))
        self.register_buffer("cone", torch.tensor(0.0))
        self.renderer_rgb = RGBRenderer(background_color="random")
        self.occupancy_grid = None
        if self.config.sampling == "occupancy-grid":
            self._sample_with_grid(levels=1)

    def sample_with(self, estimator: nn.Module | None) -> None:
        """Replaces the sampling by an estimator's; None is coarse and fine."""
        if estimator is not None:
            estimator.to(self.region.aabb.device).train(self.training)
        self.occupancy_grid = estimator

    def _sample_with_grid(self, levels: int) -> None:
        resolution = self.config.sizes.grid_resolution
        self.sample_with(scene_grid(self.region.space, self.region.aabb, resolution, levels))

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *rest: Any) -> None:
        """A grid has as many levels as it was trained with, which depend on the scene."""
        saved = state_dict.get(f"{prefix}occupancy_grid.aabbs")
        if isinstance(self.occupancy_grid, OccupancyGridEstimator) and saved is not None:
            self._sample_with_grid(len(saved))
        super()._load_from_state_dict(state_dict, prefix, *rest)

    def get_param_groups(self) -> dict[str, list[nn.Parameter]]:
        """`fields`: everything that is trained."""
        return {"fields": list(self.field.parameters())}

    def get_training_callbacks(
        self, training_callback_attributes: callbacks.TrainingCallbackAttributes
    ) -> list[callbacks.TrainingCallback]:
        """Finds the scene's bounds now, and returns what updates the estimator before each step."""
        assert training_callback_attributes.pipeline is not None
        asked = self.config.bounds, self.config.near, self.config.far
        if bool(self.region.known):
            self.region.refuse_others(*asked)
        else:
            data = LearningData(training_callback_attributes.pipeline.datamanager, *asked)
            self.set_bounds(data.survey.bounds, data.survey.median_length)
            self.region.note_backdrops(*data.covering_rays())
            summarize(data.survey.summary(), data.survey.lines())
        before = callbacks.TrainingCallbackLocation.BEFORE_TRAIN_ITERATION
        return [callbacks.TrainingCallback([before], self.update_estimator)]

    @torch.no_grad()
    def set_bounds(self, bounds: SceneBounds, median_length: float) -> None:
        """Fixes the space mapping, the marching rule (see `marching_rule`) and the grid's box."""
        self.region.set(bounds)
        candidates = self.config.sizes.candidates
        rule = marching_rule(bounds.kind, bounds.near, bounds.far, candidates, median_length)
        self.step.fill_(rule[0])
        self.cone.fill_(rule[1])
        if isinstance(self.field.gate, NearestOnTheGround):
            corners = self.region.space.map(self.region.aabb.view(2, 3)).clamp(-1.0, 1.0)
            self.field.gate.spread(corners[0, :2], corners[1, :2])
        if isinstance(self.occupancy_grid, OccupancyGridEstimator):
            self._sample_with_grid(1 if bounds.kind == "box" else self.config.grid_levels)

    def update_estimator(self, step: int) -> None:
        """Lets the estimator ask the field, as packed hosts do before each training step."""
        if self.occupancy_grid is not None:
            update: Any = self.occupancy_grid.update_every_n_steps
            update(
                step=step,
                occ_eval_fn=self.opacity_of_a_step,
                warmup_steps=self.config.sizes.grid_warmup_steps,
            )

    @torch.no_grad()
    def opacity_of_a_step(self, positions: Tensor) -> Tensor:
        """Density times the length of a step: scene positions [N, 3] to [N, 1].

        Steps that grow with distance are taken to be those at one half extent.
        """
        step = self.step.maximum(self.cone * self.region.space.half_extent)
        return self.density_fn(positions) * step

    def density_fn(self, positions: Tensor) -> Tensor:
        """Density per scene unit, without noise: scene positions [N, 3] to [N, 1]."""
        with gate_precision(self.device.type, self.precision):
            answers = self.field(self.region.space.map(positions).clamp(-1.0, 1.0))
        densities: Tensor = answers.sigmas[:, None] / self.region.space.half_extent
        return densities

    @property
    def average_init_density(self) -> float:
        """Density of a new field, per scene unit, under the name that nerfstudio's fields have."""
        return self.field.density_scale * NEW_DENSITY / float(self.region.space.half_extent)

    @average_init_density.setter
    def average_init_density(self, density: float) -> None:
        half_extent = float(self.region.space.half_extent)
        self.field.density_scale = density * half_extent / NEW_DENSITY

    def _ask(self, mapped: Tensor) -> Answers:
        """The field, with noise and limited places while training."""
        noise = self.config.sigma_noise if self.training else 0.0
        capacity = self.config.capacity_factor if self.training else None
        answers: Answers = self.field(mapped, noise, capacity)
        return answers

    def rays_of(self, bundle: RayBundle) -> Rays:
        """The bundle's rays, cut to the region and to a crop; see `Region.rays`."""
        length = self.step.maximum(self.region.far * self.cone)
        return self.region.of_bundle(bundle, self.training, length)

    def _shade(self, rays: Rays) -> tuple[Intervals, Shaded]:
        """Samples along rays in whichever way, shaded."""
        region = self.region
        step, cone_angle = (float(on_cpu(number)) for number in (self.step, self.cone))
        if self.occupancy_grid is not None:
            estimator: Any = self.occupancy_grid
            densities = densities_of_samples(self.density_fn, rays.origins, rays.directions)
            packed = estimator.sampling(
                rays.origins,
                rays.directions,
                sigma_fn=densities if self.training else None,
                t_min=rays.t_mins,
                t_max=rays.t_maxs,
                render_step_size=step,
                early_stop_eps=self.config.early_stop_eps,
                stratified=self.training,
                cone_angle=cone_angle,
            )
            intervals = with_backdrop(Intervals(*packed), rays, step, cone_angle)
            answers = self._ask(mapped_middles(region.space, rays, intervals))
        else:
            stops = backdrop_starts(rays, step, cone_angle).maximum(rays.t_mins)
            intervals, answers = coarse_and_fine(
                self._ask,
                region.space,
                rays,
                stops,
                (self.config.sizes.coarse, self.config.sizes.fine),
                growing=region.space.kind == "contraction",
                jittered=self.training,
            )
        given = answers, rays, intervals, region.space.half_extent
        shaded = render(self.field.color, *given, meets_backdrop=False)
        return intervals, shaded

    def get_outputs(self, ray_bundle: RayBundle) -> dict[str, Any]:  # type: ignore[override]
        """Pixels of rays, and what the losses need (`shaded`, `rays`).

        `samples_per_ray` counts the points at which the field was asked, as a float because
        nerfstudio cannot show integers. `expert`, in evaluation, is the number from 1 of the one
        with the greatest weight along the ray, 0 where it meets nothing.
        """
        rays = self.rays_of(ray_bundle)
        with gate_precision(self.device.type, self.precision):
            intervals, shaded = self._shade(rays)
        outputs: dict[str, Any] = {
            "rgb": over_background(shaded, rays),
            "depth": shaded.depth[:, None],
            "accumulation": shaded.accumulation[:, None],
            "samples_per_ray": shaded.packed_info[:, 1:].float(),
            "shaded": shaded,
            "rays": rays,
        }
        if not self.training:
            experts = self.config.sizes.field.experts
            leading = leading_expert(shaded, intervals.ray_indices, experts)
            outputs["expert"] = (leading + 1).float()
        return outputs

    get_rgba_image = staticmethod(with_alpha)
    get_image_metrics_and_images = image_figures

    def get_loss_dict(
        self, outputs: dict[str, Any], batch: dict[str, Tensor], metrics_dict: Any = None
    ) -> dict[str, Tensor]:
        """Colour loss and balanced gate loss. FloatingPointError if one is not finite: no step is
        taken."""
        image = batch["image"].to(self.device)
        truth = self.renderer_rgb.blend_background(image)
        losses = switch_losses(outputs["shaded"], truth, self.config.balance)
        require_finite(losses, self, outputs, image)
        return losses

    def get_metrics_dict(
        self, outputs: dict[str, Any], batch: dict[str, Tensor]
    ) -> dict[str, Tensor]:
        """PSNR of the batch, its number of samples, and the share of each expert."""
        truth = self.renderer_rgb.blend_background(batch["image"].to(self.device))
        return switch_statistics(outputs["shaded"], truth)
