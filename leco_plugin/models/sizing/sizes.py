"""Sizes of gate, field and batches: the largest for each device, and those of the paper."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

from leco_plugin.models.encodings import EncodingConfig
from leco_plugin.models.field import FieldConfig
from leco_plugin.models.gate import GateConfig
from leco_plugin.models.hmoe import HMoEConfig

CLI = "--pipeline.model.sizes"
"""How messages name an option of these."""


@dataclass(frozen=True)
class Sizes:
    """Everything whose best value depends on how much the machine can compute."""

    gate: GateConfig = field(default_factory=GateConfig)
    """The gating network."""
    field: FieldConfig = field(default_factory=FieldConfig)
    """The radiance field with its experts."""
    learn_candidates: int = 32
    """Candidates along a ray while the occupancy is learned."""
    guided_batch: float = 3.0
    """Most rays of a batch, as a multiple of those of the config: where samples are skipped, while
    learning too, the batch grows until it shades as many as before."""
    candidates: int = 128
    """Candidates along a ray once the occupancy guides, and in every rendering."""
    largest_table: int | None = None
    """Binary logarithm of the entries of the largest hash table that is chosen; None is that of the
    device."""


SMALL = Sizes()
"""Two CPU cores: a training step of about a tenth of a second."""

LARGE = Sizes(
    gate=GateConfig(EncodingConfig(octaves=8), width=64, layers=3, scene_experts=8),
    field=FieldConfig(
        EncodingConfig(kind="hash", levels=12, features=4, log2_table=19, finest=4096),
        HMoEConfig(scene_experts=8, width=128, layers=3),
        appearance_dim=32,
        color_width=128,
    ),
    learn_candidates=96,
    candidates=512,
)
"""One GPU."""

PAPER = Sizes(
    gate=GateConfig(EncodingConfig(octaves=12), width=256, layers=3, scene_experts=8),
    field=FieldConfig(
        EncodingConfig(kind="frequency", octaves=12),
        HMoEConfig(scene_experts=8, width=256, layers=7, skip=3, residual=False),
        appearance_dim=48,
        color_width=128,
        direction_octaves=4,
    ),
    learn_candidates=257,
    guided_batch=1.0,
    candidates=257,
)
"""The sizes of the paper: 8 scene experts of 7 layers of 256 units, 257 samples."""


def sizes_for(device_type: str) -> Sizes:
    """The largest automatic sizes of a device: `cpu`, `cuda` or `mps`."""
    return LARGE if device_type == "cuda" else SMALL


AUTOMATIC = 0
"""In place of a size: it is chosen from the scene and the device before training."""

CHOSEN = (
    "field.encoding.finest",
    "field.encoding.levels",
    "field.encoding.log2_table",
    "field.experts.scene_experts",
    "field.experts.width",
    "gate.encoding.octaves",
    "gate.scene_experts",
    "gate.width",
)
"""The sizes that `scene_sizes.choose` can choose."""


def size_at(sizes: Any, path: str) -> Any:
    """The value at a dotted path."""
    for name in path.split("."):
        sizes = getattr(sizes, name)
    return sizes


def with_size(sizes: Any, path: str, value: int) -> Any:
    """The same sizes with another value at a dotted path."""
    name, _, rest = path.partition(".")
    return replace(sizes, **{name: with_size(getattr(sizes, name), rest, value) if rest else value})


def automatic(sizes: Sizes) -> Sizes:
    """The same with everything left open that can be chosen."""
    for path in CHOSEN:
        sizes = with_size(sizes, path, AUTOMATIC)
    return sizes


FIRST_TABLE = 16
"""Binary logarithm of a level's entries where the field only learns an occupancy for a host: in the
few hundred steps that it is there, larger tables take time and give nothing."""


def learning_only(sizes: Sizes) -> Sizes:
    """The same for a field that is left behind when the occupancy is learned."""
    table = "field.encoding.log2_table"
    smaller: Sizes = with_size(sizes, table, min(size_at(sizes, table), FIRST_TABLE))
    return replace(smaller, largest_table=FIRST_TABLE)


def left_open(sizes: Sizes) -> list[str]:
    """Paths of the sizes that are automatic."""
    return [path for path in CHOSEN if size_at(sizes, path) == AUTOMATIC]
