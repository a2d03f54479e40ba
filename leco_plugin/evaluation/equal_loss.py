"""Figures of an occupancy: its size, what it keeps of an exact city, and what at equal loss.

At equal loss each representation has a score: o(x) for a gate, the largest density in a cell for a
grid. Its threshold is set so that all lose the same share of the weight near surfaces. Only space
that rays of photographs reach is counted: elsewhere gates and grids are neither taught nor queried.
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from nerfstudio.cameras.rays import RayBundle
from scipy.spatial import cKDTree
from torch import Tensor

from leco_plugin.evaluation import field_grids, inspection
from leco_plugin.evaluation.inspection import ViewBox, ask, in_parts, whole_box
from leco_plugin.evaluation.report import finite_or_null
from leco_plugin.learning.calibration import CalibrationConfig
from leco_plugin.learning.dense import dense_reference, evaluating, in_chunks
from leco_plugin.learning.freezing import FILE_NAME
from leco_plugin.models.mixture import Mixture
from leco_plugin.models.rendering import backdrop_of, mapped_middles
from leco_plugin.occupancy import CALIBRATED_AT, Occupancy
from leco_plugin.scenes.city.city import DESCRIPTION
from leco_plugin.scenes.city.folder import CityTruth
from leco_plugin.scenes.learning_data import held_out_rays
from leco_plugin.seen import CELLS, cells_at

CALIBRATION = CalibrationConfig()
LOST_SURFACE_MASS = 1e-3
"""Share of the weight near surfaces that each representation loses."""
VOLUME_POINTS = 1 << 17
"""Positions drawn in the whole box, of which rays reach some."""
TAUGHT_RAYS = 1 << 15
"""Rays of photographs that say what is reached, and of whose densities grids hear."""
MOST_ON_CPU = 2e8
"""Densities evaluated for one grid: about three minutes of two cores."""
SPARED = 0.1
"""Share of the loss for which cells of a coarse grid are taken as empty in finer ones."""


def threshold_losing(weights: Tensor, scores: Tensor, lost: float) -> float:
    """The largest score below which samples hold at most a share `lost` of all weight [M] >= 0."""
    ordered, order = scores.double().sort()
    skipped = weights.double()[order].cumsum(0)
    first_too_many = int((skipped <= lost * skipped[-1]).sum())
    return float(ordered[min(first_too_many, len(ordered) - 1)])


def kept_shares(
    weights: Tensor, scores: Tensor, of_volume: Tensor, lost: float
) -> tuple[float, float]:
    """Shares of the volume and of the candidates that are kept where a share of weight is lost.

    Args:
        weights, scores: [M] of candidates; weights are those near surfaces.
        of_volume: [P] scores of places spread evenly over what rays reach of the scene's box.
    """
    threshold = threshold_losing(weights, scores, lost)
    volume, candidates = ((some >= threshold).double().mean() for some in (of_volume, scores))
    return float(volume), float(candidates)


@torch.no_grad()
def at_equal_loss(
    mixture: Mixture,
    datamanager: Any,
    grids: Sequence[int] = (),
    others: Mapping[str, Callable[[Tensor], Tensor] | Tensor] | None = None,
) -> dict[str, Any]:
    """What the mixture's gate keeps at `LOST_SURFACE_MASS`, and grids made from the same field.

    Meant for the moment of freezing: later the field is trained only where the gate keeps. Grids
    are filled with the densities along rays, as a gate is taught them, and at random places.

    Args:
        others: further representations by name, each a score of mapped positions [N, 3]: [N], or
            the scores [n, n, n] of a grid in `mapped_box`.
    Returns:
        `lost_surface_mass`; `reached_volume`, the share of the scene's box that rays reach;
        `kept_reached_volume` and `kept_candidates`, shares of that and of the candidates between
        near and far. `grids` holds the same for each grid, with its `resolution`, its `bytes` at
        one bit a cell, its `octree_bytes`, whether it keeps least `dilated` by a cell, and the
        `update_seconds` that it took beyond the field, coarser grids included. `others`, if there
        are any, holds what each keeps, and for a grid `dilated` and `octree_bytes`. `left_out`
        lists resolutions that do not fit the free memory, or take minutes of a CPU.
    Raises:
        ValueError: held-out rays see no surface.
    """
    with evaluating(mixture):
        mapped, weights, occupancies = _measured(mixture, datamanager)
        if not bool((weights > 0.0).any()):
            raise ValueError("no surface is seen by the held-out rays, so that none can be lost")
        taught = candidates_of(mixture, rays_of_photographs(datamanager, TAUGHT_RAYS))
        volume = reached_volume(mixture, taught, VOLUME_POINTS)
        ground = Ground(mapped_box(mixture), mapped, weights, volume)
        kept = ground.kept_by(occupancies, in_parts(mixture.occupancies, volume))
        beside = {name: ground.kept_by_score(score) for name, score in (others or {}).items()}
        rows, left_out = _kept_by_grids(mixture, grids, taught, ground) if grids else ([], [])
    return {
        "lost_surface_mass": LOST_SURFACE_MASS,
        "reached_volume": round(len(volume) / VOLUME_POINTS, 5),
        **kept,
        **({"others": beside} if beside else {}),
        "grids": rows,
        "left_out": left_out,
    }


class Ground(NamedTuple):
    """What representations of one field are compared on."""

    box: ViewBox
    """Of grids."""
    mapped: Tensor
    """[M, 3] candidates of held-out rays."""
    weights: Tensor
    """[M] those near surfaces."""
    volume: Tensor
    """[P, 3] mapped places that rays reach."""

    def kept_by(self, of_rays: Tensor, of_volume: Tensor) -> dict[str, Any]:
        """What is kept by a representation with scores [M] of candidates and [P] of places."""
        volume, candidates = kept_shares(self.weights, of_rays, of_volume, LOST_SURFACE_MASS)
        return {"kept_reached_volume": round(volume, 5), "kept_candidates": round(candidates, 5)}

    def scores_of(
        self, score: Callable[[Tensor], Tensor] | Tensor, lost: float
    ) -> Iterator[tuple[Tensor, Tensor, dict[str, int]]]:
        """Scores of the candidates [M] and the places [P] by a function of mapped positions; or by
        a grid [n, n, n] as it is, then dilated by a cell, each with the `octree_bytes` of what it
        keeps where a share of the weights is lost."""
        if not isinstance(score, Tensor):
            yield in_parts(score, self.mapped), in_parts(score, self.volume), {}
            return
        for cells in (score, field_grids.dilate(score)):
            of_rays, of_volume = (
                field_grids.look_up_scores(cells, self.box, places)
                for places in (self.mapped, self.volume)
            )
            kept = cells >= threshold_losing(self.weights, of_rays, lost)
            yield of_rays, of_volume, {"octree_bytes": field_grids.octree_bytes(kept)}

    def kept_by_score(self, score: Callable[[Tensor], Tensor] | Tensor) -> dict[str, Any]:
        """What is kept by a representation as of `scores_of`; by a grid `dilated` or as it is,
        whichever keeps less."""
        rows = [
            self.kept_by(*scores) | facts
            for *scores, facts in self.scores_of(score, LOST_SURFACE_MASS)
        ]
        best = min(rows, key=lambda one: one["kept_reached_volume"])
        return best | ({} if len(rows) == 1 else {"dilated": best is not rows[0]})


def near_points(points: Tensor) -> Callable[[Tensor], Tensor]:
    """A score [N] of mapped positions [N, 3]: the nearer the closest of points [P, 3], the more."""
    tree = cKDTree(points.cpu().numpy())

    def score(mapped: Tensor) -> Tensor:
        return -torch.from_numpy(tree.query(mapped.cpu().numpy())[0]).to(mapped)

    return score


def _kept_by_grids(
    mixture: Mixture, resolutions: Sequence[int], taught: Tensor, ground: Ground
) -> tuple[list[dict[str, Any]], list[int]]:
    """Facts of grids of the field, which hold its density at the mapped places `taught` [M, 3] too;
    and the resolutions for which there is no memory or no time."""
    rows, left_out = [], []

    def density(mapped: Tensor) -> Tensor:
        return in_parts(lambda part: mixture.answers(part).sigmas, mapped)

    def floor_of(scores: Tensor) -> float:
        of_rays = field_grids.look_up_scores(scores, ground.box, ground.mapped)
        return threshold_losing(ground.weights, of_rays, SPARED * LOST_SURFACE_MASS)

    most = MOST_ON_CPU if mixture.device.type == "cpu" else math.inf
    known = taught, density(taught)
    grids = field_grids.fill_grids(density, ground.box, known, resolutions, floor_of, most)
    for n, (scores, seconds) in zip(resolutions, grids):
        if scores is None:
            left_out.append(n)
            continue
        size = {"resolution": n, "bytes": math.ceil(n**3 / 8), "update_seconds": round(seconds, 3)}
        rows.append({**size, **ground.kept_by_score(scores)})
    return rows, left_out


def _measured(mixture: Mixture, datamanager: Any) -> tuple[Tensor, Tensor, Tensor]:
    """Candidates of held-out rays before the backdrop: mapped positions [M, 3], weights near
    surfaces [M], and o(x) [M]."""
    rays, _ = held_out_rays(mixture, datamanager, CALIBRATION.rays)
    pieces = []
    for some in in_chunks(rays, CALIBRATION.rays_at_once):
        found = dense_reference(mixture, some)
        before = ~found.always_kept
        places = mapped_middles(mixture.region.space, some, found.intervals)
        weights = found.weights * found.near_surface
        pieces.append((places[before], weights[before], found.occupancies[before]))
    places, weights, occupancies = (torch.cat(parts) for parts in zip(*pieces))
    return places, weights, occupancies


def mapped_box(mixture: Mixture) -> ViewBox:
    """`inspection.mapped_box` of a mixture, within the cube and on the mixture's device."""
    box = inspection.mapped_box(mixture.occupancy())
    return ViewBox(*(end.clamp(-1.0, 1.0).to(mixture.device) for end in (box.low, box.high)))


def reached_volume(mixture: Mixture, taught: Tensor, count: int, seed: int = 0) -> Tensor:
    """Mapped positions [P, 3], P <= count, spread evenly over what rays reach of the scene's box:
    the cells of their mapped candidates `taught` [M, 3]."""
    positions = whole_box(mixture.occupancy()).draw(count, seed).to(mixture.device)
    mapped = mixture.region.space.map(positions).clamp(-1.0, 1.0)
    return mapped[is_reached(taught, mapped)]


def is_reached(taught: Tensor, mapped: Tensor) -> Tensor:
    """Which mapped positions [P, 3] share a cell of seen space with `taught` ones [M, 3]: [P]."""
    found = torch.zeros(CELLS**3, dtype=torch.bool, device=taught.device)
    found[cells_at(taught)] = True
    return found[cells_at(mapped)]


def rays_of_photographs(datamanager: Any, count: int) -> RayBundle:
    """Rays anywhere in the training photographs. The pixels and the random numbers of training are
    not touched."""
    cameras = datamanager.train_dataset.cameras.to("cpu")
    generator = torch.Generator().manual_seed(0)
    numbers = torch.randint(len(cameras), (count, 1), generator=generator)
    sizes = torch.cat([cameras.height[numbers[:, 0]], cameras.width[numbers[:, 0]]], dim=-1)
    coordinates = torch.rand(count, 2, generator=generator) * sizes
    bundle: RayBundle = cameras.generate_rays(camera_indices=numbers, coords=coordinates)
    return bundle


@torch.no_grad()
def candidates_of(mixture: Mixture, bundle: RayBundle) -> Tensor:
    """Mapped middles [M, 3] of all candidates of rays, backdrops left out."""
    bundle = bundle.to(mixture.device)
    rays = mixture.rays(bundle.origins, bundle.directions, None)
    pieces = []
    for some in in_chunks(rays, CALIBRATION.rays_at_once):
        intervals = mixture.with_backdrops(some, mixture.candidates(some))
        middles = mapped_middles(mixture.region.space, some, intervals)
        pieces.append(middles[~backdrop_of(intervals, some)])
    return torch.cat(pieces)


FROM_REPORT = (
    *("train_seconds", "empty_fraction", "lost_mass"),
    *("threshold", "lost_surface_mass", "image_price_db"),
)
MOST_SURFACE_POINTS = 100_000
AIR_POINTS = 50_000
"""Positions drawn over the city; those in or near matter are then left out."""


def take_occupancy(
    trainer: Any, scene: Path, out: Path
) -> tuple[Occupancy, dict[str, Any], CityTruth | None] | None:
    """Copies the occupancy that a run on a scene's folder has left to the folder `out`.

    Returns:
        None where the run left none. Otherwise the occupancy; its sizes, calibration, and the
        comparison with the exact scene, JSON values; and that scene, None where it is no city.
    """
    file, manager = trainer.base_dir / FILE_NAME, trainer.pipeline.datamanager
    if not file.exists():
        return None
    shutil.copyfile(file, out / FILE_NAME)
    occupancy, truth = Occupancy.load(file, trainer.pipeline.device), None
    report = occupancy.report
    measured: dict[str, Any] = {"kept_surface_recall": None, "free_space_skipped": None}
    if (scene / DESCRIPTION).is_file():
        truth = CityTruth.from_dataparser(scene, manager.train_dataparser_outputs)
        highest = float(manager.train_dataset.cameras.camera_to_worlds[:, 2, 3].max())
        box = torch.tensor(report["aabb"])
        measured = compare_with_truth(occupancy, truth, box, report["step_size"], highest)
    facts: dict[str, Any] = {"params": occupancy.num_params, "bytes": file.stat().st_size}
    for name in ("recoveries", CALIBRATED_AT):  # not every file says
        facts[name] = report.get(name)
    facts |= {name: report[name] for name in FROM_REPORT} | measured
    return occupancy, finite_or_null(facts), truth


def compare_with_truth(
    occupancy: Occupancy, truth: CityTruth, aabb: Tensor, step_size: float, highest: float
) -> dict[str, Any]:
    """What an occupancy keeps of the surfaces of the city, and skips of its air.

    Args:
        truth: the city in the model's coordinates.
        aabb: [6] the box in which rays are marched, scene units; far walls are no limit.
        step_size: of marching, scene units.
        highest: z of the highest camera, scene units.
    Returns:
        `kept_surface_recall`: share of the surface points in the middle of the test pixels that
        are kept; `free_space_skipped`: share of `free_points` that are skipped. Each is None where
        there is no such point.
    """
    surface = truth.visible_surface("test")
    order = torch.randperm(len(surface), generator=torch.Generator().manual_seed(0))
    air = free_points(truth, surface, aabb, step_size, highest)
    chosen = surface[order[:MOST_SURFACE_POINTS]]
    recalled, kept = (ask(occupancy, occupancy.occupied, points) for points in (chosen, air))
    return {"kept_surface_recall": _share(recalled), "free_space_skipped": _share(~kept)}


def free_points(
    truth: CityTruth, surface: Tensor, aabb: Tensor, step_size: float, highest: float
) -> Tensor:
    """Positions spread evenly over the air of the city, between its ground and its cameras.

    Args:
        surface: [P, 3] visible surface points, whose extent is that of the city.
    Returns:
        [F, 3] inside `aabb`, outside matter, and farther than a step from every surface.
    """
    aabb = aabb.detach().cpu()
    low, high = surface.amin(dim=0), surface.amax(dim=0)
    high[2] = max(highest, float(high[2]))
    low, high = torch.maximum(low, aabb[:3]), torch.minimum(high, aabb[3:])
    unit = torch.rand(AIR_POINTS, 3, generator=torch.Generator().manual_seed(0))
    points = low + unit * (high - low)
    points = points[~truth.occupied(points)]
    return points[truth.distance(points) * truth.scale > step_size]


def _share(mask: Tensor) -> float | None:
    return round(float(mask.double().mean()), 5) if len(mask) else None
