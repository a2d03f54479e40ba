"""Lengths and altitudes in the units of a dataset, in metres where the dataset knows them.

Dataparsers turn, move and scale a scene; what they say they did leads back to its own units.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch

from leco_plugin.scenes.frames import inverse, parsed_frame

METRES_PER_UNIT = "leco_metres_per_unit"
"""Key of a dataparser's metadata: metres in a unit of the dataset's own poses, float."""
ALTITUDES = "leco_altitudes"
"""Key of a dataparser's metadata: z of the ground and of the top, scene units, two floats."""
UP_IS_KNOWN = "leco_up_is_known"
"""Key of a dataparser's metadata: there where z is up in the dataset already."""
UPRIGHT = 0.94
"""Cosine of 20 degrees. An axis of the dataset that is this near to the model's z is up there."""


@dataclass(frozen=True)
class DatasetUnits:
    """What a scene unit and the scene's z = 0 are in the dataset's own coordinates."""

    per_scene_unit: float
    """Metres, or units of the dataset's poses, in a scene unit."""
    zero: float
    """Altitude of the scene's origin in the same units: along the dataset's own axis where one is
    up, for a tilt of a hundredth of a degree is a kilometre in coordinates of UTM; else along the
    model's z."""
    metric: bool
    """Whether these units are metres."""

    def altitude(self, z: float) -> float:
        """Altitude of a scene coordinate z."""
        return self.per_scene_unit * z + self.zero

    @property
    def name(self) -> str:
        return "metres" if self.metric else "data units"


def units_of(datamanager: Any, metres_per_unit: float | None = None) -> DatasetUnits | None:
    """The units of a data manager's dataset; None where its dataparser does not say what it did.

    Args:
        metres_per_unit: of the dataset's own poses; None takes what the dataparser knows.
    Raises:
        ValueError: not a positive number of metres.
    """
    outputs = getattr(datamanager, "train_dataparser_outputs", None)
    scale = float(getattr(outputs, "dataparser_scale", 0.0))
    if outputs is None or not 0.0 < scale < math.inf:
        return None
    known = metres_per_unit
    if known is None:
        known = (outputs.metadata or {}).get(METRES_PER_UNIT)
    if known is not None and not 0.0 < float(known) < math.inf:
        raise ValueError(f"a unit of the dataset is a positive number of metres, not {known}")
    metres = 1.0 if known is None else float(known)
    frame = parsed_frame(outputs)
    up = frame[2, :3] / scale
    near = up.abs().argmax()
    if float(up[near].abs()) > UPRIGHT:
        up = torch.zeros_like(up).index_fill_(0, near, up[near].sign())
    return DatasetUnits(
        metres / scale, metres * float(up @ inverse(frame)[:, 3]), known is not None
    )
