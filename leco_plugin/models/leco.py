"""`leco-occupancy` as a nerfstudio model: an HMoE that learns occupancy, then is guided by it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes
from nerfstudio.model_components.renderers import RGBRenderer
from nerfstudio.models.base_model import Model
from torch import Tensor, nn

from leco_plugin.compat.checkpoints import allow_checkpoint_globals
from leco_plugin.compat.evaluated_runs import evaluate_whole_checkpoints
from leco_plugin.models.compute.precision import fast_precision, keep_freed_memory
from leco_plugin.models.failures import require_finite
from leco_plugin.models.field import HMoEField
from leco_plugin.models.front_to_back import is_no_slower, shade_front_to_back
from leco_plugin.models.gate import Gate
from leco_plugin.models.image_figures import image_figures
from leco_plugin.models.learning.healing import annealed, form_of, is_dense
from leco_plugin.models.learning.progress import Progress
from leco_plugin.models.learning.statistics import (
    KEPT_ABOVE,
    gate_statistics,
    kept_fraction,
    prices,
)
from leco_plugin.models.leco_config import LecoModelConfig
from leco_plugin.models.objective import field_losses, gate_losses
from leco_plugin.models.ray_pictures import before_the_backdrop, gate_pictures, with_alpha
from leco_plugin.models.rendering import (
    Intervals,
    Rays,
    Routing,
    Shaded,
    mapped_middles,
    shade,
    with_backdrop,
)
from leco_plugin.models.scene_rays import (
    SeenBackdrops,
    cut_to_bounds,
    marching_rule,
    over_background,
    with_ends_for_all,
    within_crop,
)
from leco_plugin.models.sizing.scene_sizes import complete
from leco_plugin.models.sizing.sizes import Sizes
from leco_plugin.models.sizing.stored_sizes import SIZES, stored_in, to_store
from leco_plugin.occupancy import Occupancy, gate_precision
from leco_plugin.samplers import marching
from leco_plugin.samplers.estimator import LearnedOccupancyEstimator
from leco_plugin.scenes.bounds import SceneBounds, with_range
from leco_plugin.scenes.pixels.known_distances import DISTANCE
from leco_plugin.space import Space


class LecoModel(Model):
    """HMoE, gate and frozen occupancy behind nerfstudio's model interface."""

    config: LecoModelConfig
    frozen: Tensor
    threshold: Tensor
    bounds_known: Tensor
    march_range: Tensor
    aabb: Tensor

    def populate_modules(self) -> None:
        """Builds gate, field and the buffers that a checkpoint restores."""
        super().populate_modules()
        allow_checkpoint_globals()
        evaluate_whole_checkpoints()
        device = self.kwargs.get("device", "cpu")
        if torch.device(device).type == "cpu":
            keep_freed_memory()
        self.precision = self.config.precision or fast_precision(device)
        metadata = self.kwargs.get("metadata") or {}
        self._build(
            complete(self.config.sizes, self.config.bounds, metadata, self.num_train_data, device)
        )
        self.space = Space()
        # buffers, because nerfstudio tells a model its step before it restores its state
        self.register_buffer("frozen", torch.tensor(False))
        self.register_buffer("threshold", torch.tensor(0.0))
        self.register_buffer("bounds_known", torch.tensor(False))
        # near, far, step at `candidates`, step at `learn_candidates`, cone angles of both
        self.register_buffer("march_range", torch.tensor([0.05, 4.0, 0.03, 0.06, 0.0, 0.0]))
        self.register_buffer("aabb", torch.tensor([-1.0] * 3 + [1.0] * 3))
        self.backdrops = SeenBackdrops()
        self.renderer_rgb = RGBRenderer(background_color="random")
        self.ramped = 0.0
        self.step = 0
        # held in a tuple: the estimator shares the gate, which must not be registered twice
        self._estimator: tuple[LearnedOccupancyEstimator, ...] = ()
        self.report: dict[str, Any] = {}
        self.progress = Progress()

    def _build(self, sizes: Sizes) -> None:
        """Gate and field; from here on the config says their sizes."""
        if sizes != self.config.sizes:  # others may share the config, and have other scenes
            self.config = replace(self.config, sizes=sizes)
        self.gate = Gate(sizes.gate)
        self.field = HMoEField(sizes.field, self.num_train_data)

    @property
    def routing(self) -> Routing:
        """Which expert each point is sent to."""
        losses = self.config.gate_loss
        logit = form_of(losses, self.progress) == "logit"
        return Routing(losses.empty_below if logit else None, self.config.homogeneous)

    def get_param_groups(self) -> dict[str, list[nn.Parameter]]:
        """`encoding` (tables of both, if any), and what else there is in `field` and `gate`."""
        tables = [*self.field.encoding.parameters(), *self.gate.encoding.parameters()]
        known = {id(parameter) for parameter in tables}
        groups = {
            name: [p for p in module.parameters() if id(p) not in known]
            for name, module in (("field", self.field), ("gate", self.gate))
        }
        # a frequency encoding has no parameters, and an optimizer needs one
        return groups | {"encoding": tables or [self.device_indicator_param]}

    def get_training_callbacks(
        self, training_callback_attributes: TrainingCallbackAttributes
    ) -> list[TrainingCallback]:
        """Finds the scene's bounds now, and returns what runs around each step."""
        from leco_plugin.models.learning.lifecycle import Lifecycle

        return Lifecycle(self, training_callback_attributes).callbacks()

    @torch.no_grad()
    def set_bounds(self, bounds: SceneBounds, median_length: float) -> None:
        """Fixes the space mapping and the marching rule of the scene.

        Args:
            bounds: of the scene.
            median_length: median length of rays inside the bounds, scene units.
        Raises:
            InputError: the configured range is empty or begins at the camera.
        """
        bounds = with_range(bounds, self.config.near, self.config.far)
        near, far = bounds.near, bounds.far
        self.space.set(bounds.kind, bounds.center, bounds.half_extent)
        self.aabb.copy_(bounds.aabb)
        sizes, kind = self.config.sizes, bounds.kind
        step, cone = marching_rule(kind, near, far, sizes.candidates, median_length)
        learning = marching_rule(kind, near, far, sizes.learn_candidates, median_length)
        self.march_range.copy_(torch.tensor([near, far, step, learning[0], cone, learning[1]]))
        self.bounds_known.fill_(True)

    def rays_of(self, bundle: RayBundle, with_images: bool | None = None) -> Rays:
        """The bundle's rays, cut to the scene's bounds and to a crop.

        A ray that misses the bounds keeps a backdrop at the far end, as its sky. Rays of no
        training image have a backdrop only where training has seen one.

        Args:
            with_images: whether rays show the appearance of their training image, or the mean of
                all; None is in training only.
        """
        near, far, *steps = self.march_range[:4]
        known = self.training if with_images is None else with_images
        cut = cut_to_bounds(bundle, self.aabb, near, far, with_images=known)
        if not known:
            cut = cut._replace(cut_off=~self.backdrops(cut, self.space, self.aabb))
        rays = with_ends_for_all(cut, far, torch.minimum(*steps))
        return within_crop(rays, bundle.nears, bundle.fars)

    def estimator(self) -> LearnedOccupancyEstimator:
        """Samples where the frozen gate says so; built on first use, also after a checkpoint.

        No property: nerfstudio's viewer reads all that it finds, before the first step.
        """
        if not self._estimator:
            self._estimator = (LearnedOccupancyEstimator(self.occupancy()).to(self.device),)
        return self._estimator[0]

    def get_extra_state(self) -> dict[str, Any]:
        """Calibration report and learning progress travel with a checkpoint, as plain values."""
        return {
            "report": self.report,
            "progress": self.progress.to_dict(),
            "precision": self.precision,
            SIZES: to_store(self.config.sizes, self.num_train_data),
        }

    def _load_from_state_dict(
        self, state_dict: dict[str, Any], prefix: str, *arguments: Any
    ) -> None:
        """Gate and field are first built as they were stored, whatever the scene is now."""
        now = self.config.sizes, self.num_train_data
        stored = stored_in(state_dict.get(f"{prefix}_extra_state"), now)
        if stored != now:
            sizes, self.num_train_data = stored
            self._build(sizes)
            self.to(self.device)
            self.forget_estimator()
        super()._load_from_state_dict(state_dict, prefix, *arguments)

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Restores what `get_extra_state` gave."""
        self.report = dict(state.get("report", {}))
        self.progress = Progress.from_dict(state.get("progress", {}))
        # a gate decides otherwise in another precision than the one it was taught in
        self.precision = state.get("precision", self.precision)
        self.gate.requires_grad_(not bool(self.frozen))
        self.forget_estimator()

    def reopen(self) -> None:
        """Has a frozen gate learn again."""
        self.frozen.fill_(False)
        self.threshold.fill_(0.0)
        self.report = {}  # of the gate as it was
        self.gate.requires_grad_(True)
        self.forget_estimator()

    def forget_estimator(self) -> None:
        """Has it built anew when it is next asked, for another gate or another threshold."""
        self._estimator = ()

    def occupancy(self) -> Occupancy:
        """The gate as an `Occupancy`; it shares this model's parameters."""
        return Occupancy(
            self.gate,
            self.space,
            float(self.threshold),
            self.precision,
            self.report,
            self.aabb,
        ).to(self.device)

    def step_and_angle(self, learning: bool) -> tuple[float, float]:
        """Step, scene units, and cone angle of the march."""
        _, _, step, learn_step, cone, learn_cone = self.march_range.tolist()
        return (learn_step, learn_cone) if learning else (step, cone)

    def intervals_of(self, rays: Rays, guided: bool, learning: bool) -> Intervals:
        """Candidates along the rays; guided, only those that the occupancy keeps."""
        size, angle = self.step_and_angle(learning)
        along, rule = marching.Rays(*rays[:4]), marching.March(size, angle)
        if self.training:
            along = along.shifted(torch.rand_like(rays.t_mins) * size)
        samples = self.estimator().march(along, rule) if guided else marching.march(along, rule)
        intervals = Intervals(*samples)
        # a homogeneous gate is taught nothing about emptiness
        followed = self.ramped > 0.0 and not is_dense(self.progress, self.step)
        if learning and followed and not self.config.homogeneous:
            intervals = self._likely(intervals, rays)
        return with_backdrop(intervals, rays, size, angle)

    @torch.no_grad()
    def _likely(self, intervals: Intervals, rays: Rays) -> Intervals:
        """Leaves out what the gate, as far as it has learned, calls empty; some rays keep all."""
        mapped = mapped_middles(self.space, rays, intervals)
        with gate_precision(self.device.type, self.precision):
            likely = self.gate.occupancy(mapped) >= self.config.likely_above
        dense = torch.rand_like(rays.t_mins) < self.config.look_everywhere
        kept = (likely | dense.index_select(0, intervals.ray_indices)).nonzero()[:, 0]
        share, progress = len(kept) / max(len(likely), 1), self.progress
        progress.learning_kept = 0.9 * progress.learning_kept + 0.1 * share
        return Intervals(*(part.index_select(0, kept) for part in intervals))

    guided_kept = 1.0
    """Samples a ray that the frozen gate kept of the last batch, backdrops left out."""

    def shade(self, rays: Rays, intervals: Intervals) -> Shaded:
        """Renders intervals in this device's fastest precision."""
        with gate_precision(self.device.type, self.precision):
            return shade(
                self.field,
                self.gate,
                self.space,
                rays,
                intervals,
                self.routing,
                freeze_gate=bool(self.frozen),
            )

    def shade_what_is_seen(self, rays: Rays, intervals: Intervals) -> tuple[Shaded, Intervals]:
        """As `shade`, without gradients and without what lies behind opaque surfaces."""
        with gate_precision(self.device.type, self.precision):
            return shade_front_to_back(
                self.field, self.gate, self.space, rays, intervals, self.routing
            )

    def get_outputs(self, ray_bundle: RayBundle) -> dict[str, Any]:  # type: ignore[override]
        """Pixels of rays; in training also what losses and log need: `shaded`, `intervals`, `rays`,
        and `kept_rule`, the last three arguments of `kept_fraction`.

        In training accumulation and depth are those that losses see, with the backdrop; in
        evaluation the backdrop is nothing met.
        """
        rays = self.rays_of(ray_bundle)
        frozen, threshold = bool(self.frozen), float(self.threshold)
        guided = frozen and threshold > 0.0  # at 0 nothing is skipped
        learning = self.training and self.is_learning()
        intervals = self.intervals_of(rays, guided, learning)
        if self.training:
            kept = len(intervals.t_starts) / max(len(rays.origins), 1) - 1.0
            self.guided_kept = kept if guided else 1.0
        from_the_front = self.config.front_to_back
        if from_the_front is None:
            from_the_front = is_no_slower(len(rays.origins), guided, self.device)
        if from_the_front and not self.training:
            shaded, intervals = self.shade_what_is_seen(rays, intervals)
        else:
            shaded = self.shade(rays, intervals)
        if self.training:
            above = threshold if frozen else max(KEPT_ABOVE, self.config.likely_above)
            return {
                "rgb": shaded.rgb,
                "depth": shaded.depth[:, None],
                "accumulation": shaded.accumulation[:, None],
                "shaded": shaded,
                "intervals": intervals,
                "rays": rays,
                "kept_rule": (above, *self.step_and_angle(learning)),
            }
        met, shown = before_the_backdrop(shaded, intervals, rays)
        colors = over_background(shaded, rays)
        return {"rgb": colors, **shown, **gate_pictures(met, intervals.ray_indices)}

    def get_rgba_image(self, outputs: dict[str, Tensor], output_name: str = "rgb") -> Tensor:
        """Colours with what was met before the backdrop as their alpha, [..., 4]."""
        return with_alpha(outputs, output_name)

    def is_learning(self) -> bool:
        """Whether the coarse candidates of the first phase are still used."""
        return self.ramped < 1.0 or not (bool(self.frozen) or self.learned)

    learned = False
    """Whether the first phase is over although nothing was frozen (`schedule.freeze` off)."""

    def get_loss_dict(
        self, outputs: dict[str, Any], batch: dict[str, Tensor], metrics_dict: Any = None
    ) -> dict[str, Tensor]:
        """Colour loss, distortion loss, and before the gate is frozen what teaches it.

        Raises:
            ValueError: the batch holds no rays.
            FloatingPointError: a loss is not finite; the step was not taken.
        """
        shaded: Shaded = outputs["shaded"]
        image = batch["image"].to(self.device)
        if len(image) == 0:
            raise ValueError("a training batch holds no rays: are all pixels masked?")
        truth = self.renderer_rgb.blend_background(image)
        known = batch.get(DISTANCE)
        losses = field_losses(
            self.config,
            shaded,
            outputs["intervals"],
            outputs["rays"],
            truth,
            image[:, 3] if image.shape[-1] == 4 else None,
            None if known is None else known.to(self.device),
            span=self.march_range[:2],
            unbounded=self.space.unbounded,
            learning=self.is_learning(),
            ramped=self.ramped,
        )
        if not bool(self.frozen):
            losses |= gate_losses(
                annealed(self.config.gate_loss, self.progress, self.step),
                shaded,
                outputs["intervals"],
                outputs["rays"],
                homogeneous=self.config.homogeneous,
                ramped=self.ramped,
                half_extent=self.space.half_extent,
            )
        require_finite(losses, self, outputs, image)
        return losses

    @torch.no_grad()
    def get_metrics_dict(
        self, outputs: dict[str, Any], batch: dict[str, Tensor]
    ) -> dict[str, Tensor]:
        """PSNR of the batch; of the gate: kept fraction, share and density per expert; once it is
        frozen, what skipping costs."""
        truth = self.renderer_rgb.blend_background(batch["image"].to(self.device))
        error = torch.nn.functional.mse_loss(outputs["rgb"], truth)
        metrics = {"psnr": -10.0 * torch.log10(error.clamp(min=1e-12))}
        if "shaded" in outputs:
            batch_of = outputs["shaded"], outputs["intervals"], outputs["rays"]
            metrics["kept_fraction"] = kept_fraction(*batch_of, *outputs["kept_rule"])
            metrics |= gate_statistics(outputs["shaded"], self.config.sizes.gate.scene_experts)
        return metrics | prices(self.report)

    def get_image_metrics_and_images(
        self, outputs: dict[str, Tensor], batch: dict[str, Tensor]
    ) -> tuple[dict[str, float], dict[str, Tensor]]:
        """Figures of one image, and pictures for the log."""
        truth = self.renderer_rgb.blend_background(batch["image"].to(outputs["rgb"].device))
        return image_figures(outputs, truth)
