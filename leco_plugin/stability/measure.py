"""What a trained host skips of a scene that is known exactly, and what its pictures show of it.

In the exact scene all weight of a ray lies on the first surface that it meets. Whatever a sampler
is, it loses a ray when none of its samples comes near that surface.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.engine.trainer import Trainer
from numpy.typing import NDArray
from torch import Tensor

from leco_plugin.stability.scene_folder import TRUTH
from leco_plugin.studio.host_models import true_colours

NEAR = 0.03
"""A sample whose middle is within this share of the surface's distance is near it: the references
step by about as much."""
RASTER = 3
"""Of the pixels of a held-out picture, one in so many is looked at, along diagonals. Where half of
the error lies on silhouettes, many pictures of which a part is seen say more than few whole ones:
seeds of learned occupancy differ by 0.36 dB in four pictures and by 0.24 in sixteen."""
FEWEST_VIEWS = 2
"""Training pictures that show a surface for it to count: from one alone nobody can tell its depth,
and what is kept there is chance."""
RAYS_AT_ONCE = 256
"""Few: on a CPU one of 1024 took two to four times as long as one of 342, most of it for memory."""


@dataclass(frozen=True)
class Measured:
    """Of a raster over all held-out pictures together."""

    psnr: float
    """Of all that is looked at."""
    lost_mass: float | None
    """Of the rays that meet a surface which `FEWEST_VIEWS` show, the share without a sample near
    it; None without such surfaces."""
    kept_fraction: float
    """Samples as a share of the candidates of the dense reference."""
    detail_psnr: float | None
    """PSNR on all pixels that show what the case is about; None where it is about no such thing."""
    trivial_psnr: float
    """PSNR of the same pixels against their mean colour: of a method that saw nothing."""


@torch.no_grad()
def measure(trainer: Trainer, data: Path, dense_samples: int) -> tuple[Measured, NDArray[np.uint8]]:
    """Looks at the held-out pictures of a case's scene, and renders what of them it needs.

    Args:
        trainer: with a trained host.
        data: folder of the scene, with its truth.
        dense_samples: candidates of a ray of a proposal host's reference.
    Returns:
        The figures, and the first picture [h, w, 3] as the host renders it.
    """
    pipeline: Any = trainer.pipeline
    pipeline.eval()
    dataset: Any = pipeline.datamanager.eval_dataset
    scale = float(pipeline.datamanager.train_dataparser_outputs.dataparser_scale)
    lost = met = samples = candidates = 0
    errors: list[Tensor] = []
    detailed: list[Tensor] = []
    colours: list[Tensor] = []
    shown = None
    for number, file in enumerate(dataset.image_filenames):
        truth = np.load(data / TRUTH / f"{Path(file).stem}.npz")
        depth = torch.from_numpy(truth["depth"]).flatten() * scale
        bundle = dataset.cameras.to("cpu").generate_rays(camera_indices=number).to(pipeline.device)
        height, width = bundle.shape
        flat, looked_at = bundle.flatten(), raster(height, width)
        seen, depth = flat[looked_at.to(pipeline.device)], depth[looked_at]
        nearest, counts, most = [], [], 0
        for first in range(0, len(seen), RAYS_AT_ONCE):
            part = seen[first : first + RAYS_AT_ONCE]
            near, count, all_of_them = sampled(
                pipeline.model, part, depth[first : first + RAYS_AT_ONCE], dense_samples
            )
            nearest.append(near)
            counts.append(count)
            most += all_of_them
        shown_by = torch.from_numpy(truth["shown_by"]).flatten()[looked_at]
        lost_here, met_here = lost_of(torch.cat(nearest), depth, shown_by)
        lost, met = lost + lost_here, met + met_here
        count = torch.cat(counts)
        samples, candidates = samples + int(count.sum()), candidates + most
        detail = torch.from_numpy(truth["detail"]).flatten()
        asked = torch.ones_like(detail) if shown is None else detail | looked_at
        rgb = render(pipeline.model, flat[asked.to(pipeline.device)]).cpu()
        image = dataset.get_data(number)["image"].reshape(len(flat), -1).to(pipeline.device)
        wanted = true_colours(pipeline.model, image).float().cpu()
        colours.append(wanted[looked_at])
        errors.append((rgb[looked_at[asked]] - wanted[looked_at]).square())
        detailed.append((rgb[detail[asked]] - wanted[detail]).square())
        if shown is None:
            shown = (255 * rgb.view(height, width, 3)).round().byte().numpy()
    pipeline.train()
    detail_error, colour = torch.cat(detailed), torch.cat(colours)
    assert shown is not None
    return (
        Measured(
            psnr(torch.cat(errors)),
            lost / met if met else None,
            samples / max(candidates, 1),
            psnr(detail_error) if len(detail_error) else None,
            psnr((colour - colour.mean(dim=0)).square()),
        ),
        shown,
    )


def raster(height: int, width: int) -> Tensor:
    """The pixels of a picture that are looked at: [height * width], True for one in `RASTER`."""
    return ((torch.arange(height)[:, None] + torch.arange(width)) % RASTER == 0).flatten()


def lost_of(nearest: Tensor, depth: Tensor, shown_by: Tensor) -> tuple[int, int]:
    """How many rays lose the surface that they meet, and how many meet one that counts.

    Args:
        nearest: [N] distance of the surface from the middle of the nearest sample.
        depth: [N] distance of the surface, in the same units.
        shown_by: [N] training pictures that show it; 0 where there is none.
    """
    counts = shown_by >= FEWEST_VIEWS
    kept = nearest[counts] <= NEAR * depth[counts]  # not where a sample is nowhere
    return int((~kept).sum()), int(counts.sum())


def psnr(squared_errors: Tensor) -> float:
    """Of any number of squared errors, dB."""
    return -10.0 * math.log10(max(float(squared_errors.double().mean()), 1e-12))


def render(model: Any, bundle: RayBundle) -> Tensor:
    """Colours [N, 3] of rays, in [0, 1]."""
    parts = [bundle[i : i + RAYS_AT_ONCE] for i in range(0, len(bundle), RAYS_AT_ONCE)]
    if not parts:
        return torch.zeros(0, 3, device=bundle.origins.device)
    return torch.cat([model(part)["rgb"] for part in parts]).clamp(0.0, 1.0)


def sampled(
    model: Any, bundle: RayBundle, depth: Tensor, dense_samples: int
) -> tuple[Tensor, Tensor, int]:
    """Where a host would ask its field along some rays.

    Args:
        model: a packed host or a proposal host.
        bundle: rays [N].
        depth: [N] distance of each ray's surface, scene units; inf for none.
        dense_samples: candidates of a ray of a proposal host's reference.
    Returns:
        [N] distance of the surface from the middle of the nearest sample, inf without one; [N]
        number of samples; and how many all candidates of all rays are.
    """
    if hasattr(model, "proposal_sampler"):
        bundle = model.collider(bundle) if model.collider is not None else bundle
        samples, _, _ = model.proposal_sampler(bundle, density_fns=model.density_fns)
        middles = ((samples.frustums.starts + samples.frustums.ends) / 2)[..., 0].cpu()
        away = (middles - depth[:, None]).abs().amin(dim=1)
        count = torch.full((len(bundle),), middles.shape[1])
        return away, count, dense_samples * len(bundle)
    from leco_plugin.samplers.registry import build_estimator
    from leco_plugin.stability.contenders import DENSE_LEVELS

    config = model.config
    options = {
        "near_plane": config.near_plane,
        "far_plane": config.far_plane,
        "render_step_size": config.render_step_size,
        "cone_angle": config.cone_angle,
    }
    rays = bundle.origins, bundle.directions
    ray_indices, starts, ends = model.occupancy_grid.sampling(*rays, **options)
    dense: Any = build_estimator("dense", aabb=model.scene_aabb, levels=DENSE_LEVELS).to(
        model.device
    )
    most = len(dense.sampling(*rays, **options)[0])
    ray_indices, middles = ray_indices.cpu(), ((starts + ends) / 2).cpu()
    away = (middles - depth[ray_indices]).abs()
    nearest = torch.full((len(bundle),), math.inf)
    nearest = nearest.scatter_reduce(0, ray_indices, away, "amin")
    return nearest, torch.bincount(ray_indices, minlength=len(bundle)), most
