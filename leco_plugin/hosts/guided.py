"""A guided host: any nerfstudio model with its sampler swapped for a learned occupancy.

A subclass is made for each host, and keeps its name: what is changed of it stands here. A copy of a
host is then a host of its own. It keeps its outputs, losses and optimizers, and comes out of
`GuidedModelConfig.setup` as it would come out of its own config, but for where it samples, and for
its appearance codes.
"""

from __future__ import annotations

import copy
import functools
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, TypeVar

import torch
import tyro
from nerfstudio.engine.callbacks import (
    TrainingCallback,
    TrainingCallbackAttributes,
    TrainingCallbackLocation,
)
from nerfstudio.model_components.renderers import RGBRenderer
from nerfstudio.models.base_model import Model, ModelConfig
from torch import Tensor, nn

from leco_plugin.hosts.along import Along
from leco_plugin.hosts.appearance import Codes, begin_with_small_codes, show_from
from leco_plugin.hosts.guide import Guide
from leco_plugin.hosts.guided_start import OWN_SAMPLER, GuidedStart, OccupancyConfig, load_occupancy
from leco_plugin.hosts.host_watch import HostWatch, set_first_density
from leco_plugin.hosts.seams import swap_sampler
from leco_plugin.models.compute.device import keep_freed_memory
from leco_plugin.models.losses import require_finite
from leco_plugin.samplers.nerfacc_cpu import install_for
from leco_plugin.scenes.input_error import InputError
from leco_plugin.scenes.pixels.known_distances import refuse_odd_batches
from leco_plugin.scenes.survey import places_of
from leco_plugin.studio.checkpoints import prepare_checkpoints
from leco_plugin.studio.hash_encoding import speed_up_hash_encodings
from leco_plugin.studio.host_models import lazy_lpips
from leco_plugin.studio.occupancy_view import Drawn, DrawnInViewer, ModelAfter, OccupancyView
from leco_plugin.studio.run_folder import run_of


class Host(ModelAfter):
    """Stands before any nerfstudio model among the bases of a class. Its images can be drawn and
    scored without a network."""

    def forward(self, ray_bundle: Any, *args: Any, **kwargs: Any) -> dict[str, Any]:
        """As the model's; its codes are those of the photographs near the view."""
        show_from(self, None if self.training else ray_bundle.origins)
        outputs: dict[str, Any] = super().forward(ray_bundle, *args, **kwargs)
        return outputs

    def get_outputs_for_camera_ray_bundle(self, *args: Any, **kwargs: Any) -> dict[str, Tensor]:
        """Images whose counts are floats: ns-render and the viewer end with an exception at
        integers, such as the samples per ray of nerfstudio's own `instant-ngp`."""
        images = super().get_outputs_for_camera_ray_bundle(*args, **kwargs)
        return {
            name: image if image.is_floating_point() or image.dtype == torch.bool else image.float()
            for name, image in images.items()
        }

    def get_image_metrics_and_images(self, *args: Any, **kwargs: Any) -> Any:
        """Without an LPIPS that could not be computed: ns-eval would write its NaN, no JSON."""
        metrics, images = super().get_image_metrics_and_images(*args, **kwargs)  # type: ignore[safe-super]
        kept = {
            name: value
            for name, value in metrics.items()
            if "lpips" not in name or bool(torch.isfinite(torch.as_tensor(value)))
        }
        return kept, images


class GuidedHost(DrawnInViewer, Host):
    """Stands before a model whose sampling is guided.

    Attributes:
        leco_guide: by no name that a host may have given something of its own.
        leco_occupancy: where the guide gets its occupancy.
    """

    leco_guide: Guide
    leco_occupancy: OccupancyConfig

    def begin_guided(self, guide: Guide, config: OccupancyConfig) -> None:
        """Puts the guide where the host had its own sampling. InputError if the host has no seam
        that is known, or the sampler does not fit it."""
        self.leco_guide, self.leco_occupancy = guide, config
        if guide.needs_occupancy:
            self.leco_view = OccupancyView()
        swap_sampler(self, guide)
        self.register_load_state_dict_post_hook(
            lambda host, _: set_first_density(host, host.leco_guide)
        )
        for module in self.modules():
            if isinstance(module, RGBRenderer):
                hide = functools.partial(hide_unseen_backdrop, guide)
                module.register_forward_pre_hook(hide, with_kwargs=True)

    def leco_drawn(self) -> Drawn | None:
        """See `DrawnInViewer`."""
        guide = self.leco_guide
        return None if guide.occupancy is None else Drawn(guide.followed(), guide.frame)

    def forward(self, ray_bundle: Any, *args: Any, **kwargs: Any) -> dict[str, Any]:
        """As the host's. The guide learns whether rays come with limits of their own, before a
        collider sets them."""
        guide = self.leco_guide
        guide.cropped = not self.training and getattr(ray_bundle, "nears", None) is not None
        try:
            outputs: dict[str, Any] = super().forward(ray_bundle, *args, **kwargs)
            return outputs
        finally:
            guide.cropped = False

    def get_loss_dict(self, outputs: Any, batch: Any, *args: Any, **kwargs: Any) -> dict[str, Any]:
        """As the host's, without losses that teach nothing, such as of proposal networks that are
        gone. FloatingPointError if a loss is not finite; no step is taken with it."""
        losses = super().get_loss_dict(outputs, batch, *args, **kwargs)  # type: ignore[safe-super]
        if not self.training:
            return losses
        if self.leco_guide.without_proposals:
            losses = {
                name: loss for name, loss in losses.items() if torch.as_tensor(loss).requires_grad
            }
        if losses:
            require_finite(losses, self, outputs, batch.get("image", torch.zeros(())))
        return losses

    def get_param_groups(self) -> dict[str, list[nn.Parameter]]:
        """As the host's, without the gate, which a run that was given a file would have more than
        the same run resumed without; an optimizer takes no empty group."""
        groups = super().get_param_groups()  # type: ignore[safe-super]
        frozen = {id(parameter) for parameter in self.leco_guide.parameters()}
        trained = {
            name: [parameter for parameter in group if id(parameter) not in frozen]
            for name, group in groups.items()
        }
        return {name: group for name, group in trained.items() if group}

    def get_training_callbacks(
        self, training_callback_attributes: TrainingCallbackAttributes
    ) -> list[TrainingCallback]:
        """As the host's. Before its first step there is an occupancy, in its coordinates and in its
        folder; what skipping costs is watched after each. InputError for batches that cannot be
        drawn."""
        attributes, guide = training_callback_attributes, self.leco_guide
        refuse_odd_batches(getattr(attributes.pipeline, "datamanager", None))
        if not guide.needs_occupancy:
            return super().get_training_callbacks(attributes)
        config, around = self.leco_occupancy, (attributes.pipeline, run_of(attributes.trainer))
        along = Along(self, guide, config.learning, *around) if config.learned == "along" else None
        start = GuidedStart(self, guide, config, *around, along)
        watch = HostWatch(self, guide, config.learning.calibration, *around)
        before = [TrainingCallbackLocation.BEFORE_TRAIN_ITERATION]
        after = [TrainingCallbackLocation.AFTER_TRAIN_ITERATION]
        return [
            TrainingCallback(before, start.before_step),
            *super().get_training_callbacks(attributes),
            TrainingCallback(before, watch.before_step),
            TrainingCallback(after, watch.after_step),
            *([] if along is None else [TrainingCallback(after, along.after_step)]),
        ]


def hide_unseen_backdrop(
    guide: Guide, renderer: Any, args: Any, kwargs: Any
) -> tuple[Any, Any] | None:
    """Hook of a renderer: the colour of a ray's last sample is no backdrop where training has seen
    none; it is black there."""
    asked = kwargs.get("background_color")
    asked = renderer.background_color if asked is None else asked
    rgb = kwargs["rgb"] if "rgb" in kwargs else args[0]
    unseen = guide.without_backdrop
    shows_last = isinstance(asked, str) and asked == "last_sample"
    if unseen is None or not shows_last or len(unseen) != len(rgb):
        return None
    last = torch.nan_to_num(rgb[..., -1, :])
    return args, kwargs | {"background_color": last.masked_fill(unseen, 0.0)}


T = TypeVar("T", bound=Host)


def set_up_host(config: ModelConfig, kind: type[T], **arguments: Any) -> T:
    """A host as its config builds it, as a subclass of its own kind, without a network. InputError
    if the config builds no nerfstudio model."""
    target = config._target
    if not (isinstance(target, type) and issubclass(target, Model)):
        raise InputError(f"{type(config).__name__} builds no nerfstudio model that could be guided")
    made = type(target.__name__, (kind, target), {"__module__": target.__module__})
    with lazy_lpips():
        host: T = made(config, **arguments)
    return host


@dataclass
class GuidedModelConfig(ModelConfig):
    """A host with its sampler swapped"""

    _target: Any = field(default_factory=lambda: set_up_guided)
    """what builds the host"""
    host: ModelConfig = field(default_factory=ModelConfig)
    """The host, as its own method has it."""
    occupancy: OccupancyConfig = field(default_factory=OccupancyConfig)
    """What guides it."""
    codes: Codes = "small"
    """Codes of the host for the light of each photograph. small: they begin at zero and are scaled
    by 0.1, as those of leco-occupancy. own: as the host has them; nerfstudio draws them from a unit
    normal, which can cost test views several dB."""
    eval_num_rays_per_chunk: int | None = None  # type: ignore[assignment]
    """Rays rendered at a time; None is the host's own."""
    # every model config has these, and of a guided one the host's own count: they are no options
    enable_collider: tyro.conf.Suppress[bool] = True
    collider_params: tyro.conf.Suppress[dict[str, float] | None] = None
    loss_coefficients: tyro.conf.Suppress[dict[str, float]] = field(default_factory=dict)
    prompt: tyro.conf.Suppress[str | None] = None


def set_up_guided(config: GuidedModelConfig, **arguments: Any) -> Model:
    """Builds the host of what nerfstudio gives a model, swaps its sampler, and returns the host.
    InputError if it has no seam that is known, or there is no such sampler for it, or none with
    these options."""
    prepare_checkpoints()
    install_for(arguments.get("device"))
    keep_freed_memory(arguments.get("device", "cpu"))
    host_config, occupancy = copy.deepcopy(config.host), config.occupancy
    if config.eval_num_rays_per_chunk is not None:
        host_config.eval_num_rays_per_chunk = config.eval_num_rays_per_chunk
    if occupancy.sampler == OWN_SAMPLER:
        host = set_up_host(host_config, Host, **arguments)  # type: ignore[type-abstract]
        return _made_fit(host, config.codes)
    guide = Guide(occupancy.sampler, occupancy.options)
    if guide.needs_occupancy and occupancy.path is not None:
        with suppress(InputError):  # a checkpoint brings its own; without one, training says it
            guide.set_occupancy(load_occupancy(occupancy.path))
    guided = set_up_host(host_config, GuidedHost, **arguments)  # type: ignore[type-abstract]
    _made_fit(guided, config.codes)
    guided.begin_guided(guide, occupancy)
    return guided


def _made_fit(host: Host, codes: Codes) -> Host:
    """The host, fit for a CPU, with codes as wanted."""
    speed_up_hash_encodings(host)
    if codes == "small":
        begin_with_small_codes(host, places_of(getattr(host, "kwargs", {}).get("metadata") or {}))
    return host
