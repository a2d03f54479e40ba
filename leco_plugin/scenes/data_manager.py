"""nerfstudio's data manager for rays, with photographs that stay on disk where they are many."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import torch
from nerfstudio.cameras.cameras import CameraType
from nerfstudio.data.datamanagers.base_datamanager import VanillaDataManager as Vanilla
from nerfstudio.data.datamanagers.base_datamanager import VanillaDataManagerConfig
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from nerfstudio.data.utils import dataloaders
from nerfstudio.model_components.ray_generators import RayGenerator
from torch import Tensor

from leco_plugin.log import by_number, counted, say
from leco_plugin.models.compute.device import free_memory
from leco_plugin.scenes.frames import SAME_PLACE, UP_IS_KNOWN, turn_outputs, turn_to_upright
from leco_plugin.scenes.input_error import InputError
from leco_plugin.scenes.photograph_files import names_what_it_cannot_read
from leco_plugin.scenes.pixels.held_out_pixels import (
    HeldOutPixelSampler,
    Lattice,
    held_out_sampler,
    lattice_for,
)
from leco_plugin.scenes.pixels.stored_pictures import picture_sizes, store_pictures
from leco_plugin.scenes.reading import read_checked
from leco_plugin.scenes.survey import CAMERAS, points_in
from leco_plugin.studio.run_folder import keeps_all_images

MOST_OF_MEMORY = 0.4
"""Share of the memory that is free which photographs in memory may take."""


@dataclass
class LecoDataManagerConfig(VanillaDataManagerConfig):
    """Rays of photographs, in memory or on disk"""

    _target: type = field(default_factory=lambda: LecoDataManager)
    """target class to instantiate"""
    images: Literal["auto", "memory", "disk"] = "auto"
    """memory: all photographs decoded in memory, as nerfstudio has them. disk: decoded once, one by
    one, into files, of which pixels are read. auto: on disk where they would take more than 40% of
    the memory that is free."""
    pixels: Path | None = None
    """Folder of those files; by default leco-cache/pixels beside the data."""
    upright: bool = True
    """Whether a survey from the air that its reader leaves on its side is set upright."""

    held_out_period: int | None = None
    """Of so many pixels in both directions one is never trained on, and calibrates the occupancy.
    None is what gives as many of them as are wanted: 11, in small scenes down to 5."""


class LecoDataManager(Vanilla):  # type: ignore[type-arg]
    """As nerfstudio's, but for where the photographs are, and what is up.

    Attributes:
        begun_with: of the run that is gone on with, what `get_extra_state` gave; None without one.
    """

    config: LecoDataManagerConfig
    begun_with: dict[str, Any] | None = None

    def get_extra_state(self) -> dict[str, Any]:
        """Travels with a checkpoint: where photographs were taken [P, 3], their height and width
        [P, 2], and the period of the lattice of held-out pixels, None without one."""
        dataset, sampler = self.train_dataset, held_out_sampler(self)
        return {
            "places": dataset.cameras.camera_to_worlds[:, :3, 3].float().cpu(),
            "resolutions": picture_sizes(dataset).cpu(),
            "held_out_period": None if sampler is None else sampler.lattice.period,
        }

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Notes it, for `refuse_others`: a run that is only looked at may be of other data."""
        self.begun_with = state

    def refuse_others(self) -> None:
        """InputError if photographs lie elsewhere than in the run that is gone on with, are read in
        other sizes, or other pixels of them are held out: it has trained on those."""
        now, before = self.get_extra_state(), self.begun_with
        if before is None:  # of an earlier checkpoint nothing is known
            return
        places, earlier = now["places"], before["places"]
        same_number = len(places) == len(earlier)  # a host may be given more of them
        atol = SAME_PLACE * float((earlier.amax(dim=0) - earlier.amin(dim=0)).max())
        if same_number and not torch.allclose(places, earlier, atol=atol):
            raise InputError(
                "the photographs lie elsewhere in the scene than when the run was begun: give the "
                "dataparser the options that it had, or begin a new run"
            )
        if same_number and not torch.equal(now["resolutions"], before["resolutions"]):
            height, width = before["resolutions"].amax(dim=0).tolist()
            raise InputError(
                f"the run was begun with photographs of up to {width} x {height}, and they have "
                "other sizes now: give the downscale factor that it had, or begin a new run"
            )
        period, its_own = now["held_out_period"], before["held_out_period"]
        if period != its_own:
            raise InputError(
                f"--pipeline.datamanager.held-out-period is {period}, and the run that is gone on "
                f"with has {its_own}: give that, or begin a new run"
            )

    @property
    def dataparser(self) -> Any:
        """The scene's reader, whichever it is; nerfstudio's commands ask it for splits."""
        return self._dataparser

    @dataparser.setter
    def dataparser(self, parser: Any) -> None:
        self._dataparser = parser = read_checked(parser)
        if self.config.upright:
            parser.get_dataparser_outputs = upright_outputs(parser.get_dataparser_outputs)

    def create_train_dataset(self) -> Any:
        """The training photographs; the model is told of their cameras, for its sizes."""
        dataset = names_what_it_cannot_read(super().create_train_dataset())
        dataset.metadata[CAMERAS] = dataset.cameras
        return dataset

    def create_eval_dataset(self) -> Any:
        """The test photographs; there may be none."""
        dataset = names_what_it_cannot_read(super().create_eval_dataset())
        count = len(self.train_dataset)
        if self.test_mode == "val":
            say(read_in_words(self.get_datapath(), self.train_dataset, len(dataset)))
            if len(dataset) == 0:
                say(f"no test image: the run trains on all {count} and evaluates nothing")
            both = len({*dataset.image_filenames} & {*self.train_dataset.image_filenames})
            if both > 0:
                some = counted(both, "test photograph is", "test photographs are")
                say(f"{some} trained on too: their scores say nothing of new views")
        if len(dataset) == 0:
            lack = f"{self.get_datapath()} has no test image in this run, and nothing can be"
            none: Any = NoTestImages(f"{lack} evaluated; ns-render shows what it has learned")
            self.eval_dataloader = self.fixed_indices_eval_dataloader = none
        return dataset

    def _get_pixel_sampler(self, dataset: Any, num_rays_per_batch: int) -> Any:
        """nerfstudio's choice, with the lattice and the fisheyes' radius that its images need."""
        by_hand = self.config.pixel_sampler.fisheye_crop_radius
        sampler = super()._get_pixel_sampler(dataset, num_rays_per_batch)
        of_scene = (dataset.cameras.metadata or {}).get("fisheye_crop_radius")
        factor = getattr(self.dataparser, "downscale_factor", None) or 1
        radius = by_hand
        if by_hand is None and of_scene is not None:
            radius = of_scene * dataset.scale_factor / factor
        self.config.pixel_sampler.fisheye_crop_radius = by_hand  # nerfstudio has overwritten it
        sampler.config = replace(sampler.config, fisheye_crop_radius=radius)
        if isinstance(sampler, HeldOutPixelSampler):
            fisheyes = dataset.cameras.camera_type.flatten().cpu() == CameraType.FISHEYE.value
            if radius is not None and 0 < int(fisheyes.sum()) < len(fisheyes):
                sampler.radii = torch.where(fisheyes, float(radius), math.inf)
                sampler.config.fisheye_crop_radius = None
            period, sizes = self.config.held_out_period, picture_sizes(dataset)
            sampler.lattice = lattice_for(sizes) if period is None else Lattice(period)
        return sampler

    def on_disk(self) -> bool:
        """Whether pixels are read from files. InputError if they are to be, and cannot."""
        config = self.config
        if config.images == "memory" or not keeps_all_images(config, len(self.train_dataset)):
            return False
        obstacle = None
        if not issubclass(config.pixel_sampler._target, HeldOutPixelSampler):
            obstacle = "the pixel sampler draws from images in memory only; use leco's own"
        elif self.train_dataset.mask_color:
            obstacle = "the scene's mask_color is painted over images in memory only"
        if config.images == "disk" and obstacle is not None:
            raise InputError(f"photographs on disk: {obstacle}")
        if config.images == "disk" or obstacle is not None:
            return obstacle is None
        needed = decoded_bytes(self.train_dataset) + decoded_bytes(self.eval_dataset)
        needed *= max(1, self.world_size)  # each process decodes its own
        free = free_memory()
        return free is not None and needed > MOST_OF_MEMORY * free

    def _store(self, dataset: Any, what: str) -> Any:
        """An endless iterator over the one batch of images that there is."""
        data = Path(self.config.dataparser.data)
        beside = data if data.is_dir() else data.parent
        folder = self.config.pixels or beside / "leco-cache" / "pixels"
        return itertools.repeat(store_pictures(dataset, folder, what))

    def setup_train(self) -> None:
        if not self.on_disk():
            super().setup_train()
            return
        gigabytes = decoded_bytes(self.train_dataset) / 1e9
        count = len(self.train_dataset)
        stay = by_number(count, "stays", "stay")
        say(f"{counted(count, 'photograph')}, {gigabytes:.1f} GB decoded, {stay} on disk")
        self.iter_train_image_dataloader = self._store(self.train_dataset, "photographs")
        rays = self.config.train_num_rays_per_batch
        self.train_pixel_sampler = self._get_pixel_sampler(self.train_dataset, rays)
        self.train_ray_generator = RayGenerator(self.train_dataset.cameras.to(self.device))

    def setup_eval(self) -> None:
        """Sets up what evaluation draws from; whole images are decoded when they are asked for."""
        if not self.on_disk():
            super().setup_eval()
            return
        self.iter_eval_image_dataloader = self._store(self.eval_dataset, "test photographs")
        rays = self.config.eval_num_rays_per_batch
        self.eval_pixel_sampler = self._get_pixel_sampler(self.eval_dataset, rays)
        self.eval_ray_generator = RayGenerator(self.eval_dataset.cameras.to(self.device))
        given: dict[str, Any] = {"input_dataset": self.eval_dataset, "device": self.device}
        self.fixed_indices_eval_dataloader = dataloaders.FixedIndicesEvalDataloader(**given)
        self.eval_dataloader = dataloaders.RandIndicesEvalDataloader(**given)


@dataclass
class NoTestImages:
    """Stands where nerfstudio has its loaders of test images, and says that there are none."""

    why: str

    def __len__(self) -> int:
        raise InputError(self.why)

    def __iter__(self) -> Iterator[Any]:
        raise InputError(self.why)


def upright_outputs(read: Callable[..., DataparserOutputs]) -> Callable[..., DataparserOutputs]:
    """A reader of splits, all of them turned by what the training cameras show to be up."""
    known: list[Tensor | None] = []

    def outputs_of(split: str = "train", **kwargs: Any) -> DataparserOutputs:
        outputs = read(split=split, **kwargs)
        if not known:
            training = outputs if split == "train" else read(split="train", **kwargs)
            known.append(_turn_of(training))
        return outputs if known[0] is None else turn_outputs(outputs, known[0])

    return outputs_of


LIES_DOWN = 45.0
"""Degrees from upright at which a survey is doubted to stand, whatever its file says."""


def _turn_of(outputs: DataparserOutputs) -> Tensor | None:
    """What sets a scene upright, said in the log; None where nothing is to be done."""
    turn = turn_to_upright(outputs.cameras.camera_to_worlds, points_in(outputs.metadata))
    if turn is None:
        return None
    degrees = math.degrees(math.acos(max(-1.0, min(1.0, float(turn[2, 2])))))
    if UP_IS_KNOWN in outputs.metadata:
        if degrees > LIES_DOWN:
            lies = (
                f"the survey seems to lie on its side, by {degrees:.0f} degrees, and its file says"
            )
            say(f"{lies} that z is up; if it is not, take orientation_override out of the file")
        return None
    done = f"the survey lies on its side and is set upright, by {degrees:.0f} degrees"
    say(f"{done}; --pipeline.datamanager.upright False leaves it as it is")
    return turn


def read_in_words(data: Path, training: Any, tests: int) -> str:
    """One line on what was read of a scene's folder or file."""
    sizes = picture_sizes(training)
    height, width = sizes.amax(dim=0).tolist()
    size = f"{'' if bool((sizes == sizes[0]).all()) else 'up to '}{width} x {height}"
    points = points_in(training.metadata)
    found = "no sparse points" if points is None else f"{len(points):,} sparse points"
    name = (data if data.is_dir() else data.parent).resolve().name
    counts = f"{counted(len(training), 'photograph')} to learn from, {tests} to test with"
    return f"{name}: {counts}, {size}; {found}"


def decoded_bytes(dataset: Any) -> int:
    """What all photographs of a dataset take in memory as nerfstudio decodes them, float32."""
    return 12 * int(picture_sizes(dataset).prod(dim=-1).sum())
