"""A guided host: any nerfstudio model with its sampler swapped for a learned occupancy.

A composition: the host keeps its own class, outputs, losses and optimizers. It comes out of
`GuidedModelConfig.setup` as it would come out of its own config, but for where it samples, and for
its appearance codes. nerfstudio draws the code of each photograph from a unit normal, and shows
other views by the mean of the codes or by zeros. A field that learns from codes far apart has never
met the code of another view: on a drone survey Instant-NGP lost 3.6 dB, Nerfacto 4.8 dB
(docs/hosts.md). Ours begin alike, and are slow to part.
"""

from __future__ import annotations

import copy
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Literal, cast

import torch
import tyro
from nerfstudio.field_components.embedding import Embedding
from nerfstudio.models.base_model import Model, ModelConfig
from torch import Tensor, nn

from leco_plugin.hosts.classes import GuidedHost, Host, set_up_host
from leco_plugin.hosts.guide import Guide
from leco_plugin.hosts.guided_start import OWN_SAMPLER, OccupancyConfig, load_occupancy
from leco_plugin.hosts.seams import replace_module
from leco_plugin.log import say
from leco_plugin.models.compute.device import keep_freed_memory
from leco_plugin.models.field import APPEARANCE_SCALE
from leco_plugin.samplers.nerfacc_cpu import install_for
from leco_plugin.scenes.input_error import InputError
from leco_plugin.studio.checkpoints import allow_checkpoint_globals, evaluate_whole_checkpoints
from leco_plugin.studio.hash_encoding import speed_up_hash_encodings

Codes = Literal["small", "own"]
"""How a host's codes begin: at zero and scaled down, or as the host has them."""
OF_WHOM = ("nerfstudio.", "leco_plugin.")
"""Packages whose hosts need no line: docs/hosts.md speaks of their codes."""


class SmallCodes(Embedding):
    """nerfstudio's table of codes with zeros in it, whose answers are scaled by `APPEARANCE_SCALE`.

    The names in a state dict are those of nerfstudio's table.
    """

    def build_nn_modules(self) -> None:
        """Makes the table [in_dim, out_dim]."""
        zeros = torch.zeros(cast(int, self.in_dim), cast(int, self.out_dim))
        self.embedding = nn.Embedding.from_pretrained(zeros, freeze=False)

    def mean(self, dim: int = 0) -> Tensor:
        """The mean code, [out_dim]."""
        return APPEARANCE_SCALE * super().mean(dim)

    def forward(self, in_tensor: Tensor) -> Tensor:
        """Codes [..., out_dim] of photographs [...] int64."""
        return APPEARANCE_SCALE * super().forward(in_tensor)


def begin_with_small_codes(host: Model) -> None:
    """Has the codes of a host's photographs begin at zero, scaled down.

    Of a host that is neither nerfstudio's nor ours, the log says what was done; where its codes are
    of a kind that is not known here, it says that they stay.
    """
    count: Any = getattr(host, "num_train_data", None)
    known = {
        name: module
        for name, module in host.named_modules()
        if type(module) is Embedding and module.in_dim == count
    }
    for codes in known.values():
        weight = codes.embedding.weight
        replace_module(host, codes, SmallCodes(*weight.shape).to(weight))
    if type(host).__module__.startswith(OF_WHOM):
        return
    if known:
        say(
            f"{type(host).__name__}: appearance codes ({', '.join(known)}) begin at zero and are "
            f"scaled by {APPEARANCE_SCALE}; --codes own (--pipeline.model.codes own) leaves them"
        )
    if unknown := _drawn_at_random(host, count):
        say(
            f"{type(host).__name__}: {', '.join(unknown)} begins with a random code for each "
            "photograph, which can cost test views several dB; begin with zeros (docs/hosts.md)"
        )


def _drawn_at_random(host: Model, count: Any) -> list[str]:
    """Names of other tables with a row for each photograph that differ from row to row."""
    return [
        name
        for name, module in host.named_modules()
        if isinstance(module, nn.Embedding)
        and module.num_embeddings == count
        and count > 1
        and bool((module.weight != module.weight[0]).any())
    ]


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
        begin_with_small_codes(host)
    return host
