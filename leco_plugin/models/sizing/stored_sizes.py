"""Sizes of a resumed run: those of its checkpoint, even if its scene has changed since."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch

from leco_plugin.models.encodings import EncodingConfig
from leco_plugin.models.field import FieldConfig
from leco_plugin.models.gate import GateConfig
from leco_plugin.models.hmoe import HMoEConfig
from leco_plugin.models.sizing.sizes import CLI, Sizes, left_open, size_at, with_size
from leco_plugin.scenes.input_error import InputError

SIZES = "sizes"
"""Key in the extra state of a model."""


def to_store(sizes: Sizes, images: int) -> dict[str, Any]:
    """What gate and field are built from, as plain values."""
    return {"gate": asdict(sizes.gate), "field": asdict(sizes.field), "images": images}


def from_stored(values: dict[str, Any], sizes: Sizes) -> tuple[Sizes, int]:
    """Inverse of `to_store`; what is not of gate and field is that of `sizes`.

    Raises:
        ValueError: there is a size in it that this release does not know.
    """
    try:
        field = dict(values["field"])
        field["encoding"] = EncodingConfig(**field["encoding"])
        field["experts"] = HMoEConfig(**field["experts"])
        gate = GateConfig.from_dict(values["gate"])
        return replace(sizes, gate=gate, field=FieldConfig(**field)), int(values["images"])
    except (KeyError, TypeError) as error:
        raise ValueError(
            f"the checkpoint's sizes are of another release of this package ({error})"
        ) from None


def stored_in(extra: Any, now: tuple[Sizes, int]) -> tuple[Sizes, int]:
    """Sizes and number of images in the extra state of a model, or those that it has now.

    Raises:
        ValueError: there is a size in it that this release does not know.
    """
    values = extra.get(SIZES) if isinstance(extra, dict) else None
    return now if values is None else from_stored(values, now[0])


def sizes_in(checkpoint: Path) -> dict[str, Any] | None:
    """What `to_store` gave the model of a checkpoint of nerfstudio; None in those without."""
    state = torch.load(checkpoint, map_location="cpu", mmap=True, weights_only=True)["pipeline"]
    extras = (value for key, value in state.items() if key.endswith("_extra_state"))
    found = (extra.get(SIZES) for extra in extras if isinstance(extra, dict))
    return next((values for values in found if values is not None), None)


def sizes_to_resume(wanted: Sizes, stored: dict[str, Any]) -> Sizes:
    """The sizes of a resumed run: those it was begun with.

    Raises:
        InputError: a size set by hand is another one.
    """
    try:
        sizes, _ = from_stored(stored, wanted)
    except ValueError as error:
        raise InputError(str(error)) from None
    filled = wanted
    for path in left_open(wanted):
        filled = with_size(filled, path, size_at(sizes, path))
    if filled == sizes:
        return sizes
    differing = next(
        path for path in _paths(sizes) if size_at(filled, path) != size_at(sizes, path)
    )
    raise InputError(
        f"{CLI}.{differing.replace('_', '-')} is {size_at(filled, differing)}, and the run that is "
        f"gone on with has {size_at(sizes, differing)}: leave it out, or begin a new run"
    )


def _paths(sizes: Sizes) -> list[str]:
    """Dotted paths of everything that gate and field are built from."""

    def below(values: dict[str, Any], path: str) -> list[str]:
        found: list[str] = []
        for name, value in values.items():
            at = f"{path}.{name}"
            found += below(value, at) if isinstance(value, dict) else [at]
        return found

    stored = to_store(sizes, 0)
    return below(stored["gate"], "gate") + below(stored["field"], "field")
