"""Photographs and their rays, and the model of the run that learned an occupancy.

The rendering weights of that model say what a dropped candidate was worth.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from nerfstudio.cameras.rays import RayBundle
from torch import Tensor

from leco_plugin.evaluation.inspection import cameras_of
from leco_plugin.learning.freezing import field_at_freezing
from leco_plugin.learning.run import CONFIG
from leco_plugin.models.leco import LecoModel
from leco_plugin.models.mixture import Mixture
from leco_plugin.models.region import cut_rays
from leco_plugin.models.rendering import Rays
from leco_plugin.occupancy import Occupancy
from leco_plugin.scenes.frames import between, found_again, frame_of, moved, turned
from leco_plugin.scenes.input_error import InputError, one_line, require_folder
from leco_plugin.scenes.pixels.held_out_pixels import SOME, held_out_sampler, visible_in_test
from leco_plugin.scenes.pixels.known_distances import batches_of
from leco_plugin.scenes.survey import chosen_cameras
from leco_plugin.studio.checkpoints import step_of, whole_of

DRAWS = 8
"""Most batches that are drawn to find enough different pixels."""


class Source(NamedTuple):
    """Photographs, and the model that was trained on them if there is one."""

    manager: Any
    """nerfstudio's data manager."""
    model: LecoModel | None
    """In evaluation mode."""
    frozen: Mixture | None = None
    """Its mixture as it was when the gate was frozen."""

    @property
    def mixture(self) -> Mixture | None:
        """The model's, if there is a model."""
        return None if self.model is None else self.model.mixture


class Seen(NamedTuple):
    """Rays in the occupancy's coordinates, and what the photographs show there."""

    rays: Rays
    truth: Tensor
    """[R, 3 or 4] colours."""
    pixels: Tensor | None = None
    """[R, 3] int64, image, row and column; None where they are not needed."""


def find_source(file: Path, data: Path) -> Source:
    """The photographs in `data`, with the model of the run that the occupancy lies in.

    Raises:
        InputError: `data` is no folder, or the run's model cannot be loaded.
    """
    require_folder(data, "give that of the scene with --data")
    folder = file.resolve().parent
    is_run = (folder / CONFIG).is_file() and any(folder.rglob("step-*.ckpt"))
    if is_run and (source := _load_run(folder, data.resolve())) is not None:
        return source
    from leco_plugin.method_configs import best_device, leco_occupancy

    config: Any = copy.deepcopy(leco_occupancy.config.pipeline)
    config.datamanager.data = data
    return Source(config.datamanager.setup(device=best_device(), test_mode="test"), None)


def _load_run(folder: Path, data: Path) -> Source | None:
    """The run's photographs and model; None for one that has saved nothing, and for the run of a
    host, whose field is another one."""
    import yaml
    from nerfstudio.utils.eval_utils import eval_load_checkpoint

    from leco_plugin.method_configs import best_device

    # as ns-eval reads it
    try:
        config = yaml.load((folder / CONFIG).read_text(), Loader=yaml.Loader)
        built = config.pipeline.model._target  # of a guided host it is a function
    except (yaml.YAMLError, ImportError, AttributeError, TypeError, ValueError) as error:
        raise InputError(f"{folder / CONFIG} cannot be read: {one_line(error, 200)}") from None
    if not (isinstance(built, type) and issubclass(built, LecoModel)):
        return None
    checkpoints = folder / config.relative_model_dir
    if not any(checkpoints.glob("step-*.ckpt")):
        return None
    path = whole_of(checkpoints)
    config.load_dir, config.load_step = path.parent, step_of(path)
    config.data = config.pipeline.datamanager.data = data
    try:
        pipeline = config.pipeline.setup(device=best_device(), test_mode="test")
        eval_load_checkpoint(config, pipeline)
    except (RuntimeError, KeyError) as error:
        raise InputError(
            f"the model of the run in {folder} cannot be loaded: {one_line(error, 200)}"
        ) from None
    model = pipeline.model.eval()
    return Source(pipeline.datamanager, model, field_at_freezing(model.mixture, folder))


def check_scene(source: Source, occupancy: Occupancy, data: Path) -> None:
    """Raises `InputError` where fewer than half of the cameras that an occupancy's report names
    took the photographs."""
    known = cameras_of(occupancy)
    if len(known) == 0:
        return
    here = _camera_positions(source)
    if source.model is None and (frame := _frame_to(source, occupancy)) is not None:
        here = moved(here, frame)
    found = found_again(known, here, float(occupancy.space.half_extent))
    if float(found.float().mean()) < 0.5:
        raise InputError(
            f"--data {data}: {int(found.sum())} of the {len(known)} cameras that the occupancy "
            "names are among its photographs; give the scene that it was learned on"
        )


def draw_held_out(source: Source, occupancy: Occupancy, count: int, parts: int = 2) -> list[Seen]:
    """Rays of pixels that nothing was trained on, in disjoint parts of up to `count` rays each.

    Without held-out pixels they are training pixels, none of them twice.
    """
    sampler = held_out_sampler(source.manager)
    if sampler is None:
        given: list[Seen] = []
        for _ in range(parts):
            given.append(draw_other_pixels(source, occupancy, count, given))
        return given
    images = next(source.manager.iter_train_image_dataloader)
    batch = sampler.sample_held_out(images, parts * count, seed=1)
    each = min(count, len(batch["indices"]) // parts)
    if each == 0:
        raise InputError("the photographs have no pixels that nothing was trained on")
    return [
        _see_pixels(source, occupancy, batch["indices"][part], batch["image"][part])
        for part in torch.arange(each * parts).split(each)
    ]


def draw_training_rays(source: Source, occupancy: Occupancy, count: int) -> Seen:
    bundle, batch = _draw(source, count)
    return _see(source, occupancy, bundle, batch["image"])


def draw_other_pixels(
    source: Source, occupancy: Occupancy, count: int, besides: Iterable[Seen]
) -> Seen:
    """Rays of different training pixels, none of them of the rays `besides`; fewer than `count`
    where the photographs have hardly more pixels."""
    taken = [_numbers(seen.pixels) for seen in besides if seen.pixels is not None]
    pixels, truths = [], []
    for _ in range(DRAWS):
        batch = _draw(source, count)[1]
        numbers = _numbers(batch["indices"])
        first = np.sort(np.unique(numbers, return_index=True)[1])
        new = first[~np.isin(numbers[first], np.concatenate([np.empty(0, np.int64), *taken]))]
        taken.append(numbers[new])
        pixels.append(batch["indices"].cpu()[new])
        truths.append(batch["image"].cpu()[new])
        if sum(map(len, pixels)) >= count:
            break
    return _see_pixels(source, occupancy, torch.cat(pixels)[:count], torch.cat(truths)[:count])


def move_between_cameras(source: Source, seen: Seen, seed: int) -> Seen:
    """The same rays of training images, each moved by a random part of the way from its camera to
    the nearest one. The colours are not those of the moved rays."""
    rays = seen.rays
    assert source.model is not None and rays.images is not None
    images = rays.images.cpu()
    positions = _camera_positions(source)
    others = torch.cdist(positions, positions).fill_diagonal_(torch.inf).argmin(dim=1)
    generator = torch.Generator().manual_seed(seed)
    along = torch.rand(len(images), 1, generator=generator)
    shifts = (along * (positions[others] - positions)[images]).to(rays.origins)
    bundle = RayBundle(
        origins=rays.origins + shifts,
        directions=rays.directions,
        pixel_area=torch.ones_like(rays.t_mins)[:, None],
        camera_indices=rays.images[:, None],
    )
    return _see(source, None, bundle, seen.truth)._replace(pixels=seen.pixels)


def draw_test_rays(source: Source, occupancy: Occupancy, count: int) -> Seen | None:
    """Rays of about `count` pixels of up to 16 test photographs, less those that a lens or mask
    hides; None where there are none."""
    dataset = source.manager.eval_dataset
    if dataset is None or len(dataset) == 0:
        return None
    chosen, generator = chosen_cameras(len(dataset), SOME), torch.Generator().manual_seed(4)
    each = -(-count // len(chosen))
    indices, truths = [], []
    for number in chosen.tolist():
        data = dataset.get_data(number)
        image = data["image"]
        pixels = (torch.rand(each, 2, generator=generator) * torch.tensor(image.shape[:2])).long()
        pixels = pixels[visible_in_test(source.manager, number, data, pixels)]
        indices.append(torch.nn.functional.pad(pixels, (1, 0), value=number))
        truths.append(image[tuple(pixels.T)])
    numbers, places = torch.cat(indices).split([1, 2], dim=1)
    if len(numbers) == 0:
        return None
    bundle = dataset.cameras.to("cpu").generate_rays(
        camera_indices=numbers, coords=places.float() + 0.5
    )
    return _see(source, occupancy, bundle, torch.cat(truths), of_training=False)


def _camera_positions(source: Source) -> Tensor:
    """Of the training photographs, in the run's coordinates: [C, 3]."""
    cameras = source.manager.train_dataset.cameras
    return cameras.camera_to_worlds[:, :3, 3].cpu().float()


def _frame_to(source: Source, occupancy: Occupancy) -> Tensor | None:
    """[3, 4] from the photographs' coordinates to the occupancy's; None where it is unknown."""
    learned_in, here = occupancy.report.get("frame"), frame_of(source.manager)
    return None if learned_in is None or here is None else between(here, learned_in)


def _draw(source: Source, count: int) -> tuple[RayBundle, dict[str, Tensor]]:
    """`count` rays of random training pixels, and the pixels."""
    with batches_of(count, source.manager):
        bundle, batch = source.manager.next_train(0)
    return bundle, batch


def _see_pixels(source: Source, occupancy: Occupancy, pixels: Tensor, truth: Tensor) -> Seen:
    """Rays of training pixels [R, 3]."""
    bundle = source.manager.train_ray_generator(pixels)
    return _see(source, occupancy, bundle, truth)._replace(pixels=pixels)


def _numbers(pixels: Tensor) -> np.ndarray:
    """A different number for each different pixel [R, 3]: [R] int64."""
    image, row, column = pixels.cpu().numpy().T
    return (image << 40) + (row << 20) + column


def _see(
    source: Source,
    occupancy: Occupancy | None,
    bundle: Any,
    truth: Tensor,
    of_training: bool = True,
) -> Seen:
    mixture = source.mixture
    if mixture is not None:
        bundle = bundle.to(mixture.device)
        images = bundle.camera_indices[:, 0] if of_training else None
        rays = mixture.rays(bundle.origins, bundle.directions, images)
        return Seen(rays, truth.to(mixture.device).float())
    assert occupancy is not None
    bundle = bundle.to(occupancy.walls.device)
    if (frame := _frame_to(source, occupancy)) is not None:
        frame = frame.to(bundle.origins)
        directions = turned(bundle.directions, frame)
        bundle.origins = moved(bundle.origins, frame)
        bundle.directions = directions / directions.norm(dim=-1, keepdim=True)
    near, far = (bundle.origins.new_tensor(occupancy.report[name]) for name in ("near", "far"))
    rays = cut_rays(bundle.origins, bundle.directions, occupancy.walls, near, far)
    return Seen(rays, truth.float())
