"""A lesson says where a gate should keep and skip; a gate alone is taught by it, in seconds."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import softplus

from leco_plugin.learning.schedule import RATES
from leco_plugin.models.gate import Gate, GateConfig, occupancy_logit
from leco_plugin.models.losses import widen
from leco_plugin.models.objective import GateLossConfig
from leco_plugin.occupancy import Precision, gate_precision

BATCH = 1 << 14
LAST_RATE = 0.05
"""Of the learning rate, after a half cosine."""


class Lesson(NamedTuple):
    """How much each position speaks for being kept, and for being skipped."""

    mapped: Tensor
    """[M, 3] in [-1, 1]."""
    keep: Tensor
    """[M] weight of -log o(x)."""
    skip: Tensor
    """[M] weight of -log(1 - o(x))."""


def lesson_of(mapped: Tensor, weights: Tensor, of_rays: Tensor, losses: GateLossConfig) -> Lesson:
    """The targets of the contribution loss at samples along rays.

    Args:
        mapped: [M, 3] in [-1, 1], in the order of rays, then distance.
        weights: [M] rendering weights.
        of_rays: [M] int64, the ray of each.
        losses: w_0 and k of the loss.
    """
    wide = widen(weights, of_rays[1:] == of_rays[:-1])
    target = (wide / losses.weight_at_full).clamp(max=1.0)
    return Lesson(mapped, losses.emphasis * target, 1.0 - target)


def teach(
    config: GateConfig,
    lesson: Lesson,
    steps: int,
    precision: Precision,
    seed: int = 0,
    rate: float = 2.0 * RATES["gate"],
    on_progress: Callable[[float], None] | None = None,
) -> Gate:
    """A gate that was taught by a lesson, in the precision of its later queries.

    Minimises mean[-keep log o - skip log(1 - o)], the contribution loss with given targets.

    Args:
        steps: of Adam, on `BATCH` positions each.
        rate: of networks; tables learn at least as fast as those of a field.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        gate = Gate(config).to(lesson.mapped.device)
    tables = list(gate.encoding.parameters())
    known = {id(table) for table in tables}
    groups = [{"params": [p for p in gate.parameters() if id(p) not in known], "lr": rate}]
    if tables:
        groups.append({"params": tables, "lr": max(rate, RATES["encoding"])})
    optimizer = torch.optim.Adam(groups, eps=1e-15, fused=True)
    schedule = torch.optim.lr_scheduler.LambdaLR(
        optimizer,
        lambda step: LAST_RATE + (1 - LAST_RATE) * 0.5 * (1 + math.cos(math.pi * step / steps)),
    )
    generator = torch.Generator().manual_seed(seed)
    for step in range(steps):
        drawn = torch.randint(len(lesson.mapped), (BATCH,), generator=generator)
        mapped, keep, skip = (part[drawn.to(part.device)] for part in lesson)
        with gate_precision(mapped.device.type, precision):
            occupied = occupancy_logit(gate(mapped))
        value = (keep * softplus(-occupied) + skip * softplus(occupied)).mean()
        optimizer.zero_grad(set_to_none=True)
        value.backward()
        optimizer.step()
        schedule.step()
        if on_progress is not None:
            on_progress((step + 1) / steps)
    return gate.requires_grad_(False).eval()


@torch.no_grad()
def round_weights(gate: torch.nn.Module) -> None:
    """Rounds all numbers of a gate, or of a part of it, to bfloat16."""
    for parameter in gate.parameters():
        parameter.copy_(parameter.bfloat16().float())
