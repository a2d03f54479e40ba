"""Pictures and logged figures of rays, other than their colours."""

from __future__ import annotations

import warnings
from typing import Any

import torch
from nerfstudio.model_components.renderers import RGBRenderer
from torch import Tensor

from leco_plugin.evaluation.metrics import image_metrics
from leco_plugin.learning.calibration import LOSSES
from leco_plugin.models.gate import EMPTY, occupancy_from_logits
from leco_plugin.models.losses import expert_statistics
from leco_plugin.models.rendering import MET, Intervals, Rays, Shaded, backdrop_of, sum_up
from leco_plugin.samplers.rays import candidate_counts

NONE = -1
"""Stands for the expert of a ray that meets nothing."""


def over_background(shaded: Shaded, rays: Rays) -> Tensor:
    """Colours [R, 3] over nerfstudio's background where rays are cut off: black, or a crop's."""
    if rays.cut_off is None:
        return shaded.rgb
    color = RGBRenderer.get_background_color("black", shaded.rgb.shape, shaded.rgb.device)
    through = (1.0 - shaded.accumulation).clamp(min=0.0) * rays.cut_off
    return shaded.rgb + through[:, None] * color


@torch.no_grad()
def before_the_backdrop(
    shaded: Shaded, intervals: Intervals, rays: Rays
) -> tuple[Shaded, dict[str, Tensor]]:
    """A rendering with weights, accumulation and depth of what lies before the backdrop alone, and
    its `depth` and `accumulation`, [R, 1] each. A ray with an accumulation below `MET` meets
    nothing, and has depth `t_maxs`, scene units."""
    met = shaded.weights.detach().masked_fill(backdrop_of(intervals, rays), 0.0)
    accumulation, depth = sum_up(met, rays, intervals)
    shown = {"depth": depth[:, None], "accumulation": accumulation[:, None]}
    return shaded._replace(weights=met, accumulation=accumulation, depth=depth), shown


@torch.no_grad()
def gate_pictures(
    met: Shaded, ray_indices: Tensor, occupancies: Tensor, experts: int
) -> dict[str, Tensor]:
    """What the gate did along each ray, for the viewer: each [R, 1] float32.

    `occupancy` is o(x) [R] at the depth, `expert` is `leading_expert` of so many; both are 0 where
    nothing is met. `met` is without the weight of backdrops.
    """
    expert = leading_expert(met, ray_indices, experts)
    return {
        "occupancy": occupancies.where(met.accumulation >= MET, 0.0)[:, None],
        "expert": expert.clamp(min=EMPTY).float(),
        "samples_per_ray": met.packed_info[:, 1:].float(),  # nerfstudio cannot show integers
    }


@torch.no_grad()
def leading_expert(met: Shaded, ray_indices: Tensor, experts: int) -> Tensor:
    """The expert in [0, experts) with the greatest weight along each ray: [R, 1] int64, or `NONE`.
    `met` is without the weight of backdrops."""
    sums = met.weights.new_zeros(len(met.rgb) * experts)
    sums.index_add_(0, ray_indices * experts + met.routes, met.weights)
    expert = sums.view(-1, experts).argmax(dim=-1, keepdim=True)
    return expert.where(met.accumulation[:, None] >= MET, NONE)


def with_alpha(outputs: dict[str, Tensor], output_name: str = "rgb") -> Tensor:
    """A colour picture with what was met before the backdrop as its alpha, [..., 4]; its name
    contains `rgb`.

    Warns where nothing is met at all, for nerfstudio's exporter goes on until it has met enough.
    """
    accumulation = outputs[output_name.replace("rgb", "accumulation")]
    if not bool((accumulation >= MET).any()):
        warnings.warn(
            "none of these rays meets anything but the backdrop: an export finds no points there, "
            "and waits for ever if that is so everywhere, as in a run of a few steps",
            stacklevel=2,
        )
    return torch.cat([outputs[output_name], accumulation], dim=-1)


def image_figures(
    model: Any, outputs: dict[str, Tensor], batch: dict[str, Tensor]
) -> tuple[dict[str, float], dict[str, Tensor]]:
    """Figures of one image (see `image_metrics`), and pictures for the log, from `rgb` [H, W, 3],
    `accumulation` and `depth` [H, W, 1]; the batch's `image` [H, W, 3 or 4] is compared before the
    background of the `model`, of whose class this is a method."""
    from nerfstudio.utils import colormaps

    truth = model.renderer_rgb.blend_background(batch["image"].to(outputs["rgb"].device))
    predicted = outputs["rgb"].clamp(0.0, 1.0)
    pictures = {
        "img": torch.cat([truth, predicted], dim=1),
        "accumulation": colormaps.apply_colormap(outputs["accumulation"]),
        "depth": colormaps.apply_depth_colormap(
            outputs["depth"], accumulation=outputs["accumulation"]
        ),
    }
    return image_metrics(predicted, truth), pictures


@torch.no_grad()
def gate_statistics(shaded: Shaded, scene_experts: int) -> dict[str, Tensor]:
    """Samples per ray, and for each expert its share of them and their mean density: float scalars.
    Densities are per half extent of the scene."""
    shares, density = expert_statistics(shaded.routes, shaded.sigmas, 1 + scene_experts)
    figures = {"samples_per_ray": shaded.packed_info[:, 1].float().mean()}
    for expert in range(1 + scene_experts):
        figures[f"share_expert_{expert}"] = shares[expert]
        figures[f"density_expert_{expert}"] = density[expert]
    return figures


@torch.no_grad()
def batch_figures(outputs: dict[str, Any], truth: Tensor, experts: int) -> dict[str, Tensor]:
    """PSNR of a batch of `LecoModel.get_outputs` against pixels [R, 3], and in training what its
    gate keeps and how its scene experts share it."""
    error = torch.nn.functional.mse_loss(outputs["rgb"], truth)
    figures = {"psnr": -10.0 * torch.log10(error.clamp(min=1e-12))}
    if "shaded" in outputs:
        batch_of = outputs["shaded"], outputs["intervals"], outputs["rays"]
        figures["kept_fraction"] = kept_fraction(*batch_of, *outputs["kept_rule"])
        figures |= gate_statistics(outputs["shaded"], experts)
    return figures


def kept_fraction(
    shaded: Shaded,
    intervals: Intervals,
    rays: Rays,
    above: float,
    step_size: float,
    cone_angle: float,
) -> Tensor:
    """Share of all candidates of a batch that the gate keeps, those that were skipped included.

    A backdrop counts as kept, as it does in `Measured.empty_fraction`.

    Args:
        shaded, intervals: what is left of the candidates; none is missing that has o(x) >= above.
        above: o(x) from which a candidate is kept.
        step_size, cone_angle: of the march.
    Returns:
        Float scalar in [0, 1].
    """
    kept = torch.tensor(len(shaded.weights), device=shaded.weights.device)
    if above > 0.0:
        likely = occupancy_from_logits(shaded.logits) >= above
        kept = (likely | backdrop_of(intervals, rays)).sum()
    candidates = candidate_counts(rays.t_mins, rays.t_maxs, step_size, cone_angle).sum()
    return (kept / candidates.clamp(min=1.0)).clamp(max=1.0)


def prices(report: dict[str, Any]) -> dict[str, Tensor]:
    """What skipping costs as it was last measured: float scalars. The gate's report is empty before
    it is frozen, and holds None where no field measured it."""
    known = {name: report.get(name) for name in LOSSES}
    return {name: torch.tensor(float(x)) for name, x in known.items() if x is not None}
