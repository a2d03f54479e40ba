"""Readers of one scene, each with coordinates of its own, and a guide that begins on one."""

from __future__ import annotations

from typing import Any

from nerfstudio.data.datamanagers.base_datamanager import VanillaDataManagerConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from torch import nn

from leco_plugin.hosts.guide import Guide
from leco_plugin.hosts.guided_start import GuidedStart, OccupancyConfig
from leco_plugin.occupancy import Occupancy


class Data:
    """What a data manager is asked for."""

    def __init__(self, config: NerfstudioDataParserConfig) -> None:
        manager: Any = VanillaDataManagerConfig(dataparser=config).setup(device="cpu")
        self.train_dataset = manager.train_dataset
        self.train_dataparser_outputs = manager.train_dataparser_outputs


class Pipe:
    """What a pipeline is asked for."""

    def __init__(self, data: Data) -> None:
        self.datamanager, self.device = data, "cpu"


def started(occupancy: Occupancy, data: Data, sampler: str = "learned-occupancy") -> Guide:
    """A guide in the coordinates of a host that reads with `data`."""
    guide = Guide(sampler)
    guide.set_occupancy(occupancy)
    GuidedStart(nn.Module(), guide, OccupancyConfig(sampler=sampler), Pipe(data))
    return guide.eval()
