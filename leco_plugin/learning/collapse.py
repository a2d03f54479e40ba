"""The rule for a collapsed gate, and what it makes of one training step.

A gate that looks collapsed for `SUSPECTED_STEPS` steps, or at the look that ends the first phase,
is healed, `MOST_RECOVERIES` times at most:

- Its last layer is reset. Learning goes on for half as long again. At first samples are dense and
  the gate's losses ramp up from zero. Then the loss that led to the collapse is `EASED` times
  weaker.
- If one scene expert took all points, they are redistributed. The balance loss counts `EASED` times
  as much, and at least a quarter of the phase is left to learn.
- If a gate in logit form collapses again, gate and field restart at `EASED` times smaller learning
  rates.
- If a gate in the paper's form collapses again, or if hardly anything can be skipped by it, it is
  taught in logit form, unless `fall_back` is off.

A run with fewer than `FEWEST_STEPS` steps left heals nothing: calibration makes any gate safe.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal, NamedTuple

import torch
from torch import Tensor, nn

from leco_plugin.learning.run import Progress
from leco_plugin.learning.schedule import ramp, schedule_since
from leco_plugin.models.mixture import Following
from leco_plugin.models.objective import GateLossConfig

if TYPE_CHECKING:
    from leco_plugin.models.leco_config import LecoModelConfig

MOST_RECOVERIES = 3
FEWEST_STEPS = 100
"""A gate is not called collapsed before it has had this many steps."""
SUSPECTED_STEPS = 100
"""Steps for which a gate looks collapsed before it is healed."""
STEPS_PER_LOOK = 50
"""Most steps between two looks at the gate."""
HAS_LEARNED = 0.9
"""Share of the probe positions below which a gate has called some space empty."""
EASED = 4.0
"""How much weaker the force towards a collapse is after it."""
IN_LOGIT_FORM = ", and the gate is taught in logit form from now on"
REMEDY = (
    "Check the scene's bounds in the log above, and the weights under gate-loss; leco-occupancy "
    "trains without skipping with --pipeline.model.schedule.freeze False."
)
"""What a user does whose gate has collapsed for good."""


class GateCollapsed(RuntimeError):
    """A gate has collapsed more often than it may be healed."""


@dataclass(frozen=True)
class Collapse:
    """A gate that has stopped deciding, and why it is thought so."""

    cause: str
    kind: Literal["empty", "occupied", "one expert", "useless"] = "empty"
    """What the gate calls everything. `one expert`: it sends everything that is not empty to one.
    `useless`: no threshold within bounds skips much."""


def find_collapse(kept_fraction: float, shares: Tensor, has_learned: bool) -> Collapse | None:
    """The collapse of a gate, if it looks collapsed.

    Args:
        kept_fraction: share of the probe positions whose o(x) is at least 0.1.
        shares: [1 + n] share of them at each expert.
        has_learned: whether the gate has called something empty before, or the first phase is
            over. Until then one that keeps everything has only not learned enough yet.
    """
    if kept_fraction < 2e-4:
        return Collapse("the gate calls all space empty")
    if kept_fraction > 0.9995 and has_learned:
        return Collapse("the gate calls all space occupied", "occupied")
    scene = shares[1:]
    if len(scene) > 1 and float(scene.sum()) > 0.01 and float(scene.max() / scene.sum()) > 0.999:
        return Collapse(f"scene expert {int(scene.argmax()) + 1} takes all points", "one expert")
    return None


def look(progress: Progress, step: int, kept: float, shares: Tensor, last: bool) -> Collapse | None:
    """The collapse of a gate that has lasted for `SUSPECTED_STEPS`, or is there at the last look of
    the first phase. Notes in `progress` since when one is suspected; kept and shares are as for
    `find_collapse`."""
    progress.fewest_kept = min(progress.fewest_kept, kept)
    if step + 1 - progress.began < FEWEST_STEPS:
        return None
    collapse = find_collapse(kept, shares, last or progress.fewest_kept < HAS_LEARNED)
    if collapse is None or (collapse.kind != "empty" and progress.left_alone):
        progress.suspected_since = -1
        return None
    if progress.suspected_since < 0:
        progress.suspected_since = step
    lasted = step - progress.suspected_since >= SUSPECTED_STEPS
    return collapse if lasted or last else None


def action_on(
    collapse: Collapse, progress: Progress, last: bool, room: float
) -> Literal["heal", "leave", "leave for good", "give up"]:
    """What the rule says of a collapse that has lasted.

    A gate is left as it is where the run has no room, in steps, to heal it in, and at the last look
    of a phase where the points of one expert have been shared out before: that gate knows what is
    empty.
    """
    if collapse.kind == "one expert":
        if last and (room < 1 or progress.balance > 1.0):
            return "leave"
    elif not is_enough(room):
        return "leave"
    if progress.recoveries < MOST_RECOVERIES:
        return "heal"
    # slow, and never wrong: what can be skipped is skipped
    return "give up" if collapse.kind == "empty" else "leave for good"


def heal(
    head: nn.Linear,
    progress: Progress,
    collapse: Collapse,
    shares: Tensor,
    step: int,
    config: GateLossConfig,
    room: float = math.inf,
) -> str:
    """Heals the gate whose last layer this is, for which the run has `room` steps left; returns
    what was done, in words. `shares` [1 + n] are those of points at each expert."""
    anew = is_restart_due(collapse, config, progress)
    progress.recoveries += 1
    progress.suspected_since = -1
    form_fails = progress.recoveries > 1 or collapse.kind == "useless"
    progress.paper_given_up |= form_fails and may_fall_back(config)
    phase = progress.phase or progress.configured
    if collapse.kind == "one expert":
        spread_scene_experts(head, int(shares[1:].argmax()) + 1)
        progress.balance *= EASED
        learn_to = max(progress.learn_steps, step + 1 + int(min(phase // 4, room)))
        progress.learn_steps = learn_to
        form = IN_LOGIT_FORM if progress.paper_given_up else ""
        return f"its points are shared out anew, to learn from until step {learn_to}{form}"
    reset_gate_head(head)
    progress.healed_at = step
    steps = phase if anew else phase // 2
    if is_enough(room):
        steps = int(min(steps, room))
    progress.dense_until = step + 1 + min(phase // 4, steps // 2)
    progress.learn_steps = step + 1 + steps
    progress.decisions = torch.zeros(0, dtype=torch.bool)
    progress.fewest_kept = 1.0
    less = f", then with {EASED:.0f} times less pressure"
    if anew:
        progress.pace, progress.pull, progress.began = progress.pace / EASED, 1.0, step + 1
        return (
            f"gate and field start anew at {progress.pace:.2g} of the learning rates, on dense "
            f"samples to step {progress.dense_until}"
        )
    progress.pull *= 1.0 / EASED if collapse.kind == "empty" else EASED
    return (
        f"its last layer starts anew, on dense samples to step {progress.dense_until}"
        f"{IN_LOGIT_FORM if progress.paper_given_up else less}"
    )


@torch.no_grad()
def reset_gate_head(head: nn.Linear) -> None:
    """Gives a collapsed gate an undecided last layer; what its hidden layers know stays."""
    nn.init.normal_(head.weight, std=0.05)
    nn.init.zeros_(head.bias)


@torch.no_grad()
def spread_scene_experts(head: nn.Linear, dominant: int) -> None:
    """Shares the points of the scene expert that takes all, in [1, n], out among all.

    n equal logits have the log-sum-exp of one that is log n higher, so that o(x) stays as it was
    where that expert was far ahead, and falls by the share of the others where it was not.
    """
    num_scene = head.out_features - 1
    head.weight[1:] = head.weight[dominant] + 0.05 * torch.randn_like(head.weight[1:])
    head.bias[1:] = head.bias[dominant] - math.log(num_scene)


def is_enough(room: float) -> bool:
    """Whether the steps that a run has left are enough to heal a gate in."""
    return room >= FEWEST_STEPS


def is_restart_due(collapse: Collapse, config: GateLossConfig, progress: Progress) -> bool:
    """Whether gate and field restart, at lower learning rates, because a new last layer has
    collapsed as well. In logit form the forces on a gate are bounded; what is left as a cause is
    steps that overshoot, and hidden layers, of gate and field, that they have ruined."""
    again = collapse.kind != "one expert" and progress.healed_at >= 0
    return again and form_of(config, progress) == "logit"


def may_fall_back(config: GateLossConfig) -> bool:
    """Whether a gate may be taught otherwise than is asked for, where that has failed."""
    return config.form == "paper" and config.fall_back


def form_of(config: GateLossConfig, progress: Progress) -> Literal["logit", "paper"]:
    """The form of the losses that teach the gate, after the recoveries so far."""
    return "logit" if progress.paper_given_up and may_fall_back(config) else config.form


def is_dense(progress: Progress, step: int) -> bool:
    """Whether a healed gate is not followed yet."""
    return step < progress.dense_until


def annealed(config: GateLossConfig, progress: Progress, step: int) -> GateLossConfig:
    """The gate's loss settings at a step, after the recoveries so far.

    While samples are dense, the weights of all losses but the balance ramp up from zero again. The
    pull towards empty space is lambda_g in the paper's form, and 1 / k in logit form.
    """
    weight, form = 1.0, form_of(config, progress)
    pull = progress.pull if form == config.form else 1.0
    if is_dense(progress, step):
        weight = (step - progress.healed_at) / (progress.dense_until - progress.healed_at)
    return replace(
        config,
        form=form,
        contribution=config.contribution * weight,
        agreement=config.agreement * weight,
        imbalance=config.imbalance * weight * pull,
        density=config.density * weight,
        emphasis=config.emphasis / pull,
        balance=config.balance * progress.balance,
    )


class StepPlan(NamedTuple):
    """How one training step samples and what it teaches."""

    step: int
    coarse: bool
    """Whether the march is coarse and the field has all losses: in the first phase, and in any case
    until `ramped` is 1."""
    ramped: float
    """See `schedule.ramp`."""
    following: Following | None
    """Which candidates the gate being learned leaves out; None leaves out none."""
    gate_loss: GateLossConfig | None
    """What teaches the gate; None once it is frozen."""


def plan_of(
    step: int, config: LecoModelConfig, progress: Progress, learning: bool, frozen: bool
) -> StepPlan:
    """How a step samples and what it teaches: `learning` is whether the occupancy is still learned,
    `frozen` whether the gate is frozen."""
    ramped = ramp(step - progress.began, schedule_since(config.schedule, progress))
    coarse = learning or ramped < 1.0
    # a homogeneous gate is taught nothing about emptiness; a frozen one goes by its threshold
    followed = not (frozen or config.homogeneous or is_dense(progress, step))
    follows = followed and coarse and ramped > 0.0
    return StepPlan(
        step,
        coarse,
        ramped,
        Following(config.likely_above, config.look_everywhere) if follows else None,
        None if frozen else annealed(config.gate_loss, progress, step),
    )
