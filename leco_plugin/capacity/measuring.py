"""Representations, and what each keeps and loses: on the same rays, at the same loss or volume."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor

from leco_plugin.capacity.field import Ground
from leco_plugin.evaluation.equal_loss import (
    MOST_ON_CPU,
    SPARED,
    kept_shares,
    mapped_box,
    threshold_losing,
)
from leco_plugin.evaluation.field_grids import (
    FieldGrids,
    density_of,
    in_parts,
    looked_up,
    plain_and_dilated,
)
from leco_plugin.models.encodings import EncodingConfig
from leco_plugin.models.gate import GateConfig, occupancy_logit
from leco_plugin.occupancy import Precision, gate_precision
from leco_plugin.shrink.evidence import Evidence
from leco_plugin.shrink.ladder import values_of
from leco_plugin.shrink.search import threshold_keeping
from leco_plugin.shrink.teaching import Lesson, round_weights, teach

STEPS = 1000
"""With which each gate is taught. After 300 small ones still keep two to nine times what they keep
after 1000 (docs/decisions.md)."""
VOLUMES = (0.01, 0.015, 0.02, 0.03, 0.04, 0.06, 0.08, 0.11, 0.15, 0.2, 0.3, 0.45)
"""Kept volumes at which the loss is noted."""
FAMILIES = ("frequency", "hash", "vm", "k-planes", "grid")


@dataclass(frozen=True)
class Candidate:
    """A representation of one size."""

    family: str
    size: str
    gate: GateConfig | None = None
    resolution: int | None = None

    @property
    def key(self) -> str:
        """Of its file."""
        return f"{self.family}-{self.size}".replace(" ", "-")

    @property
    def bytes(self) -> int:
        """A gate's numbers in bfloat16, a grid's cells in bits."""
        if self.gate is not None:
            return 2 * values_of(self.gate)
        assert self.resolution is not None
        return math.ceil(self.resolution**3 / 8)


def gates() -> list[Candidate]:
    """Gates of growing size of each kind."""
    found = [
        Candidate("frequency", f"{o}-{w}-{n}", GateConfig(EncodingConfig(octaves=o), w, n, 1))
        for o, w, n in (
            (3, 8, 1),
            (4, 16, 1),
            (5, 16, 2),
            (6, 32, 2),
            (8, 64, 2),
            (6, 64, 3),
        )
    ]
    found += [
        Candidate(
            "hash",
            f"{n}-{t}",
            GateConfig(EncodingConfig("hash", levels=n, log2_table=t, finest=finest), 16, 1, 1),
        )
        for n, t, finest in ((4, 8, 64), (4, 10, 128), (6, 12, 256), (8, 14, 512), (8, 16, 1024))
    ]
    for cells, features in ((16, 2), (32, 4), (64, 8), (128, 8)):
        found.append(
            Candidate(
                "vm",
                f"{cells}-{features}",
                GateConfig(EncodingConfig("vm", components=features, plane_cells=cells), 16, 1, 1),
            )
        )
    for cells, features, levels in ((16, 2, 1), (32, 2, 1), (32, 4, 1), (64, 4, 2), (128, 2, 4)):
        found.append(
            Candidate(
                "k-planes",
                f"{cells}-{features}-{levels}",
                GateConfig(
                    EncodingConfig(
                        "k-planes",
                        levels=levels,
                        features=features,
                        coarsest=16 if levels > 1 else cells,
                        plane_cells=cells,
                    ),
                    *(16, 1, 1),
                ),
            )
        )
    return found


def grids(resolutions: tuple[int, ...]) -> list[Candidate]:
    """Grids by their cells along an axis."""
    return [Candidate("grid", str(n), resolution=n) for n in sorted(resolutions)]


def measured(evidence: Evidence, scores: Tensor, of_volume: Tensor, lost: float) -> dict[str, Any]:
    """What a representation keeps when it loses a given share, and loses when it keeps a given one.

    Args:
        evidence: dense candidates.
        scores: [M] of those candidates.
        of_volume: [P] of places spread evenly over what rays reach of the scene's box.
        lost: share of the weight near surfaces.
    """
    volume, candidates = kept_shares(evidence.worth, scores, of_volume, lost)
    total = float(evidence.worth.double().sum())
    losses = [
        float(evidence.worth[scores < threshold_keeping(of_volume, share)].double().sum()) / total
        for share in VOLUMES
    ]
    return {
        "kept_volume": volume,
        "kept_candidates": candidates,
        "lost_at_volumes": losses,
    }


def of_gate(ground: Ground, candidate: Candidate, lost: float) -> dict[str, Any]:
    """Teaches a gate and measures it, as it would be stored and asked."""
    assert candidate.gate is not None
    started = time.monotonic()
    score = taught_score(candidate.gate, ground.lesson, ground.model.precision)
    scores, of_volume = in_parts(score, ground.mapped), in_parts(score, ground.volume)
    return _row(candidate, started, measured(ground.held_out, scores, of_volume, lost))


def taught_score(
    config: GateConfig, lesson: Lesson, precision: Precision
) -> Callable[[Tensor], Tensor]:
    """The logit of a gate that is taught now, as it would be stored and asked: of mapped positions
    [N, 3], [N]."""
    gate = round_weights(teach(config, lesson, STEPS, precision))

    @torch.no_grad()
    def score(mapped: Tensor) -> Tensor:
        with gate_precision(mapped.device.type, precision):
            return occupancy_logit(gate(mapped))

    return score


def of_grids(
    ground: Ground, candidates: Sequence[Candidate], lost: float
) -> Iterator[tuple[Candidate, dict[str, Any]]]:
    """Fills grids from the field's density, each from one half as fine; yields a row for each.

    They hear of the places that gates are taught by, and of random ones, and are dilated by a cell
    where they keep less so. Ends with the first that would ask the field more often than
    `MOST_ON_CPU` on a CPU.

    Args:
        candidates: by resolution.
        lost: share of the weight near surfaces.
    """
    density = partial(density_of, ground.model)
    box = mapped_box(ground.model)
    places = ground.lesson.mapped

    def floor_of(scores: Tensor) -> float:
        of_rays = looked_up(scores, box, ground.mapped)
        return threshold_losing(ground.held_out.worth, of_rays, SPARED * lost)

    most = MOST_ON_CPU if ground.model.device.type == "cpu" else math.inf
    grids = FieldGrids(density, box, (places, density(places)), floor_of, most)
    for candidate in candidates:
        started = time.monotonic()
        assert candidate.resolution is not None
        scores = grids.fill((candidate.resolution,) * 3)
        if scores is None:
            return
        both = [
            measured(ground.held_out, of_rays, of_volume, lost)
            for of_rays, of_volume in plain_and_dilated(scores, box, ground.mapped, ground.volume)
        ]
        yield candidate, _row(candidate, started, min(both, key=lambda one: one["kept_volume"]))


def _row(candidate: Candidate, started: float, found: dict[str, Any]) -> dict[str, Any]:
    return {
        "family": candidate.family,
        "size": candidate.size,
        "bytes": candidate.bytes,
        "seconds": round(time.monotonic() - started, 2),
        **found,
    }
