"""`ns-train METHOD mega-nerf --data DIR`: scenes in Mega-NeRF's format, with its protocol.

Imported whenever an ns-* command starts: what reads files is imported when it is needed.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from nerfstudio.data.dataparsers.base_dataparser import (
    DataParser,
    DataParserConfig,
    DataparserOutputs,
)
from nerfstudio.plugins.registry_dataparser import DataParserSpecification

if TYPE_CHECKING:
    from leco_plugin.scenes.mega_nerf_files import MegaNerfScene


@dataclass
class MegaNerfDataParserConfig(DataParserConfig):
    """A scene in Mega-NeRF's format: Mill 19, UrbanScene3D, or your own"""

    _target: type = field(default_factory=lambda: MegaNerf)
    """target class to instantiate"""
    data: Path = Path()
    """Folder with coordinates.pt, train/ and val/."""
    protocol: Literal["half", "full"] = "half"
    """half: train on the left halves of the validation pictures, score the right halves, as
    Mega-NeRF and Switch-NeRF do. full: leave them out of training, score them whole."""
    train_scale_factor: int = 1
    """Divides the size of the pictures that are trained on."""
    val_scale_factor: int = 4
    """Divides the size of the pictures that are scored."""
    masks: Path | None = None
    """Folder of masks, say those of one cluster; by default DATA/masks where there is one."""
    cache: Path | None = None
    """Folder for resized pictures, right halves and unpacked masks; by default
    DATA/leco-cache."""
    points: Path | None = None
    """A .ply of sparse points in metres (down, right, back), which say where the ground is; by
    default DATA/points.ply where there is one."""
    ray_altitude_range: tuple[float, float] | None = None
    """Metres along the down axis at which rays are cut, top and ground, as in Mega-NeRF's own
    configurations: less is higher."""
    check_axes: bool = True
    """Whether to refuse a scene whose cameras show that its first axis does not point down."""


class MegaNerf(DataParser):
    """Reads a Mega-NeRF scene, once for all splits."""

    config: MegaNerfDataParserConfig
    _scene: MegaNerfScene | None = None

    def _generate_dataparser_outputs(
        self, split: str = "train", **kwargs: Any
    ) -> DataparserOutputs:
        from leco_plugin.scenes.mega_nerf_outputs import outputs_of, read

        self._scene = self._scene or read(self.config)
        return outputs_of(self.config, self._scene, split == "train")


mega_nerf_dataparser = DataParserSpecification(
    config=MegaNerfDataParserConfig(),
    description="A scene in Mega-NeRF's format: --protocol half|full, --val-scale-factor, --masks.",
)
