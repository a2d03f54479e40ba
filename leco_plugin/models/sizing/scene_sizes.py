"""Sizes chosen from how much there is to see in a scene, before training: `leco-occupancy`'s own.

The measure is the texel: the footprint of a pixel at the scene's distance. A scene twice as wide
has four times as many, so it gets four times the table and, if it is large, the experts, up to the
sizes of the device. A size set by hand is kept, and sizes that depend on it follow it.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, NamedTuple

import torch

from leco_plugin.log import counted, summarize
from leco_plugin.models.compute.device import memory_of
from leco_plugin.models.sizing.sizes import (
    MOST_LEFT_BEHIND,
    Sizes,
    check,
    check_memory,
    learning_only,
    left_open,
    size_at,
    sizes_for,
    state_bytes,
    values_of,
    with_size,
)
from leco_plugin.scenes.bounds import BoundsConfig
from leco_plugin.scenes.input_error import InputError
from leco_plugin.scenes.survey import (
    CAMERAS,
    SceneDetail,
    detail_of,
    points_in,
    with_known_altitudes,
)

ENTRIES_PER_TEXEL = 2.5
"""Entries of a level of the hash table for each texel of the surface: a layer of cells has two
corners for each of its cells, and where it runs across the grid some more."""
TEXELS_PER_EXPERT = 1 << 20
"""Texels for each scene expert. With one, surveys and cities of up to 750,000 texels were learned
as well as with four or better: four exchange many of their points while they learn."""
TEXELS_OF_A_WHOLE_EXPERT = 1 << 16
"""Texels from which on a scene expert is as wide as the device's; for fewer it is narrower."""
CELLS_PER_PERIOD = 32
"""Finest cells of the field along the shortest period that the gate knows: what is occupied is
coarser than what is seen."""
UNITS_PER_FEATURE = 1.5
"""Units of the gate's hidden layers for each feature of its encoding."""
FEWEST_CELLS, FEWEST_ENTRIES, FEWEST_OCTAVES = 64, 10, 2
"""Least finest cells, binary logarithm of the table's entries, and octaves of the gate."""
GRANULE = 16
"""Widths and finest cells are multiples of this."""
SHARE_OF_MEMORY = 1 / 8
"""Most of the device's memory that automatic sizes take for weights and what trains them."""


class Choice(NamedTuple):
    """Complete sizes, and in words how they came about; no words where nothing was chosen."""

    sizes: Sizes
    lines: tuple[str, ...]


def complete(
    wanted: Sizes,
    bounds: BoundsConfig,
    metadata: dict[str, Any],
    images: int,
    device: torch.device | str,
) -> Sizes:
    """The sizes of a model on a device; those that are chosen are said in the log.

    Args:
        wanted: sizes, with `AUTOMATIC` where they are to be chosen.
        metadata: what a dataset says of itself, with its cameras (`survey.CAMERAS`) and sparse
            points; without cameras sizes are those of the device.
        images: training photographs.
    Raises:
        InputError: sizes that cannot be together, or do not fit the device.
    """
    detail = None
    if left_open(wanted) and CAMERAS in metadata:
        bounds = with_known_altitudes(bounds, metadata)
        detail = detail_of(metadata[CAMERAS], points_in(metadata), bounds)
    most = sizes_for(torch.device(device).type)
    try:
        made = choose(wanted, most, detail, images, memory_of(device))
    except ValueError as error:
        raise InputError(str(error)) from None
    summarize([summary(made.sizes, images)] if made.lines else [], made.lines)
    return made.sizes


def summary(sizes: Sizes, images: int) -> str:
    """Complete sizes in one line, for a short screen."""
    encoding, experts, gate = sizes.field.encoding, sizes.field.experts, sizes.gate
    return (
        f"sizes: field {values_of(sizes, images):,} parameters, {encoding.levels} levels of "
        f"2^{encoding.log2_table} up to {encoding.finest} cells, "
        f"{counted(experts.scene_experts, 'expert')} "
        f"{experts.width} wide; gate {gate.encoding.octaves} octaves, {gate.width} wide"
    )


def choose(
    wanted: Sizes, most: Sizes, detail: SceneDetail | None, images: int, memory: int | None = None
) -> Choice:
    """Fills in what is automatic.

    Args:
        most: complete sizes, the largest that are chosen.
        detail: None where nothing is known of the scene: all is as large as it may be.
        images: training photographs, which have codes of their own.
        memory: bytes of the device; None where it is not known.
    Raises:
        ValueError: sizes that cannot be together, or do not fit the device. One line.
    """
    if wanted.left_behind:
        most = learning_only(most)
    sizes = _filled(wanted, most, detail)
    check(sizes)
    reason = f"entries a level, {ENTRIES_PER_TEXEL:g} for each texel"
    if memory is not None:
        if not wanted.field.encoding.log2_table:
            fitting = within(sizes, images, SHARE_OF_MEMORY * memory)
            if fitting != sizes:
                sizes, reason = fitting, "entries a level, what an eighth of the memory holds"
        check_memory(sizes, images, memory)
    lines = explain(wanted, most, sizes, detail, images, reason) if left_open(wanted) else ()
    return Choice(sizes, lines)


def _filled(wanted: Sizes, most: Sizes, detail: SceneDetail | None) -> Sizes:
    """Sizes for the texels of a scene, as many as may be where they are not known."""
    texels = detail.texels if detail is not None else math.inf
    across = detail.across if detail is not None else math.inf
    top, largest, widest = most.field.encoding, most.field.experts, most.gate
    # a number that is 0 is automatic: whatever stands before `or` has been set by hand
    encoding, experts, gate = wanted.field.encoding, wanted.field.experts, wanted.gate
    finest = encoding.finest or _in_granules(across, FEWEST_CELLS, top.finest)
    # levels are about as far from one another as those of the device
    step = math.log(top.finest / top.coarsest) / max(top.levels - 1, 1)
    levels = 1 + round(math.log(max(1.0, finest / top.coarsest)) / step)
    entries = ENTRIES_PER_TEXEL * min(texels, 2.0**top.log2_table)
    log2_table = round(math.log2(max(1.0, entries)))
    encoding = replace(
        encoding,
        finest=finest,
        levels=encoding.levels or _between(2, levels, top.levels),
        log2_table=encoding.log2_table or min(max(FEWEST_ENTRIES, log2_table), top.log2_table),
    )
    wished = math.ceil(min(texels / TEXELS_PER_EXPERT, largest.scene_experts))
    chosen = _between(1, wished, largest.scene_experts)
    number = experts.scene_experts or gate.scene_experts or chosen
    # below that the values of an expert, which go with the square of its width, follow texels
    units = largest.width * math.sqrt(min(1.0, texels / TEXELS_OF_A_WHOLE_EXPERT))
    width = experts.width or _in_granules(units, GRANULE, largest.width)
    octaves = 1 + round(math.log2(max(1.0, finest / CELLS_PER_PERIOD)))
    octaves = gate.encoding.octaves or _between(FEWEST_OCTAVES, octaves, widest.encoding.octaves)
    features = 3 + 6 * octaves
    gate = replace(
        gate,
        encoding=replace(gate.encoding, octaves=octaves),
        width=gate.width or _in_granules(UNITS_PER_FEATURE * features, GRANULE, widest.width),
        scene_experts=gate.scene_experts or number,
    )
    experts = replace(experts, scene_experts=number, width=width)
    return replace(
        wanted, gate=gate, field=replace(wanted.field, encoding=encoding, experts=experts)
    )


def _between(least: int, wanted: int, most: int) -> int:
    return max(least, min(wanted, most))


def _in_granules(wanted: float, least: int, most: int) -> int:
    return _between(least, GRANULE * math.ceil(min(wanted, most) / GRANULE), most)


def within(sizes: Sizes, images: int, memory: float) -> Sizes:
    """The same with the largest table, up to its own, that fits so many bytes in training."""
    table = "field.encoding.log2_table"
    while state_bytes(sizes, images) > memory and size_at(sizes, table) > FEWEST_ENTRIES:
        sizes = with_size(sizes, table, size_at(sizes, table) - 1)
    return sizes


def explain(
    wanted: Sizes,
    most: Sizes,
    sizes: Sizes,
    detail: SceneDetail | None,
    images: int,
    table_reason: str,
) -> tuple[str, ...]:
    """For the log: what was counted, and each size that could be chosen with its reason; arguments
    as for `choose`."""
    head = "sizes of the device; nothing is known of the scene:"
    if detail is not None:
        head = (
            f"sizes for a surface of {detail.texels:,.0f} texels in {detail.pixels:,} pixels of "
            f"{counted(detail.images, 'photograph')}, in a cube of {detail.across:,.0f} texels a "
            "side:"
        )

    def row(name: str, at: str, reason: str, power: bool = False) -> str:
        by_hand, top, size = (size_at(each, at) for each in (wanted, most, sizes))
        left_behind = wanted.left_behind and at in MOST_LEFT_BEHIND
        where = "for a field that only learns an occupancy" if left_behind else "on this device"
        why = reason if size < top else f"the most {where}; {reason}"
        text = f"2^{size}" if power else str(size)
        return f"  {name:15}{text:>6}  {'set by hand' if by_hand else why}"

    alike = "as many as the gate's, which are set by hand"
    an_expert = alike if wanted.gate.scene_experts else f"one for {TEXELS_PER_EXPERT:,} texels"
    narrower = f"narrower below {TEXELS_OF_A_WHOLE_EXPERT:,} texels"
    a_period = f"a period of {CELLS_PER_PERIOD} finest cells"
    rows = (
        row("finest cells", "field.encoding.finest", "no larger than a texel"),
        row("levels", "field.encoding.levels", "up to the finest cells"),
        row("hash table", "field.encoding.log2_table", table_reason, power=True),
        row("scene experts", "field.experts.scene_experts", an_expert),
        row("expert width", "field.experts.width", narrower),
        row("gate octaves", "gate.encoding.octaves", a_period),
        row("gate width", "gate.width", f"{UNITS_PER_FEATURE:g} units for each feature"),
    )
    return head, *rows, f"  {values_of(sizes, images):,} parameters of gate and field"
