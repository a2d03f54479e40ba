"""The objective of field and gate: which losses, with which weights, on which samples."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import torch
from torch import Tensor

from leco_plugin.models.gate import occupancy_from_logits
from leco_plugin.models.losses import (
    adjoining,
    agreement_loss,
    backdrop_loss,
    balance_loss,
    color_loss,
    contribution_loss,
    density_loss,
    distortion_loss,
    imbalanced_gate_loss,
    termination_loss,
    widen,
)
from leco_plugin.models.rendering import Intervals, Rays, Shaded, backdrop_of
from leco_plugin.scenes.input_error import require

if TYPE_CHECKING:
    from leco_plugin.models.leco_config import LecoModelConfig

DARK = 0.1
"""Largest channel, in [0, 1], from which a pixel is not dark. A dark one may show nothing."""


@dataclass
class GateLossConfig:
    """What teaches the gate."""

    form: Literal["logit", "paper"] = "logit"
    """Contribution in logit form, or imbalanced gate loss and density loss as in the paper."""
    fall_back: bool = True
    """Whether a gate in the paper's form is taught in logit form from its second recovery on, and
    as soon as hardly anything can be skipped by it; False where the paper's is what is compared."""
    contribution: float = 0.02
    """Weight of the contribution loss (logit form)."""
    weight_at_full: float = 0.15
    """w_0: rendering weight that makes a sample fully occupied (logit form)."""
    emphasis: float = 8.0
    """k: how much dearer a lost contribution is than a needless sample (logit form)."""
    empty_below: float = 0.2
    """o(x) below which a point goes to the empty-space expert (logit form; the paper: argmax)."""
    agreement: float = 0.1
    """Weight of the field giving up what the gate calls empty (logit form)."""
    balance: float = 5e-3
    """Weight of the balance among scene experts (logit form, and the homogeneous mixture)."""
    imbalance: float = 5e-3
    """lambda_g, weight of the imbalanced gate loss (paper form)."""
    empty_ratio: float | None = 0.9
    """rho, the target empty ratio (paper form); None asks for equally many points at every expert,
    as Switch-NeRF does."""
    density: float = 1.0
    """lambda_d, weight of the density loss (paper form)."""

    def __post_init__(self) -> None:
        inside = "above 0 and below 1"
        for name in ("contribution", "agreement", "balance", "imbalance", "density"):
            weight = getattr(self, name)
            require(0.0 <= weight < math.inf, f"gate-loss.{name}", weight, "a number, at least 0")
        for option, value in (("weight-at-full", self.weight_at_full), ("emphasis", self.emphasis)):
            require(0.0 < value < math.inf, f"gate-loss.{option}", value, "a number above 0")
        below, ratio = self.empty_below, self.empty_ratio
        require(0.0 < below < 1.0, "gate-loss.empty-below", below, inside)
        asked = ratio is None or 0.0 < ratio < 1.0
        require(asked, "gate-loss.empty-ratio", ratio, f"{inside}, or None for equal shares")


def field_losses(
    weights: LecoModelConfig,
    shaded: Shaded,
    intervals: Intervals,
    rays: Rays,
    truth: Tensor,
    opacities: Tensor | None,
    distances: Tensor | None,
    *,
    grounded: Tensor,
    span: tuple[Tensor, Tensor],
    unbounded: Tensor,
    learning: bool,
    ramped: float,
) -> dict[str, Tensor]:
    """Weighted losses of one batch that teach the field, by name.

    Args:
        truth: [R, 3] colours.
        opacities: [R] of the pixels, in [0, 1]; None where all are opaque.
        distances: [R] to sparse points, scene units, 0 where none is known; None is no such points.
        grounded: bool [R], which rays would end below the ground.
        span: near and far, scalars, scene units.
        unbounded: scalar bool, whether a ray may go on to a sky of any colour; in a box nothing but
            darkness lies behind the scene.
        learning: whether this is a step of the first phase.
        ramped: see `schedule.ramp`: of distortion, nearness and ground.
    """
    losses = {"rgb_loss": color_loss(shaded.rgb, truth)}
    near, far = span
    if weights.transparency > 0.0 and opacities is not None:
        losses["transparency_loss"] = weights.transparency * backdrop_loss(
            *_backdrops(shaded, intervals, rays), 1.0 - opacities, (opacities < 1.0).to(opacities)
        )
    distortion = weights.distortion * ramped * (1.0 if learning else weights.distortion_after)
    if distortion > 0.0:
        starts, ends = ((t - near) / (far - near) for t in intervals[1:])
        losses["distortion_loss"] = distortion * distortion_loss(
            shaded.weights, starts, ends, shaded.packed_info
        )
    if not learning:
        return losses
    dark = (1.0 - truth.amax(dim=-1) / DARK).clamp(min=0.0)
    ground = weights.ground * ramped
    if ground > 0.0:
        shows = (1.0 - dark) * (1.0 if opacities is None else opacities >= 1.0)
        losses["ground_loss"] = ground * backdrop_loss(
            *_backdrops(shaded, intervals, rays), torch.zeros_like(shows), shows * grounded
        )
    if weights.termination > 0.0 and distances is not None:
        losses["termination_loss"] = weights.termination * termination_loss(
            shaded.weights, intervals, distances
        )
    if weights.nearness > 0.0:
        nearness = (far - shaded.depth) / (far - near) * torch.where(unbounded, 1.0, dark)
        losses["nearness_loss"] = weights.nearness * ramped * nearness.mean()
    return losses


def _backdrops(shaded: Shaded, intervals: Intervals, rays: Rays) -> tuple[Tensor, Tensor, Tensor]:
    """Rendering weights [M], which of them are backdrops', and their rays; asked for by the losses
    that need them, which guided steps of opaque photographs do not have."""
    return shaded.weights, backdrop_of(intervals, rays), intervals.ray_indices


def gate_losses(
    config: GateLossConfig,
    shaded: Shaded,
    intervals: Intervals,
    rays: Rays,
    half_extent: Tensor,
    homogeneous: bool,
    *,
    ramped: float,
) -> dict[str, Tensor]:
    """Weighted losses of one batch that teach the gate, and agreement, which teaches the field.

    Args:
        half_extent: scalar, scene units in the unit of density.
        homogeneous: only the balance among the scene experts.
        ramped: see `schedule.ramp`: of agreement.
    """
    routes, balance = shaded.routes, {}
    if homogeneous or config.form == "logit":
        balance["balance_loss"] = config.balance * _scene_balance(shaded.logits, routes)
    if homogeneous:
        return balance
    # the backdrop is kept anyway, and says nothing about where a ray happens to end
    before = (~backdrop_of(intervals, rays)).nonzero()[:, 0]
    logits = shaded.logits.index_select(0, before)
    intervals = Intervals(*(part.index_select(0, before) for part in intervals))
    if config.form == "logit":
        weights = shaded.weights.index_select(0, before)
        targets = widen(weights.detach(), adjoining(intervals))
        contribution = contribution_loss(logits, targets, config.weight_at_full, config.emphasis)
        agreement = agreement_loss(weights, occupancy_from_logits(logits), config.empty_below)
        return {
            "agreement_loss": config.agreement * ramped * (agreement / len(rays.origins)),
            "contribution_loss": config.contribution * contribution,
        } | balance
    probabilities, routes = logits.softmax(dim=-1), routes.index_select(0, before)
    lengths = (intervals.t_ends - intervals.t_starts) / half_extent
    alphas = 1.0 - torch.exp(-shaded.sigmas.index_select(0, before) * lengths)
    equal_shares = 1.0 / probabilities.shape[-1]
    empty_ratio = equal_shares if config.empty_ratio is None else config.empty_ratio
    return {
        "gate_loss": config.imbalance * imbalanced_gate_loss(probabilities, routes, empty_ratio),
        "density_loss": config.density * density_loss(probabilities[:, 0], alphas),
    }


def _scene_balance(logits: Tensor, routes: Tensor) -> Tensor:
    """`balance_loss` among the scene experts; 0 where there is only one, or none has a point."""
    on_scene = (routes > 0).nonzero()[:, 0]
    if len(on_scene) == 0 or logits.shape[-1] == 2:
        return logits.new_zeros(())
    return balance_loss(logits[on_scene, 1:].softmax(dim=-1), routes[on_scene] - 1)
