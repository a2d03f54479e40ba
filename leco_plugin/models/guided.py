"""A guided host: any nerfstudio model with its sampler swapped for a learned occupancy.

A composition: the host keeps its own class, outputs, losses and optimizers. It comes out of
`GuidedModelConfig.setup` as it would come out of its own config, but for where it samples.
"""

from __future__ import annotations

import copy
import functools
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import torch
import tyro
from nerfstudio.engine.callbacks import (
    TrainingCallback,
    TrainingCallbackAttributes,
    TrainingCallbackLocation,
)
from nerfstudio.model_components.renderers import RGBRenderer
from nerfstudio.models.base_model import Model, ModelConfig

from leco_plugin.compat.checkpoints import allow_checkpoint_globals
from leco_plugin.compat.earlier_configs import GrowingConfig
from leco_plugin.compat.earlier_guides import read_earlier_guide
from leco_plugin.compat.evaluated_runs import evaluate_whole_checkpoints
from leco_plugin.compat.hash_encoding import speed_up_hash_encodings
from leco_plugin.compat.host_lpips import setup_with_lazy_lpips
from leco_plugin.compat.host_outputs import with_counts_as_floats
from leco_plugin.models.compute.precision import keep_freed_memory
from leco_plugin.models.failures import require_finite
from leco_plugin.models.hosts.appearance_codes import Codes, begin_with_small_codes
from leco_plugin.models.hosts.guide import Guide
from leco_plugin.models.hosts.guided_start import (
    OWN_SAMPLER,
    GuidedStart,
    OccupancyConfig,
    load_occupancy,
)
from leco_plugin.models.hosts.host_watch import HostWatch
from leco_plugin.models.hosts.opaque_start import set_first_density
from leco_plugin.models.hosts.seams import swap_sampler
from leco_plugin.samplers.nerfacc_cpu import install_for
from leco_plugin.scenes.input_error import InputError


@dataclass
class GuidedModelConfig(GrowingConfig, ModelConfig):
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

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Called by yaml: a run that was begun before there was a choice keeps its codes."""
        super().__setstate__({"codes": "own"} | state)


def set_up_guided(config: GuidedModelConfig, **arguments: Any) -> Model:
    """Builds the host, swaps its sampler, and returns the host.

    Args:
        config: host and occupancy.
        arguments: what nerfstudio gives a model (scene_box, num_train_data, metadata, device, ...).
    Raises:
        InputError: the host has no seam that is known, or there is no such sampler for it, or none
            with these options.
    """
    allow_checkpoint_globals()
    evaluate_whole_checkpoints()
    install_for(arguments.get("device"))
    if torch.device(arguments.get("device", "cpu")).type == "cpu":
        keep_freed_memory()
    host_config = copy.deepcopy(config.host)
    if config.eval_num_rays_per_chunk is not None:
        host_config.eval_num_rays_per_chunk = config.eval_num_rays_per_chunk
    if config.occupancy.sampler == OWN_SAMPLER:
        return _built(host_config, config.codes, arguments)
    guide = Guide(
        config.occupancy.sampler, config.occupancy.options, config.occupancy.front_to_back
    )
    if guide.needs_occupancy and config.occupancy.path is not None:
        with suppress(InputError):  # a checkpoint brings its own; without one, training says it
            guide.set_occupancy(load_occupancy(config.occupancy.path))
    host = _built(host_config, config.codes, arguments)
    host.leco_guide = guide  # by no name that the host may have given something of its own
    read_earlier_guide(host)
    swap_sampler(host, guide)
    guide.register_load_state_dict_post_hook(lambda guide, _: set_first_density(host, guide))
    _refuse_what_is_not_finite(host)
    _tell_of_crops(host, guide)
    _hide_unseen_backdrops(host, guide)
    _begin_with_occupancy(host, guide, config.occupancy)
    return host


def _built(host_config: ModelConfig, codes: Codes, arguments: dict[str, Any]) -> Model:
    """The host as nerfstudio builds it, without a network, fit for a CPU and for its commands."""
    host = with_counts_as_floats(setup_with_lazy_lpips(host_config, **arguments))
    speed_up_hash_encodings(host)
    if codes == "small":
        begin_with_small_codes(host)
    return host


def _refuse_what_is_not_finite(host: Model) -> None:
    """No step is taken with a loss that is not finite."""
    own_losses = host.get_loss_dict

    @functools.wraps(own_losses)
    def get_loss_dict(outputs: Any, batch: Any, *args: Any, **kwargs: Any) -> dict[str, Any]:
        losses = own_losses(outputs, batch, *args, **kwargs)
        if host.training and losses:
            require_finite(losses, host, outputs, batch.get("image", torch.zeros(())))
        return losses

    host.get_loss_dict = get_loss_dict  # type: ignore[method-assign]


def _tell_of_crops(host: Model, guide: Guide) -> None:
    """The guide learns whether rays come with limits of their own, before a collider sets them."""
    own_forward = host.forward

    @functools.wraps(own_forward)
    def forward(ray_bundle: Any) -> dict[str, Any]:
        guide.cropped = not host.training and getattr(ray_bundle, "nears", None) is not None
        try:
            return own_forward(ray_bundle)
        finally:
            guide.cropped = False

    host.forward = forward  # type: ignore[method-assign]


def _hide_unseen_backdrops(host: Model, guide: Guide) -> None:
    """A colour of a ray's last sample is no backdrop where training has seen none: it is black."""

    def behind(renderer: Any, args: Any, kwargs: Any) -> tuple[Any, Any] | None:
        asked = kwargs.get("background_color")
        asked = renderer.background_color if asked is None else asked
        rgb = kwargs["rgb"] if "rgb" in kwargs else args[0]
        unseen = guide.without_backdrop
        if unseen is None or not isinstance(asked, str) or asked != "last_sample":
            return None
        if len(unseen) != len(rgb):
            return None
        last = torch.nan_to_num(rgb[..., -1, :])
        return args, kwargs | {"background_color": last.masked_fill(unseen, 0.0)}

    for module in host.modules():
        if isinstance(module, RGBRenderer):
            module.register_forward_pre_hook(behind, with_kwargs=True)


def _begin_with_occupancy(host: Model, guide: Guide, config: OccupancyConfig) -> None:
    """Before the host's first step there is an occupancy, in its coordinates, and in its folder."""
    own_callbacks = host.get_training_callbacks

    @functools.wraps(own_callbacks)
    def get_training_callbacks(
        training_callback_attributes: TrainingCallbackAttributes,
    ) -> list[TrainingCallback]:
        attributes = training_callback_attributes  # by which name a pipeline may hand them over
        if not guide.needs_occupancy:
            return own_callbacks(attributes)
        start = GuidedStart(host, guide, config, attributes.pipeline, attributes.trainer)
        watch = HostWatch(
            host, guide, config.learning.calibration, attributes.pipeline, attributes.trainer
        )
        before = [TrainingCallbackLocation.BEFORE_TRAIN_ITERATION]
        after = [TrainingCallbackLocation.AFTER_TRAIN_ITERATION]
        return [
            TrainingCallback(before, start.before_step),
            *own_callbacks(attributes),
            TrainingCallback(before, watch.before_step),
            TrainingCallback(after, watch.after_step),
        ]

    host.get_training_callbacks = get_training_callbacks  # type: ignore[assignment, method-assign]
