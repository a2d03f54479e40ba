"""Appearance codes of a host: they begin alike, and other views have those of photographs nearby.

nerfstudio draws the code of each photograph from a unit normal, and shows other views by the mean
of the codes or by zeros. A field that learns from codes far apart has never met the code of another
view: on a drone survey Instant-NGP lost 3.6 dB, Nerfacto 4.8 dB (docs/hosts.md).
"""

from __future__ import annotations

from typing import Any, Literal, cast

import torch
from nerfstudio.field_components.embedding import Embedding
from nerfstudio.models.base_model import Model
from torch import Tensor, nn

from leco_plugin.hosts.seams import replace_module
from leco_plugin.log import say
from leco_plugin.models.field import APPEARANCE_SCALE, codes_nearby, viewpoints

Codes = Literal["small", "own"]
"""How a host's codes begin: at zero and scaled down, or as the host has them."""
AVERAGE = "use_average_appearance_embedding"
"""nerfstudio's name for: other views have the mean code, and not zeros."""
OF_WHOM = ("nerfstudio.", "leco_plugin.")
"""Packages whose hosts need no line: docs/hosts.md speaks of their codes."""


class SmallCodes(Embedding):
    """nerfstudio's table of codes with zeros in it, whose answers are scaled by `APPEARANCE_SCALE`.

    The names in a state dict are those of nerfstudio's table.

    Attributes:
        places: [in_dim, 3] where the photographs were taken; empty where that is unknown.
        origin: [1, 3] of the view that is shown; None while there is no single one.
    """

    places: Tensor
    origin: Tensor | None = None

    def build_nn_modules(self) -> None:
        """Makes the table [in_dim, out_dim]."""
        zeros = torch.zeros(cast(int, self.in_dim), cast(int, self.out_dim))
        self.embedding = nn.Embedding.from_pretrained(zeros, freeze=False)
        self.register_buffer("places", torch.empty(0, 3), persistent=False)

    def mean(self, dim: int = 0) -> Tensor:
        """The code of the view that is shown, from the photographs nearby, [out_dim]; else the mean
        of all."""
        codes = self.embedding.weight
        if self.origin is None or len(self.places) != len(codes):
            return APPEARANCE_SCALE * super().mean(dim)
        return APPEARANCE_SCALE * codes_nearby(codes, self.places, self.origin)[0]

    def forward(self, in_tensor: Tensor) -> Tensor:
        """Codes [..., out_dim] of photographs [...] int64."""
        return APPEARANCE_SCALE * super().forward(in_tensor)


def begin_with_small_codes(host: Model, places: Tensor | None = None) -> None:
    """Has the codes of a host's photographs begin at zero, scaled down, and other views take those
    of the photographs nearby.

    Of a host that is neither nerfstudio's nor ours, the log says what was done, or that codes of a
    kind that is not known here stay.
    """
    count: Any = getattr(host, "num_train_data", None)
    known = {
        name: module
        for name, module in host.named_modules()
        if type(module) is Embedding and module.in_dim == count
    }
    for codes in known.values():
        weight = codes.embedding.weight
        small = SmallCodes(*weight.shape).to(weight)
        if places is not None:
            small.places = places.to(weight)
        replace_module(host, codes, small)
    for module in host.modules() if known else ():
        if hasattr(module, AVERAGE) and not hasattr(host.config, AVERAGE):
            setattr(module, AVERAGE, True)  # nobody chose zeros for other views
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


def show_from(host: nn.Module, origins: Tensor | None) -> None:
    """Tells the codes of a host from where rays [..., 3] of a view begin; None in training, where
    each ray has a photograph."""
    views = None if origins is None else viewpoints(origins.reshape(-1, 3))
    for codes in host.modules():
        if isinstance(codes, SmallCodes):
            codes.origin = views if views is not None and len(views) == 1 else None
