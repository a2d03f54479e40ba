"""What a nerfstudio data manager gives a learner: batches, held-out pixels, and where they lie."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from functools import cached_property
from typing import Any

import torch
from nerfstudio.cameras.rays import RayBundle
from torch import Tensor

from leco_plugin.evaluation.metrics import spread_evenly
from leco_plugin.log import counted, say
from leco_plugin.models.mixture import Mixture
from leco_plugin.models.region import SIDE, Region
from leco_plugin.models.rendering import Rays
from leco_plugin.scenes.bounds import BoundsConfig, usable_points
from leco_plugin.scenes.frames import data_frame_of, frame_of
from leco_plugin.scenes.pixels.held_out_pixels import (
    HeldOutPixelSampler,
    Lattice,
    Share,
    held_out_sampler,
    some_images,
    visible_in_test,
)
from leco_plugin.scenes.pixels.known_distances import (
    KnownDistancePixelSampler,
    SparsePixels,
    drawable,
    sampler_here,
    sparse_pixels,
)
from leco_plugin.scenes.survey import (
    MOST_CAMERAS,
    Survey,
    covering_rays,
    doubtful_cameras,
    sparse_points,
    survey,
)
from leco_plugin.seen import rays_a_side

FEW_PHOTOGRAPHS = 16
"""Below so many a scene often fails: nine of `fox`, without points, had 15 dB."""
SHARE_THAT_VOUCHES = 4
"""At most one photograph of so many is kept from teaching, to vouch for what the others taught."""


class LearningData:
    """A data manager as a learner sees it. Bounds, near and far are what is set by hand. InputError
    as `survey`."""

    def __init__(
        self, manager: Any, bounds: BoundsConfig, near: float | None, far: float | None
    ) -> None:
        self.manager = manager
        self._vouching: dict[int, Tensor] = {}
        self.survey: Survey = survey(manager, bounds, near, far)

    @cached_property
    def rays_per_batch(self) -> int:
        """Rays of a batch before any factor; may be set."""
        return int(self.manager.get_train_rays_per_batch())

    def covering_rays(self, side: int = SIDE, most: int = MOST_CAMERAS) -> tuple[Tensor, Tensor]:
        """Origins and unit directions [N, 3] of rays that cover up to `most` training images."""
        rays = covering_rays(self.manager.train_dataset.cameras, side, most)
        return rays[0].reshape(-1, 3), rays[1].reshape(-1, 3)

    def note_views(self, region: Region) -> None:
        """Tells a region what the training images see of it."""
        region.note_backdrops(*self.covering_rays())
        cameras = len(self.manager.train_dataset.cameras)  # some rays of each image
        region.note_crossed_space(*self.covering_rays(rays_a_side(cameras), cameras))

    def prepare_batch(self, factor: float, distances: bool, set_aside: int = 0) -> None:
        """Sets the next batch, if it is drawn here: `factor` times the config's rays, pixels of
        known distance if asked, and none of `set_aside` photographs (`vouching`)."""
        sampler = sampler_here(self.manager)
        if isinstance(sampler, HeldOutPixelSampler):
            sampler.set_aside = None
            if set_aside > 0 and len(chosen := self.vouching(set_aside)):
                sampler.set_aside = torch.zeros(len(self.manager.train_dataset), dtype=torch.bool)
                sampler.set_aside[chosen] = True
        if isinstance(sampler, KnownDistancePixelSampler):
            sampler.sparse = self.sparse if distances else None
        rays = drawable(round(self.rays_per_batch * factor), self.manager)
        if sampler is not None and sampler.num_rays_per_batch != rays:
            sampler.set_num_rays_per_batch(rays)

    def say_what_is_fixed(self) -> None:
        """Says so where another process draws the batches."""
        if sampler_here(self.manager) is None:
            say("unknown pixel sampler: the batch size is fixed, and depth supervision is off")

    @cached_property
    def sparse(self) -> SparsePixels | None:
        """Where sparse points are seen; projected only once learning asks for it."""
        dataset, sampler = self.manager.train_dataset, held_out_sampler(self.manager)
        if (points := sparse_points(dataset)) is None:
            return None
        lattice = Lattice() if sampler is None else sampler.lattice
        return sparse_pixels(dataset.cameras, points, lattice)

    def vouching(self, count: int) -> Tensor:
        """Numbers [count] of training photographs, evenly spread, that vouch for what the others
        taught. [0] where they are over a quarter, or batches are not drawn here of all at once."""
        if count not in self._vouching:
            photographs = len(self.manager.train_dataset)
            can = 0 < SHARE_THAT_VOUCHES * count <= photographs
            can = can and isinstance(sampler_here(self.manager), HeldOutPixelSampler)
            can = can and len(_images_of(self.manager)["image"]) == photographs
            numbers = (torch.arange(count) + 0.5) * (photographs / max(count, 1))
            self._vouching[count] = numbers.long() if can else torch.zeros(0, dtype=torch.int64)
        return self._vouching[count]

    def of_vouching(self, mixture: Mixture, count: int, of_each: int) -> list[Rays]:
        """Rays of each photograph that vouches, cut to a mixture's region."""
        sampler, chosen = held_out_sampler(self.manager), self.vouching(count)
        if sampler is None or not len(chosen):
            return []
        batch = sampler.sample_pictures(_images_of(self.manager), chosen, of_each, seed=0)
        rays = _rays_of(mixture, _bundle_of(self.manager, batch)[0])
        of_pictures = batch["indices"][:, 0] == chosen[:, None]
        return [
            Rays._make(None if part is None else part[own] for part in rays)
            for own in of_pictures.to(mixture.device)
            if bool(own.any())
        ]

    def of_tests(self, mixture: Mixture, count: int, of_each: int) -> list[Rays]:
        """Rays of each of up to `count` test photographs; none where one of them trains too."""
        tests: Any = getattr(self.manager, "eval_dataset", None) or []
        trained = {*self.manager.train_dataset.image_filenames} if len(tests) else set()
        if len(tests) == 0 or not trained.isdisjoint(tests.image_filenames):
            return []
        chosen = spread_evenly(len(tests), count)
        bundles = bundles_of_tests(self.manager, chosen, of_each)
        found = [rays.to(mixture.device) for rays, _ in bundles]
        return [mixture.rays(rays.origins, rays.directions, None) for rays in found]

    def held_out(
        self, mixture: Mixture, count: int, seed: int = 0, share: Share = "calibration"
    ) -> tuple[Rays, Tensor]:
        return held_out_rays(mixture, self.manager, count, seed, share)

    def training_rays(self, mixture: Mixture, count: int) -> Rays:
        """Rays [count] of random training pixels, cut to a mixture's region."""
        self.prepare_batch(1.0, distances=False)
        drawn = [_rays_of(mixture, each) for each in training_bundles(self.manager, count)]
        joined: Any = [None if p[0] is None else torch.cat(p)[:count] for p in zip(*drawn)]
        return Rays(*joined)

    def count_held_out(self, limit: int) -> float:
        return count_held_out(self.manager, limit)

    def doubts(self) -> list[str]:
        """A line on each thing that often makes a scene fail, before anything is learned."""
        dataset, found = self.manager.train_dataset, []
        if len(dataset) < FEW_PHOTOGRAPHS:
            few = counted(len(dataset), "training photograph is", "training photographs are")
            few += " few: new views may fail"
            found.append(f"{few}; more, which overlap by two thirds, usually help")
        points = sparse_points(dataset)
        if usable_points(points) is None:
            lack = "this scene has no sparse points"
            if points is not None:
                lack = f"this scene has too few sparse points, {len(points)}"
            why = f"{lack}, so that its bounds are guessed from its cameras"
            found.append(f"{why}; `leco points SCENE` finds some (it needs pycolmap)")
        return found + doubtful_cameras(dataset)

    def facts(self) -> dict[str, Any]:
        """What the report of an occupancy says of its data, as JSON values."""
        return {
            "held_out": held_out_sampler(self.manager) is not None,
            "bounds": self.survey.bounds.reason,
            "cameras": self.survey.positions.tolist(),
            "frame": frame_of(self.manager),
            "data_frame": data_frame_of(self.manager),
        }


def training_bundles(manager: Any, count: int) -> Iterator[Any]:
    """The rays of training batches, at least so many."""
    drawn = 0
    while drawn < count:
        bundle, _ = manager.next_train(0)
        drawn += len(bundle)
        yield bundle


def bundles_of_tests(
    manager: Any, numbers: Iterable[int], of_each: int
) -> Iterator[tuple[RayBundle, Tensor]]:
    """Rays of pixels of test photographs, less those that a lens or mask hides, and their colours
    [R, 3 or 4]: the same at every call. A photograph of which nothing is left is passed over."""
    dataset, generator = manager.eval_dataset, torch.Generator().manual_seed(0)
    cameras = dataset.cameras.to("cpu")
    for number in numbers:
        data = dataset.get_data(number)
        image = data["image"]
        drawn = [torch.randint(side, (of_each,), generator=generator) for side in image.shape[:2]]
        pixels = torch.stack(drawn, dim=-1)
        pixels = pixels[visible_in_test(manager, number, data, pixels)]
        if len(pixels) > 0:
            rays = cameras.generate_rays(camera_indices=number, coords=pixels + 0.5)
            yield rays, image[tuple(pixels.T)]


def held_out_bundle(
    manager: Any, count: int, seed: int = 0, share: Share = "calibration"
) -> tuple[RayBundle, Tensor]:
    """Up to `count` rays of pixels that are never trained on, and true colours [R, 3 or 4]. They
    are of training images: an unknown exposure would hide what skipping adds to an error. Without
    held-out pixels they are ordinary training rays; the report says so."""
    if (sampler := held_out_sampler(manager)) is None:
        bundle, batch = manager.next_train(0)
        return bundle[:count], batch["image"][:count]
    return _bundle_of(manager, sampler.sample_held_out(_images_of(manager), count, seed, share))


def _bundle_of(manager: Any, batch: dict[str, Tensor]) -> tuple[RayBundle, Tensor]:
    """The rays of a batch of pixels, and their colours."""
    pixels = batch["indices"]
    bundle = manager.train_dataset.cameras.to("cpu").generate_rays(
        camera_indices=pixels[:, :1], coords=pixels[:, 1:].float() + 0.5
    )
    return bundle, batch["image"]


def held_out_rays(
    mixture: Mixture, manager: Any, count: int, seed: int = 0, share: Share = "calibration"
) -> tuple[Rays, Tensor]:
    """Held-out rays, cut to a mixture's region, and their colours [R, 3]; see `held_out_bundle`."""
    return _as_rays(mixture, *held_out_bundle(manager, count, seed, share))


def _as_rays(mixture: Mixture, bundle: RayBundle, truth: Tensor) -> tuple[Rays, Tensor]:
    """Rays as a mixture takes them, and their colours [R, 3]."""
    return _rays_of(mixture, bundle), on_black(truth.to(mixture.device).float())


def _rays_of(mixture: Mixture, bundle: RayBundle) -> Rays:
    bundle = bundle.to(mixture.device)
    assert bundle.camera_indices is not None
    return mixture.rays(bundle.origins, bundle.directions, bundle.camera_indices[:, 0])


def count_held_out(manager: Any, limit: int) -> float:
    """How many pixels there are to check with, up to a limit; infinity if none is held out."""
    if (sampler := held_out_sampler(manager)) is None:
        return math.inf
    return float(sampler.count_held_out(_images_of(manager), limit, "recheck"))


def on_black(image: Tensor) -> Tensor:
    """Colours [..., 3] of pixels [..., 3 or 4], transparent ones over black."""
    return image if image.shape[-1] < 4 else image[..., :3] * image[..., 3:]


def _images_of(manager: Any) -> dict[str, Any]:
    """Images to take held-out pixels from: those that are loaded, or some where none are here."""
    loader: Any = getattr(manager, "iter_train_image_dataloader", None)
    return some_images(manager.train_dataset) if loader is None else next(loader)
