"""`ns-train METHOD leco-city --blocks 3`: the city is written when it is first asked for.

Imported whenever an ns-* command starts: everything that draws is imported when it is needed.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from nerfstudio.data.dataparsers.nerfstudio_dataparser import Nerfstudio, NerfstudioDataParserConfig
from nerfstudio.plugins.registry_dataparser import DataParserSpecification

from leco_plugin.studio.commands import quiet_imports_of_our_methods

quiet_imports_of_our_methods()

CACHE = Path("data/leco-city")


@dataclass
class LecoCityDataParserConfig(NerfstudioDataParserConfig):
    """A procedural city with exact truth, written on first use"""

    _target: type = field(default_factory=lambda: LecoCity)
    """target class to instantiate"""
    data: Path = CACHE
    """Folder of the city; by default data/leco-city holds one folder for each kind asked for."""
    downscale_factor: int | None = 1
    """How much to downscale images; pictures are drawn at the size asked for."""
    blocks: int = 3
    """The city covers blocks x blocks blocks."""
    seed: int = 0
    """Another seed, another city."""
    sky: bool = False
    """A sky behind the city; without it, rays that miss are transparent."""
    far_terrain: bool = False
    """A plain around the city and hills at several times its size."""
    width: int = 160
    """Width of the pictures in pixels."""
    height: int = 120
    """Height of the pictures in pixels."""

    def folder(self) -> Path:
        """Where the city lies, or will."""
        if self.data not in (CACHE, Path()):
            return self.data
        extras = ("-sky" if self.sky else "") + ("-terrain" if self.far_terrain else "")
        name = f"{self.blocks}-blocks-seed-{self.seed}{extras}-{self.width}x{self.height}"
        return CACHE / name


class LecoCity(Nerfstudio):
    """Writes the city if it is not there, then reads it as any scene, with its sparse points."""

    config: LecoCityDataParserConfig

    def __init__(self, config: LecoCityDataParserConfig) -> None:
        from leco_plugin.scenes.city.city import CityConfig
        from leco_plugin.scenes.city.folder import CaptureConfig, write_city
        from leco_plugin.scenes.input_error import InputError

        super().__init__(config)
        try:
            city = CityConfig(
                config.blocks, config.seed, sky=config.sky, far_terrain=config.far_terrain
            )
            capture = CaptureConfig(config.width, config.height)
            self.config.data = write_city(city, config.folder(), capture)
        except (ValueError, OSError) as error:
            raise InputError(f"no city could be written: {error}") from None

    def _generate_dataparser_outputs(
        self, split: str = "train", **kwargs: Any
    ) -> DataparserOutputs:
        from leco_plugin.scenes.city.folder import POINTS as FILE
        from leco_plugin.scenes.coloured_points import points_in_model, read_cloud
        from leco_plugin.scenes.frames import METRES_PER_UNIT, UP_IS_KNOWN, parsed_frame

        outputs: DataparserOutputs = super()._generate_dataparser_outputs(split)
        points = read_cloud(self.config.data / FILE)
        outputs.metadata |= points_in_model(points, parsed_frame(outputs))
        outputs.metadata |= {METRES_PER_UNIT: 1.0, UP_IS_KNOWN: True}
        return outputs


leco_city_dataparser = DataParserSpecification(
    config=LecoCityDataParserConfig(),
    description="Procedural city with exact truth: --blocks, --seed, --sky, --far-terrain.",
)
