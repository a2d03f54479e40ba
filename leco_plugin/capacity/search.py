"""Gates and grids of growing size, and the search for the smallest gate that holds.

The threshold gives each gate the kept volume of the original, so that they differ in the loss. It
is found on rays of its own; what is declared is measured on others.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, NamedTuple

import torch
from torch import Tensor

from leco_plugin.capacity.evidence import Evidence, unlikely_at, worst
from leco_plugin.capacity.references import Bounds, Ground, Rung, verify
from leco_plugin.evaluation.clock import seconds_now
from leco_plugin.evaluation.inspection import in_parts, whole_box
from leco_plugin.learning.calibration import thresholds_below
from leco_plugin.learning.sharpening import Lesson, teach
from leco_plugin.models.encodings import EncodingConfig, Kind
from leco_plugin.models.gate import Gate, GateConfig
from leco_plugin.occupancy import Occupancy

SIZES: dict[Kind, tuple[tuple[int, ...], ...]] = {
    "frequency": ((3, 8, 1), (4, 16, 1), (5, 16, 2), (6, 32, 2), (8, 64, 2), (6, 64, 3)),
    "hash": ((4, 8, 64), (4, 10, 128), (6, 12, 256), (8, 14, 512), (8, 16, 1024)),
    "vm": ((16, 2), (32, 4), (64, 8), (128, 8)),
    "k-planes": ((16, 2, 1), (32, 2, 1), (32, 4, 1), (64, 4, 2), (128, 2, 4)),
}
"""Of the gates that `leco capacity` compares: octaves, width and layers, or `FIELDS`."""
FIELDS: dict[Kind, tuple[str, ...]] = {
    "hash": ("levels", "log2_table", "finest"),
    "vm": ("plane_cells", "components"),
    "k-planes": ("plane_cells", "features", "levels"),
}
"""Of an encoding's config, that its sizes stand for."""
FREQUENCY = (
    *((3, 8, 1), (4, 8, 1), (4, 16, 1), (4, 16, 2), (5, 16, 2), (6, 16, 2), (6, 24, 2)),
    *((6, 32, 2), (6, 32, 3), (6, 48, 3), (6, 64, 3), (8, 64, 3), (8, 96, 3), (8, 128, 4)),
)
HASH_TABLES = (6, 7, 8)
PLANES = ((16, 2), (32, 2), (64, 2), (64, 4), (128, 4))
"""Of the ladder's gates: on frequencies; binary logarithms of the entries a level of hash grids;
cells, and features or components, of K-planes and TensoRF's products."""
ENOUGH_OCTAVES = 5
"""From so many on, a gate without a norm decides as well as one with it, and answers sooner."""


@dataclass(frozen=True)
class Candidate:
    """A gate or a grid of one size, as `leco capacity` compares them."""

    family: str
    size: str
    """Of a grid, its cells along an axis."""
    gate: GateConfig | None = None
    """None for a grid."""

    @property
    def key(self) -> str:
        """Name of its file."""
        return f"{self.family}-{self.size}"

    @property
    def bytes(self) -> int:
        """A gate's numbers in bfloat16, a grid's cells in bits."""
        if self.gate is not None:
            return 2 * values_of(self.gate)
        return math.ceil(int(self.size) ** 3 / 8)


def gates() -> list[Candidate]:
    """Gates of growing size of each kind, for `leco capacity`."""
    found = []
    for kind, sizes_of_kind in SIZES.items():
        for sizes in sizes_of_kind:
            named = sizes[:2] if kind == "hash" else sizes
            found.append(Candidate(kind, "-".join(map(str, named)), gate_of(kind, *sizes)))
    return found


def grids(resolutions: Iterable[int]) -> list[Candidate]:
    return [Candidate("grid", str(n)) for n in sorted(resolutions)]


def ladder(most_values: int) -> list[GateConfig]:
    """The gates that `leco shrink` tries, by size: all that have fewer values than given. They have
    one scene expert, for o(x) is all that is asked of an occupancy."""
    found = [
        replace(gate_of("frequency", *sizes), normed=sizes[0] < ENOUGH_OCTAVES)
        for sizes in FREQUENCY
    ]
    found += [gate_of("hash", 4, table, 64) for table in HASH_TABLES]
    for sizes in PLANES:
        found += [gate_of("k-planes", *sizes, 1), gate_of("vm", *sizes)]
    counted = sorted((values_of(gate), i) for i, gate in enumerate(found))
    return [found[i] for values, i in counted if values < most_values]


def gate_of(kind: Kind, *sizes: int) -> GateConfig:
    """A gate with one scene expert, by its sizes, as `SIZES` has them."""
    if kind == "frequency":
        octaves, width, layers = sizes
        return GateConfig(EncodingConfig(octaves=octaves), width, layers, 1)
    named: dict[str, Any] = dict(zip(FIELDS[kind], sizes, strict=True))
    if named.get("levels") == 1:
        named["coarsest"] = named["plane_cells"]
    return GateConfig(EncodingConfig(kind, **named), 16, 1, 1)


def values_of(config: GateConfig) -> int:
    """Learned numbers of a gate, counted without allocating it."""
    with torch.device("meta"):
        return sum(parameter.numel() for parameter in Gate(config).parameters())


def name_of(config: GateConfig) -> str:
    encoding = config.encoding
    sizes = {
        "frequency": f"{encoding.octaves} octaves",
        "hash": f"hash {encoding.levels} x 2^{encoding.log2_table}",
        "vm": f"VM {encoding.components} x {encoding.plane_cells}",
        "k-planes": f"K-planes {encoding.levels} x {encoding.features} x {encoding.plane_cells}",
        "grid": f"grid {encoding.features} x {encoding.plane_cells}^3",
    }
    return f"{sizes[encoding.kind]}, {config.layers} x {config.width}"


STEPS, LONGER, NEARLY = 3000, 3, 3.0
"""Steps of teaching. A gate whose loss is at most `NEARLY` times what the search allows is taught
again, `LONGER` times as long."""
EMPHASIS, WEIGHT_AT_FULL = 8.0, 0.05
"""How much more a candidate with rendering weight counts, and the weight from which on it does so
fully."""
MARGIN = 0.5
"""Share of the allowed loss that a gate may use on the rays of the search, so that others hold."""
VOLUME_POINTS = 1 << 17
TAUGHT_POINTS = 1 << 18
VOLUMES = (1.0, 1.05)
"""Kept volumes that are tried, as shares of the original's."""


class Found(NamedTuple):
    """The outcome of a search: without an occupancy, nothing smaller holds."""

    occupancy: Occupancy | None
    rungs: list[Rung]


def search(
    ground: Ground,
    bounds: Bounds,
    gates: Sequence[GateConfig] | None = None,
    on_rung: Callable[[Rung], None] = lambda rung: None,
    on_progress: Callable[[float], None] = lambda share: None,
) -> Found:
    """Walks up the ladder, `gates` by size or all that are smaller than the original, and stops at
    the first that is within the bounds on unseen rays. `on_rung` gets each gate that was tried,
    `on_progress` the share of the ladder that is done."""
    original = ground.original
    gates = ladder(values_of(original.gate.config)) if gates is None else gates
    volume, kept = spread_positions(original), kept_of_box(original)
    lesson = lesson_of(original, ground.taught)
    rungs: list[Rung] = []
    looks = 0
    for number, config in enumerate(gates):
        started = seconds_now()
        parts = [(number + done) / len(gates) for done in (0.0, 1.0 / (1 + LONGER), 1.0)]
        for times, (first, last) in zip((1, LONGER), pairwise(parts)):

            def show_part(share: float, first: float = first, last: float = last) -> None:
                on_progress(first + share * (last - first))

            steps, precision = times * STEPS, original.precision
            taught = teach(config, lesson, steps, precision, on_progress=show_part)
            gate = original.with_gate(taught, 0.5, {}).eval()  # no threshold of its own yet
            rung, gate = _measure(ground, gate, bounds, volume, kept, looks + 1)
            looks = rung.look or looks
            nearly = rung.lost_surface_mass <= NEARLY * MARGIN * bounds.lost_surface_mass
            if rung.verdict == "chosen" or not nearly:
                break
        on_progress(parts[-1])
        rung.seconds = round(seconds_now() - started, 2)
        rungs.append(rung)
        on_rung(rung)
        if rung.verdict == "chosen":
            return Found(gate, rungs)
    return Found(None, rungs)


def lesson_of(original: Occupancy, taught: Evidence) -> Lesson:
    """The original's decisions on candidates of rays, and on as many places anywhere in its box."""
    anywhere = spread_positions(original, TAUGHT_POINTS, seed=6)
    decided = in_parts(original.query, anywhere) >= original.threshold
    kept = torch.cat([taught.kept, decided]).float()
    full = (taught.weights / WEIGHT_AT_FULL).clamp(max=1.0)
    emphasis = torch.cat([full, torch.zeros_like(decided, dtype=full.dtype)])
    mapped = original.space.map(torch.cat([taught.positions, anywhere])).clamp(-1.0, 1.0)
    return Lesson(mapped, kept * (1.0 + EMPHASIS * emphasis), 1.0 - kept)


def _measure(
    ground: Ground, smaller: Occupancy, bounds: Bounds, volume: Tensor, kept: float, look: int
) -> tuple[Rung, Occupancy]:
    """What is found of a gate, and the gate with the threshold that it was found with.

    The original keeps a share `kept` of places `volume` [P, 3] in its box. A look at the verifying
    rays would have the number `look`.
    """
    scores, of_volume = ground.scores(smaller, "search"), in_parts(smaller.query, volume)
    lost, holds, ratio = 0.0, False, 0.0
    for share in VOLUMES:
        smaller = smaller.with_threshold(find_threshold(of_volume, share * kept))
        losses = ground.losses(smaller, "search", unlikely_at(look), scores)
        lost = max(one.share for one in losses)
        ratio = float((of_volume >= smaller.threshold).double().mean()) / max(kept, 1e-12)
        # what is not within the bounds here needs no look at the rays that verify
        holds = all(
            one.bound <= bounds.lost_surface_mass
            and one.share
            <= MARGIN * bounds.lost_surface_mass + (1.0 - MARGIN) * reference.lost_before
            for reference, one in zip(ground.references, losses)
        )
        if holds:
            break
    config = smaller.gate.config
    params = values_of(config)
    rung = Rung(name_of(config), params, 2 * params, round(ratio, 4), lost, None, "", 0.0)
    if not holds:
        rung.verdict = "loses too much"
    elif ratio > VOLUMES[-1] + 0.005:
        rung.verdict = "keeps too much"
    else:
        rung.image_price_db = ground.price(smaller, "search")
        if (rung.image_price_db or 0.0) > bounds.image_price_db:
            rung.verdict = "costs too much of the image"
        else:
            holds = verify(ground, smaller, bounds, rung, look)
            rung.verdict = "chosen" if holds else "fails on unseen rays"
    return rung, smaller


def lower_threshold(ground: Ground, bounds: Bounds) -> Occupancy | None:
    """The original at the largest lower threshold that meets what is asked of a smaller gate.

    Calibration allows a loss in the mean of some thousand held-out rays, but what is declared has
    to hold on others, too, and a smaller gate loses more than the original that teaches it. So an
    original that itself loses too much is asked to keep more.

    It shares the original's gate. None where the original meets that as it is, no threshold does,
    or nothing measures it.
    """
    original = ground.original
    absolute = ground._replace(references=[one for one in ground.references if not one.guided])
    scores = absolute.scores(original, "search")

    def meets(there: Occupancy) -> bool:
        lost = worst(absolute.losses(there, "search", unlikely_at(1), scores))
        if lost.share > MARGIN * bounds.lost_surface_mass or not bounds.allow(lost.bound, None):
            return False  # before anything is rendered
        return bounds.allow(lost.bound, absolute.price(there, "search"))

    if not absolute.references or meets(original):
        return None
    lower = map(original.with_threshold, thresholds_below(original.threshold))
    return next(filter(meets, lower), None)


def find_threshold(scores: Tensor, share: float) -> float:
    """The threshold at which a share of places, with scores [M], is kept."""
    ordered = scores.double().sort(descending=True).values
    return float(ordered[min(max(round(share * len(ordered)) - 1, 0), len(ordered) - 1)])


def kept_of_box(occupancy: Occupancy) -> float:
    """Share of an occupancy's box, or of a contracted cube, that it keeps."""
    values = in_parts(occupancy.query, spread_positions(occupancy))
    return float((values >= occupancy.threshold).double().mean())


def spread_positions(occupancy: Occupancy, count: int = VOLUME_POINTS, seed: int = 5) -> Tensor:
    """Positions [count, 3] spread evenly over the occupancy's box, or over a contracted cube."""
    device = occupancy.threshold_value.device
    if occupancy.space.kind == "contraction":
        unit = torch.rand(count, 3, generator=torch.Generator().manual_seed(seed))
        return occupancy.space.unmap(2.0 * unit.to(device) - 1.0)
    return whole_box(occupancy).draw(count, seed).to(device)
