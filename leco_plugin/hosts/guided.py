"""A guided host: any nerfstudio model with its sampler swapped for a learned occupancy.

A composition: the host keeps its own class, outputs, losses and optimizers. It comes out of
`GuidedModelConfig.setup` as it would come out of its own config, but for where it samples, and for
its appearance codes.
"""

from __future__ import annotations

import copy
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import tyro
from nerfstudio.models.base_model import Model, ModelConfig

from leco_plugin.hosts.appearance import Codes, begin_with_small_codes
from leco_plugin.hosts.classes import GuidedHost, Host, set_up_host
from leco_plugin.hosts.guide import Guide
from leco_plugin.hosts.guided_start import OWN_SAMPLER, OccupancyConfig, load_occupancy
from leco_plugin.models.compute.device import keep_freed_memory
from leco_plugin.samplers.nerfacc_cpu import install_for
from leco_plugin.scenes.input_error import InputError
from leco_plugin.scenes.survey import places_of
from leco_plugin.studio.checkpoints import prepare_checkpoints
from leco_plugin.studio.hash_encoding import speed_up_hash_encodings


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
