"""Claims about where the rays come from on which a smaller gate is measured."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import pytest
import tiny_scene as tiny_scene_writer
import torch
from ball_occupancy import THEIR_MARCH, ball_of_the_tiny_scene

from leco_plugin.capacity.references import AT_FREEZING, BY_DECISIONS, NOW, measure_shares_lost
from leco_plugin.capacity.sources import (
    CONFIG,
    Source,
    check_scene,
    draw_held_out,
    draw_other_pixels,
    draw_test_rays,
    draw_training_rays,
    find_source,
    move_between_cameras,
)
from leco_plugin.occupancy import Occupancy
from leco_plugin.scenes.input_error import InputError

Known = tuple[Source, Occupancy]


def test_a_guided_run_has_no_model_to_ask(tiny_scene: Path, tmp_path: Path) -> None:
    from leco_plugin.host_configs import leco_ngp

    config: Any = copy.deepcopy(leco_ngp.config)
    config.output_dir, config.experiment_name, config.timestamp = tmp_path, "tiny", "run"
    config.data = config.pipeline.datamanager.data = tiny_scene
    config.save_config()
    folder = config.get_base_dir()
    (folder / "nerfstudio_models").mkdir()
    (folder / "nerfstudio_models" / "step-000000001.ckpt").touch()
    source = find_source(folder / "occupancy.safetensors", tiny_scene)
    assert source.model is None and len(source.manager.train_dataset) == 7


@pytest.mark.parametrize("text", ["", "one: [two", "!!python/name:no.such.module", "\ud800"])
def test_a_damaged_config_is_named(tiny_scene: Path, tmp_path: Path, text: str) -> None:
    (tmp_path / CONFIG).write_bytes(text.encode(errors="surrogatepass"))
    (tmp_path / "nerfstudio_models").mkdir()
    (tmp_path / "nerfstudio_models" / "step-000000001.ckpt").touch()
    with pytest.raises(InputError, match=r"config.yml cannot be read"):
        find_source(tmp_path / "occupancy.safetensors", tiny_scene)


def test_another_scene_than_the_runs_is_refused(
    file: Path, known: Known, tiny_scene: Path, tmp_path: Path
) -> None:
    """Its photographs would be in the model's coordinates, but show something else there."""
    source, original = known
    cameras = source.manager.train_dataset.cameras.camera_to_worlds[:, :3, 3]
    original.report["cameras"] = cameras.tolist()
    check_scene(source, original, tiny_scene)
    other = tiny_scene_writer.write(tmp_path / "other", train=9, test=3)
    with pytest.raises(InputError, match="of the 7 cameras"):
        check_scene(find_source(file, other), original, other)


def test_cameras_are_compared_in_its_coordinates(tiny_scene: Path, tmp_path: Path) -> None:
    known = ball_of_the_tiny_scene()
    known.report["cameras"] = [
        tiny_scene_writer.camera_to_world(2 * torch.pi * i / 9)[:3, 3].tolist() for i in range(9)
    ]
    source = find_source(tmp_path / "occupancy.safetensors", tiny_scene)
    check_scene(source, known, tiny_scene)
    del known.report["frame"]
    with pytest.raises(InputError, match="of the 9 cameras"):
        check_scene(source, known, tiny_scene)


def test_test_photographs_say_what_a_smaller_gate_loses(known: Known) -> None:
    source, original = known
    seen = draw_test_rays(source, original, 300)
    assert seen is not None and len(seen.truth) == 300
    again = draw_test_rays(source, original, 300)
    assert again is not None and torch.equal(seen.rays.directions, again.rays.directions)
    dataset = source.manager.eval_dataset
    cameras = dataset.cameras
    apart = torch.cdist(seen.rays.origins, cameras.camera_to_worlds[:, :3, 3])
    numbers = apart.argmin(dim=1)
    assert float(apart.amin(dim=1).max()) < 1e-5 and len(numbers.unique()) == 2
    # back to the middles of pixels, and to what these show
    axes = cameras.camera_to_worlds[numbers, :3, :3]
    right, up, back = (seen.rays.directions[:, None] @ axes)[:, 0].T
    lens = cameras.fx, cameras.fy, cameras.cx, cameras.cy
    fx, fy, cx, cy = (part[numbers, 0] for part in lens)
    places = torch.stack([cy + fy * up / back, cx - fx * right / back], dim=1)
    torch.testing.assert_close(places, places.floor() + 0.5, atol=1e-3, rtol=0.0)
    pictures = torch.stack([dataset.get_data(number)["image"] for number in range(2)])
    rows, columns = places.long().T
    assert torch.equal(seen.truth, pictures[numbers, rows, columns].float())
    nothing = copy.deepcopy(original)
    nothing.threshold_value.fill_(1.1)
    assert measure_shares_lost(source, original, nothing, seen) == pytest.approx({NOW: 1.0 + 1e-4})
    # what the field at freezing says that the original loses counts, not what it declares
    both = source._replace(frozen=source.mixture)
    before = measure_shares_lost(both, original, original, seen)[AT_FREEZING]
    assert measure_shares_lost(both, original, nothing, seen) == pytest.approx(
        {NOW: 1.0 + before, AT_FREEZING: 1.0}
    )
    everything = copy.deepcopy(original)
    everything.threshold_value.fill_(0.0)
    lost = measure_shares_lost(both, original, everything, seen)
    assert lost == pytest.approx({NOW: before, AT_FREEZING: 0.0})
    alone = source._replace(model=None)
    original.report |= THEIR_MARCH
    assert measure_shares_lost(alone, original, everything, seen) == {BY_DECISIONS: 0.0}


def test_rays_of_other_pixels_have_each_another_one(known: Known) -> None:
    source, original = known
    seen = draw_held_out(source, original, 200)
    for count in (700, 700, 10**4):  # more than there are
        seen.append(draw_other_pixels(source, original, count, seen))
    pixels = torch.cat([one.pixels for one in seen if one.pixels is not None])
    assert len(pixels) == sum(len(one.truth) for one in seen) == len(pixels.unique(dim=0))
    assert len(seen[2].truth) == len(seen[3].truth) == 700 and 3000 < len(seen[4].truth) < 10**4
    picture = source.manager.train_dataset.get_data(int(seen[3].pixels[5, 0]))["image"]
    assert torch.equal(seen[3].truth[5].cpu(), picture[tuple(seen[3].pixels[5, 1:])])


def test_search_verification_and_teaching_have_no_pixel_in_common(known: Known) -> None:
    source, original = known
    seen = [*draw_held_out(source, original, 512), draw_training_rays(source, original, 512)]
    pixels = [
        {(int(image), *map(float, ray)) for image, ray in zip(one.rays.images, one.rays.directions)}
        for one in seen
        if one.rays.images is not None
    ]
    searched, verified, taught = pixels
    assert min(len(searched), len(verified)) > 20
    assert not searched & verified and not (searched | verified) & taught


def test_rays_from_between_the_cameras_begin_there(known: Known) -> None:
    source, original = known
    seen, _ = draw_held_out(source, original, 200)
    moved, again, other = (move_between_cameras(source, seen, seed=seed) for seed in (3, 3, 4))
    assert torch.equal(moved.rays.origins, again.rays.origins)
    assert not torch.equal(moved.rays.origins, other.rays.origins)
    cameras = source.manager.train_dataset.cameras.camera_to_worlds[:, :3, 3]
    assert seen.rays.images is not None
    for origin, direction, image, ours in zip(
        moved.rays.origins, moved.rays.directions, seen.rays.images, seen.rays.directions
    ):
        here = cameras[image]
        apart = (cameras - here).norm(dim=-1)
        nearest = cameras[apart.masked_fill(apart == 0.0, torch.inf).argmin()]
        along = (origin - here) @ (nearest - here) / (nearest - here).square().sum()
        assert 0.0 <= float(along) <= 1.0 and torch.equal(direction, ours)
        torch.testing.assert_close(origin, torch.lerp(here, nearest, along), atol=1e-5, rtol=1e-4)


def test_photographs_too_small_for_held_out_pixels_are_named(file: Path, tmp_path: Path) -> None:
    small = tiny_scene_writer.write(tmp_path / "small", train=1, test=1, size=4)
    source = find_source(file, small)
    with pytest.raises(InputError, match="nothing was trained on"):
        draw_held_out(source, Occupancy.load(file), 100)
