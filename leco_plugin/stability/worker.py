"""One run of a case in a process of its own: `python -m leco_plugin.stability.worker FOLDER`.

It is a run of a chart, but with batches of one size for all samplers, and looked at with the exact
scene beside it. In that scene all weight of a ray lies on the first surface that it meets. Whatever
a sampler is, it loses a ray when none of its samples comes near that surface.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.pipelines.base_pipeline import Pipeline, VanillaPipelineConfig
from nerfstudio.pipelines.dynamic_batch import DynamicBatchPipelineConfig
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from leco_plugin.chart.contender import Contender, Protocol
from leco_plugin.chart.worker import main, train_job
from leco_plugin.evaluation.metrics import psnr
from leco_plugin.evaluation.report import finite_or_null
from leco_plugin.evaluation.timed_run import render_rays
from leco_plugin.learning.quality import psnr_of_one_colour
from leco_plugin.samplers.registry import build_estimator
from leco_plugin.stability.photographs import TRUTH
from leco_plugin.stability.plan import DENSE_LEVELS, Sizes
from leco_plugin.studio.host_models import true_colours

NEAR = 0.03
"""A sample whose middle is within this share of the surface's distance is near it: the references
step by about as much."""
RASTER = 3
"""Of the pixels of a held-out picture, one in so many is looked at, along diagonals. Half of the
error lies on silhouettes, so that parts of many pictures say more than few whole ones: seeds of
learned occupancy differ by 0.36 dB in four pictures and by 0.24 in sixteen."""
FEWEST_VIEWS = 2
"""Training pictures that show a surface for it to count: one alone does not tell its depth."""
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


def run_cell(
    contender: Contender,
    seed: int,
    data: Path,
    protocol: Protocol,
    folder: Path,
    on_progress: Callable[[float], None],
) -> dict[str, Any]:
    """Trains and measures; arguments and record as of `chart.worker.run_job`, with `measured`."""
    began = time.process_time()
    job = contender, seed, data, protocol, folder, on_progress
    record, trainer = train_job(*job, adapt=with_fixed_batches, looked_at=False)
    options = contender.changes.get("occupancy.options", {})
    measured, shown = measure(trainer.pipeline, data, options.get("samples", Sizes.dense_samples))
    Image.fromarray(shown).save(folder / "view.png")
    figures = asdict(measured)
    found = {
        "psnr": round(figures.pop("psnr"), 4),
        "processor_seconds": round(time.process_time() - began, 2),
        "measured": finite_or_null(figures),
    }
    return {**record, **finite_or_null(found)}


def with_fixed_batches(config: TrainerConfig) -> TrainerConfig:
    """The same training with as many rays a batch, however much is skipped."""
    pipeline = config.pipeline
    if not isinstance(pipeline, DynamicBatchPipelineConfig):
        return config
    fixed = VanillaPipelineConfig(datamanager=pipeline.datamanager, model=pipeline.model)
    return replace(config, pipeline=fixed)


@torch.no_grad()
def measure(
    pipeline: Pipeline, data: Path, dense_samples: int
) -> tuple[Measured, NDArray[np.uint8]]:
    """Looks at the held-out pictures of a case's scene, in the folder `data` with its truth.

    Args:
        dense_samples: candidates of a ray of a proposal host's reference.
    Returns:
        The figures, and the first picture [h, w, 3] as the host renders it.
    """
    manager: Any = pipeline.datamanager
    model, dataset = pipeline.model, manager.eval_dataset
    pipeline.eval()
    scale = float(manager.train_dataparser_outputs.dataparser_scale)
    counts: list[tuple[int, ...]] = []
    all_looked_at, details = [], []
    shown = None
    for number, file in enumerate(dataset.image_filenames):
        facts = np.load(data / TRUTH / f"{Path(file).stem}.npz")
        truth = {name: torch.from_numpy(values).flatten() for name, values in facts.items()}
        bundle = dataset.cameras.to("cpu").generate_rays(camera_indices=number).to(pipeline.device)
        height, width = bundle.shape
        flat, looked_at = bundle.flatten(), raster(height, width)
        depth = truth["depth"][looked_at] * scale
        seen = flat[looked_at.to(pipeline.device)]
        nearest, kept, most = find_samples(model, seen, depth, dense_samples)
        counts.append((*count_lost(nearest, depth, truth["shown_by"][looked_at]), kept, most))
        detail = truth["detail"]
        asked = torch.ones_like(detail) if shown is None else detail | looked_at
        rgb = render_rays(model, flat[asked.to(pipeline.device)], RAYS_AT_ONCE).cpu()
        image = dataset.get_data(number)["image"].reshape(len(flat), -1).to(pipeline.device)
        wanted = true_colours(model, image).float().cpu()
        both = torch.stack([rgb, wanted[asked]])
        all_looked_at.append(both[:, looked_at[asked]])
        details.append(both[:, detail[asked]])
        if shown is None:
            shown = (255 * rgb.view(height, width, 3)).round().byte().numpy()
    pipeline.train()
    lost, met, samples, candidates = map(sum, zip(*counts))
    (rgb, colours), of_detail = torch.cat(all_looked_at, dim=1), torch.cat(details, dim=1)
    assert shown is not None
    found = Measured(
        psnr(rgb, colours),
        lost / met if met else None,
        samples / max(candidates, 1),
        psnr(*of_detail) if of_detail.shape[1] else None,
        psnr_of_one_colour(colours),
    )
    return found, shown


def raster(height: int, width: int) -> Tensor:
    """The pixels of a picture that are looked at: [height * width], True for one in `RASTER`."""
    return ((torch.arange(height)[:, None] + torch.arange(width)) % RASTER == 0).flatten()


def count_lost(nearest: Tensor, depth: Tensor, shown_by: Tensor) -> tuple[int, int]:
    """How many rays lose the surface that they meet, and how many meet one that counts.

    Args:
        nearest: [N] distance of the surface from the middle of the nearest sample.
        depth: [N] distance of the surface, in the same units.
        shown_by: [N] training pictures that show it; 0 where there is none.
    """
    counts = shown_by >= FEWEST_VIEWS
    kept = nearest[counts] <= NEAR * depth[counts]  # not where a sample is nowhere
    return int((~kept).sum()), int(counts.sum())


def find_samples(
    model: Any, bundle: RayBundle, depth: Tensor, dense_samples: int
) -> tuple[Tensor, int, int]:
    """Where a packed host or a proposal host would ask its field along some rays [N].

    Args:
        depth: [N] distance of each ray's surface, scene units; inf for none.
        dense_samples: candidates of a ray of a proposal host's reference.
    Returns:
        [N] distance of the surface from the middle of the nearest sample, inf without one; number
        of samples; and number of candidates of the dense reference.
    """
    is_packed = not hasattr(model, "proposal_sampler")
    sample = _sample_packed if is_packed else partial(_sample_proposals, dense_samples)
    parts = [slice(i, i + RAYS_AT_ONCE) for i in range(0, len(bundle), RAYS_AT_ONCE)]
    found = [sample(model, bundle[part], depth[part]) for part in parts]
    nearest, samples, candidates = zip(*found)
    return torch.cat(nearest), sum(samples), sum(candidates)


def _sample_proposals(
    dense_samples: int, model: Any, bundle: RayBundle, depth: Tensor
) -> tuple[Tensor, int, int]:
    """As of `find_samples`."""
    bundle = model.collider(bundle) if model.collider is not None else bundle
    samples, _, _ = model.proposal_sampler(bundle, density_fns=model.density_fns)
    middles = ((samples.frustums.starts + samples.frustums.ends) / 2)[..., 0].cpu()
    away = (middles - depth[:, None]).abs().amin(dim=1)
    return away, middles.numel(), dense_samples * len(bundle)


def _sample_packed(model: Any, bundle: RayBundle, depth: Tensor) -> tuple[Tensor, int, int]:
    """As of `find_samples`."""
    names = ("near_plane", "far_plane", "render_step_size", "cone_angle")
    options = {name: getattr(model.config, name) for name in names}
    rays = bundle.origins, bundle.directions
    ray_indices, starts, ends = model.occupancy_grid.sampling(*rays, **options)
    dense: Any = build_estimator("dense", aabb=model.scene_aabb, levels=DENSE_LEVELS)
    candidates = len(dense.to(model.device).sampling(*rays, **options)[0])
    ray_indices, middles = ray_indices.cpu(), ((starts + ends) / 2).cpu()
    away = (middles - depth[ray_indices]).abs()
    nearest = torch.full((len(bundle),), math.inf)
    return nearest.scatter_reduce(0, ray_indices, away, "amin"), len(middles), candidates


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]), run_cell))
