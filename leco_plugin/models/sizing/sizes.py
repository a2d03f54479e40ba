"""Sizes of gate, field and batches: those of a device, of the paper, and of a resumed run; and what
cannot be built or trained."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import torch

from leco_plugin.models.encodings import EncodingConfig
from leco_plugin.models.field import FieldConfig, HMoEField
from leco_plugin.models.gate import LARGEST_SIZES, Gate, GateConfig, check_ranges, check_sizes
from leco_plugin.models.hmoe import HMoEConfig
from leco_plugin.scenes.input_error import InputError

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
    left_behind: bool = False
    """Whether the field only learns an occupancy for a host. What is chosen is then small: tables
    of 2^16 entries at most, and one scene expert."""


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


MOST_LEFT_BEHIND = {
    "field.encoding.log2_table": 16,
    "field.experts.scene_experts": 1,
    "gate.scene_experts": 1,
}
"""The most of each where the field only learns an occupancy for a host. In the few hundred steps
that it is there, larger tables take time and give nothing, and several experts take time, and now
and then exchange most of their points at once: the field is then worth nothing for some steps."""


def learning_only(sizes: Sizes) -> Sizes:
    """The same for a field that is left behind when the occupancy is learned."""
    for path, most in MOST_LEFT_BEHIND.items():
        sizes = with_size(sizes, path, min(size_at(sizes, path), most))
    return replace(sizes, left_behind=True)


def left_open(sizes: Sizes) -> list[str]:
    """Paths of the sizes that are automatic."""
    return [path for path in CHOSEN if size_at(sizes, path) == AUTOMATIC]


SIZES = "sizes"
"""Key in the extra state of a model."""
MARCHED = ("candidates", "learn_candidates")
"""Sizes from which the steps along rays are found, once in a run."""


def to_store(sizes: Sizes, images: int) -> dict[str, Any]:
    """What gate and field are built from and how rays are marched, as plain values."""
    stored = {"gate": asdict(sizes.gate), "field": asdict(sizes.field), "images": images}
    return stored | {name: getattr(sizes, name) for name in MARCHED}


def from_stored(values: dict[str, Any], sizes: Sizes) -> tuple[Sizes, int]:
    """Inverse of `to_store`; what it does not hold is that of `sizes`. InputError if there is a
    size in it that this release does not know."""
    try:
        field = dict(values["field"])
        field["encoding"] = EncodingConfig(**field["encoding"])
        field["experts"] = HMoEConfig(**field["experts"])
        gate = GateConfig.from_dict(values["gate"])
        marched: dict[str, Any] = {name: int(values[name]) for name in MARCHED}
        found = replace(sizes, gate=gate, field=FieldConfig(**field), **marched)
        return found, int(values["images"])
    except (KeyError, TypeError) as error:
        raise InputError(
            f"the checkpoint's sizes are of another release of this package ({error})"
        ) from None


def sizes_in(checkpoint: Path) -> dict[str, Any] | None:
    """What `to_store` gave the model of a checkpoint of nerfstudio; None in those without."""
    state = torch.load(checkpoint, map_location="cpu", mmap=True, weights_only=True)["pipeline"]
    extras = (value for key, value in state.items() if key.endswith("_extra_state"))
    found = (extra.get(SIZES) for extra in extras if isinstance(extra, dict))
    return next((values for values in found if values is not None), None)


def sizes_to_resume(wanted: Sizes, stored: dict[str, Any]) -> Sizes:
    """The sizes of a resumed run: those it was begun with. InputError if a size set by hand is
    another one."""
    sizes, _ = from_stored(stored, wanted)
    filled = wanted
    for path in left_open(wanted):
        filled = with_size(filled, path, size_at(sizes, path))
    for path in _differing(filled, sizes):
        raise InputError(
            f"{CLI}.{path.replace('_', '-')} is {size_at(filled, path)}, and the run that is "
            f"gone on with has {size_at(sizes, path)}: leave it out, or begin a new run"
        )
    return sizes


def _differing(some: Any, others: Any) -> Iterator[str]:
    """Dotted paths of the sizes that two have otherwise."""
    for name in (each.name for each in fields(some)):
        one, other = getattr(some, name), getattr(others, name)
        if is_dataclass(one):
            yield from (f"{name}.{path}" for path in _differing(one, other))
        elif one != other:
            yield name


BYTES_PER_VALUE = 16
"""A float32 weight, its gradient, and the two moments of Adam."""
LARGEST_IN_FIELD = {**LARGEST_SIZES, "log2_table": 28, "empty_layers": 64}
"""Of the field, which no file has to hold."""


def values_of(sizes: Sizes, images: int) -> int:
    """Learned values of gate and field together; each training photograph has a code."""
    with torch.device("meta"):
        modules = Gate(sizes.gate), HMoEField(sizes.field, images)
    return sum(p.numel() for module in modules for p in module.parameters())


def state_bytes(sizes: Sizes, images: int) -> int:
    """What training gate and field takes for weights and optimizer."""
    return BYTES_PER_VALUE * values_of(sizes, images)


LEAST_BATCH = 0.125
"""Batches are rounded to eighths of those of the config."""


def check(sizes: Sizes) -> None:
    """ValueError, before anything is allocated, for what cannot be built: it says in one line what
    does not go together and what to change."""
    check_sizes(sizes.gate)
    _check_field(sizes)
    for name in MARCHED:
        if getattr(sizes, name) < 1:
            raise ValueError(f"{CLI}.{name.replace('_', '-')} is {getattr(sizes, name)}, below 1")
    if not LEAST_BATCH <= sizes.guided_batch < math.inf:
        raise ValueError(
            f"{CLI}.guided-batch is {sizes.guided_batch}, not a number of at least {LEAST_BATCH}"
        )
    if sizes.gate.scene_experts > sizes.field.experts.scene_experts:
        raise ValueError(
            f"the gate sends points to {sizes.gate.scene_experts} scene experts and the field has "
            f"{sizes.field.experts.scene_experts}: set {CLI}.gate.scene-experts and "
            f"{CLI}.field.experts.scene-experts alike, or only one of them"
        )


def check_memory(sizes: Sizes, images: int, memory: int) -> None:
    """ValueError, in one line, if training needs more than these bytes of a device."""
    needed = state_bytes(sizes, images)
    if needed > memory:
        lower = {"frequency": "experts.width", "hash": "encoding.log2-table"}
        largest = lower.get(sizes.field.encoding.kind, "encoding.plane-cells")
        raise ValueError(
            f"training gate and field of these sizes takes {needed / 1e9:.1f} GB for weights and "
            f"optimizer alone, and the device has {memory / 1e9:.1f}: lower {CLI}.field.{largest}"
        )


def _check_field(sizes: Sizes) -> None:
    encoding, experts = sizes.field.encoding, sizes.field.experts
    check_ranges("field", {**vars(encoding), **vars(experts)}, LARGEST_IN_FIELD)
    for name, least in (("appearance_dim", 0), ("direction_octaves", 0), ("color_width", 1)):
        if getattr(sizes.field, name) < least:
            raise ValueError(f"the field's {name} is {getattr(sizes.field, name)}, below {least}")
    if experts.skip is not None and not 0 <= experts.skip < experts.layers:
        raise ValueError(
            f"{CLI}.field.experts.skip is {experts.skip}, and an expert has the layers 0 to "
            f"{experts.layers - 1}: name one of them, or None"
        )
    if encoding.kind == "hash":
        if encoding.finest < encoding.coarsest:
            raise ValueError(
                f"the field's finest level has {encoding.finest} cells and its coarsest "
                f"{encoding.coarsest}: raise {CLI}.field.encoding.finest"
            )
        if encoding.levels << encoding.log2_table >= 2**31:
            raise ValueError(
                f"{encoding.levels} levels of 2^{encoding.log2_table} entries are more than rows "
                f"can be numbered: lower {CLI}.field.encoding.log2-table"
            )
