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
"""Brightness, of the largest channel, from which a pixel of a bounded scene shows something."""


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
    """Weighted losses of one batch that the field answers for, by name.

    Args:
        truth: [R, 3] colours.
        opacities: [R] of the pixels; None where all are opaque.
        distances: [R] to sparse points, scene units, 0 where none is known; None is no such points.
        grounded: bool [R], which rays are known to meet ground.
        span: near and far, scalars, scene units.
        unbounded: scalar bool, whether a ray may go on to a sky of any colour; in a box nothing but
            darkness lies behind the scene.
        learning: whether this is the first phase.
        ramped: how far the distortion loss has come in, in [0, 1]; nearness and ground come in with
            it.
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
        opaque = (1.0 - dark) * (1.0 if opacities is None else opacities >= 1.0)
        losses["ground_loss"] = ground * backdrop_loss(
            *_backdrops(shaded, intervals, rays), torch.zeros_like(opaque), opaque * grounded
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
    """Rendering weights [M], which of them are backdrops', and their rays."""
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
    """Weighted losses of one batch, by name.

    Args:
        half_extent: scalar, scene units in the unit of density.
        homogeneous: only the balance among the scene experts.
        ramped: how far the distortion loss has come in, in [0, 1]; agreement comes in with it.
    """
    logits, routes = shaded.logits, shaded.routes
    on_scene = (routes > 0).nonzero()[:, 0]
    balance = logits.new_zeros(())
    if len(on_scene) > 0 and logits.shape[-1] > 2:
        probabilities = logits[on_scene, 1:].softmax(dim=-1)
        balance = config.balance * balance_loss(probabilities, routes[on_scene] - 1)
    if homogeneous:
        return {"balance_loss": balance}
    # the backdrop is kept anyway, and says nothing about where a ray happens to end
    before = (~backdrop_of(intervals, rays)).nonzero()[:, 0]
    if config.form == "logit":
        weights = widen(
            shaded.weights.detach().index_select(0, before),
            adjoining(Intervals(*(part.index_select(0, before) for part in intervals))),
        )
        contribution = contribution_loss(
            logits.index_select(0, before), weights, config.weight_at_full, config.emphasis
        )
        agreement = agreement_loss(
            shaded.weights.index_select(0, before),
            occupancy_from_logits(logits.index_select(0, before)),
            config.empty_below,
        ) / len(rays.origins)
        return {
            "agreement_loss": config.agreement * ramped * agreement,
            "contribution_loss": config.contribution * contribution,
            "balance_loss": balance,
        }
    probabilities = logits.index_select(0, before).softmax(dim=-1)
    routes = routes.index_select(0, before)
    lengths = (intervals.t_ends - intervals.t_starts) / half_extent
    alphas = (1.0 - torch.exp(-shaded.sigmas * lengths)).index_select(0, before)
    equal_shares = 1.0 / probabilities.shape[-1]
    empty_ratio = equal_shares if config.empty_ratio is None else config.empty_ratio
    return {
        "gate_loss": config.imbalance * imbalanced_gate_loss(probabilities, routes, empty_ratio),
        "density_loss": config.density * density_loss(probabilities[:, 0], alphas),
    }
