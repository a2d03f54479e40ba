"""The exact city in a model's own coordinates, so that occupancy is measured and not estimated.

nerfstudio moves and shrinks a scene before a model sees it: x_model = scale * (R x + t), with
[R | t] the dataparser's transform. Here the way back is taken.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from leco_plugin.scenes.city.city import City, read_description
from leco_plugin.scenes.city.folder import CaptureConfig, read_transforms
from leco_plugin.scenes.mega_nerf_files import TO_DRB


@dataclass
class CityTruth:
    """A city seen through a dataparser's transform."""

    city: City
    folder: Path
    transform: Tensor
    """[3, 4] from metres to model axes, before scaling."""
    scale: float
    """Model units in a metre."""

    @classmethod
    def from_dataparser(cls, folder: Path | str, outputs: Any) -> CityTruth:
        """From a city's folder and nerfstudio's `DataparserOutputs` for it. ValueError or OSError
        if the folder holds no city."""
        folder = Path(folder)
        transform = outputs.dataparser_transform.double().cpu()
        if read_description(folder)["layout"] == "mega-nerf":
            turn = torch.from_numpy(TO_DRB)  # that reader begins at (down, right, back)
            transform = torch.cat([transform[:, :3] @ turn, transform[:, 3:]], dim=1)
        return cls(City.from_folder(folder), folder, transform, float(outputs.dataparser_scale))

    def to_metres(self, positions: Tensor) -> NDArray[np.float64]:
        """Model positions [..., 3] in metres: float64 [..., 3]."""
        rotation, shift = self.transform[:, :3], self.transform[:, 3]
        return (
            (positions.detach().double().cpu() / self.scale - shift) @ torch.linalg.inv(rotation).T
        ).numpy()

    def to_model(self, positions: NDArray[np.floating]) -> Tensor:
        """Positions [..., 3] in metres as model positions: float32 [..., 3]."""
        metres = torch.as_tensor(positions, dtype=torch.float64)
        return (self.scale * (metres @ self.transform[:, :3].T + self.transform[:, 3])).float()

    def occupied(self, positions: Tensor) -> Tensor:
        """Whether model positions [..., 3] lie inside solid matter: bool [...]."""
        return self._ask(self.city.occupied, positions)

    def distance(self, positions: Tensor) -> Tensor:
        """Distance from model positions [..., 3] to the nearest surface, in metres: float32 [...].

        Times `scale`, it is in model units.
        """
        return self._ask(self.city.distance, positions).float()

    def _ask(self, question: Callable[[NDArray[Any]], NDArray[Any]], positions: Tensor) -> Tensor:
        """What the city answers at model positions [..., 3]: [...]."""
        metres = self.to_metres(positions)
        answers = question(metres.reshape(-1, 3)).reshape(metres.shape[:-1])
        return torch.from_numpy(answers).to(positions.device)

    def visible_surface(self, split: Literal["train", "val", "test"] = "test") -> Tensor:
        """The surface point at the middle of each pixel of a split's pictures, where there is one.

        Returns:
            [P, 3] float32, model coordinates.
        """
        lens = CaptureConfig(**read_description(self.folder)["capture"]).lens
        transforms = read_transforms(self.folder)
        wanted = set(transforms[f"{split}_filenames"])
        found = []
        for frame in transforms["frames"]:
            if frame["file_path"] in wanted:
                depth = lens.along_ray(
                    np.load(self.folder / frame["depth_file_path"], allow_pickle=False)
                )
                points = lens.points(np.array(frame["transform_matrix"])[:3], depth)
                found.append(self.to_model(points[np.isfinite(depth)]))
        return torch.cat(found)
