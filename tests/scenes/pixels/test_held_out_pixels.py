"""Training and calibration never see the same pixel."""

from __future__ import annotations

import pytest
import torch
from nerfstudio.data.pixel_samplers import PixelSamplerConfig
from scene_files import refused

from leco_plugin.scenes.pixels import held_out_pixels
from leco_plugin.scenes.pixels.held_out_pixels import (
    PERIODS,
    HeldOutPixelSampler,
    Lattice,
    Share,
    look_up,
)

THIN = Lattice()


def images(masked: bool = False) -> dict[str, torch.Tensor]:
    """Three images whose colours are their pixels' places; their own numbers are 7, 8, 9."""
    places = torch.meshgrid(torch.arange(3), torch.arange(40), torch.arange(39), indexing="ij")
    batch = {"image": torch.stack(places, dim=-1).float(), "image_idx": torch.tensor([7, 8, 9])}
    if masked:  # neighbours of some held-out pixels, and some held-out pixels, are masked
        batch["mask"] = torch.rand(3, 40, 39, 1, generator=torch.Generator().manual_seed(0)) > 0.5
    return batch


def sampler(**options) -> HeldOutPixelSampler:
    config = PixelSamplerConfig(HeldOutPixelSampler, num_rays_per_batch=5000, **options)
    made = config.setup()
    assert isinstance(made, HeldOutPixelSampler)
    return made


@pytest.mark.parametrize("lattice", [Lattice(period) for period in (*PERIODS, 2)])
@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("options", [{}, {"is_equirectangular": True}, {"fisheye_crop_radius": 15}])
def test_training_never_samples_a_held_out_pixel(masked: bool, options, lattice: Lattice) -> None:
    made, batch = sampler(**options), images(masked)
    made.lattice = lattice
    for seed in range(5):
        torch.manual_seed(seed)
        samples = made.sample(dict(batch))
        places = samples["image"].long()
        assert len(places) == 5000
        assert not bool(lattice.holds_out(places).any())
        assert torch.equal(samples["indices"][:, 0], batch["image_idx"][places[:, 0]])
        if masked:
            assert bool(batch["mask"][tuple(places.unbind(dim=-1))].all())


def test_a_held_out_pixel_at_the_right_edge_of_a_tall_picture_gives_way_to_the_left() -> None:
    batch = {"image": torch.zeros(1, 60, 6, 3), "image_idx": torch.tensor([0])}
    pixels = sampler().sample(batch)["indices"]
    assert int(pixels[:, 2].max()) == 5 and not bool(THIN.holds_out(pixels).any())


def test_training_reaches_every_other_pixel() -> None:
    torch.manual_seed(0)
    places = torch.cat([sampler().sample(images())["image"].long() for _ in range(20)]).unique(
        dim=0
    )
    assert len(places) == 3 * 40 * 39 - int(THIN.holds_out(images()["image"].view(-1, 3)).sum())


@pytest.mark.parametrize("masked", [False, True])
def test_held_out_sampling_only_gives_held_out_pixels(masked: bool) -> None:
    batch = images(masked)
    samples = sampler().sample_held_out(batch, 1000, seed=0)
    places, indices = samples["image"].long(), samples["indices"]
    assert bool(THIN.holds_out(places).all()) and bool(THIN.holds_out(indices).all())
    assert torch.equal(indices[:, 1:], places[:, 1:])
    assert torch.equal(indices[:, 0], batch["image_idx"][places[:, 0]])
    if masked:
        assert 0 < len(places) < 1000
        assert bool(batch["mask"][tuple(places.unbind(dim=-1))].all())
    else:
        all_held_out = batch["image"].view(-1, 3)[THIN.holds_out(batch["image"].view(-1, 3))]
        assert torch.equal(places.unique(dim=0), all_held_out.long().unique(dim=0))


def test_held_out_samples_are_the_same_for_a_seed() -> None:
    first, again = (sampler().sample_held_out(images(), 100, seed=3)["indices"] for _ in range(2))
    assert torch.equal(first, again)


def pixels_of(batch: dict[str, torch.Tensor], count: int, seed: int, share: Share) -> set[tuple]:
    indices = sampler().sample_held_out(batch, count, seed, share)["indices"]
    pixels = {tuple(pixel) for pixel in indices.tolist()}
    assert len(pixels) == len(indices)  # none twice
    return pixels


@pytest.mark.parametrize("masked", [False, True])
def test_what_calibrates_and_what_checks_share_no_pixel_and_leave_none_out(masked: bool) -> None:
    batch = images(masked)
    everything = pixels_of(batch, 1000, 0, "all")
    calibrates, checks = (pixels_of(batch, 1000, 1, share) for share in ("calibration", "recheck"))
    assert not calibrates & checks
    assert calibrates | checks == everything
    assert masked or len(checks) == pytest.approx(len(everything) / 4, rel=0.15)


@pytest.mark.parametrize("share", ["calibration", "recheck"])
def test_of_tiny_images_every_share_is_all(share: Share) -> None:
    batch = {"image": torch.zeros(3, 12, 16, 3), "image_idx": torch.arange(3)}
    assert pixels_of(batch, 10, 0, share) == {(0, 5, 5), (1, 5, 5), (2, 5, 5)}


@pytest.mark.parametrize("hidden", ["calibration", "recheck"])
def test_where_masks_leave_nothing_of_a_share_it_is_all_that_they_leave(hidden: Share) -> None:
    batch = images()
    places = batch["image"].long()
    mask = ~THIN.is_of(places.view(-1, 3), hidden).view(*places.shape[:-1], 1)
    shares: list[Share] = ["all", "calibration", "recheck"]
    all_of_them, *found = (pixels_of(batch | {"mask": mask}, 1000, 0, share) for share in shares)
    assert found == [all_of_them, all_of_them] and all_of_them


@pytest.mark.parametrize("share", ["all", "calibration", "recheck"])
def test_of_many_held_out_pixels_other_seeds_give_others_from_everywhere(share: Share) -> None:
    pictures = [torch.zeros(400, 300, 3), torch.zeros(800, 600, 3)]
    batch = {"image": pictures, "image_idx": torch.tensor([0, 1])}
    first, second = (pixels_of(batch, 50, seed, share) for seed in (0, 1))
    assert len(first) == len(second) == 50
    assert len(first & second) < 25
    many = torch.tensor(sorted(pixels_of(batch, 300, 2, share))).float()
    assert float((many[:, 0] == 1).float().mean()) == pytest.approx(0.8, abs=0.1)  # its pixels
    larger = many[many[:, 0] == 1, 1:] / torch.tensor([800.0, 600.0])
    assert larger.mean(dim=0).tolist() == pytest.approx([0.5, 0.5], abs=0.07)
    assert float(larger.amax()) > 0.95 and float(larger.amin()) < 0.05


@pytest.mark.parametrize("masked", [False, True])
def test_of_pictures_that_are_set_aside_nothing_is_drawn_until_they_are_no_more(
    masked: bool,
) -> None:
    torch.manual_seed(0)
    made, batch = sampler(), images(masked)
    made.set_aside = torch.arange(10) == 8
    assert set(made.sample(dict(batch))["indices"][:, 0].tolist()) == {7, 9}
    made.set_aside = None
    assert set(made.sample(dict(batch))["indices"][:, 0].tolist()) == {7, 8, 9}


def test_where_every_picture_is_set_aside_all_are_drawn_of() -> None:
    made = sampler()
    made.set_aside = torch.ones(10, dtype=torch.bool)
    assert len(made.sample(images())["indices"]) == 5000


@pytest.mark.parametrize("masked", [False, True])
def test_pixels_of_chosen_pictures_are_theirs_and_seen(masked: bool) -> None:
    batch = images(masked)
    found = sampler().sample_pictures(batch, torch.tensor([9, 7]), 100, seed=0)
    assert found["indices"][:, 0].tolist() == [9] * 100 + [7] * 100
    places = found["image"].long()
    assert torch.equal(batch["image_idx"][places[:, 0]], found["indices"][:, 0])
    assert torch.equal(places[:, 1:], found["indices"][:, 1:])
    if masked:
        assert bool(batch["mask"][tuple(places.unbind(dim=-1))].all())
    again = sampler().sample_pictures(batch, torch.tensor([9, 7]), 100, seed=0)
    assert torch.equal(found["indices"], again["indices"])


def test_images_of_many_sizes_are_sampled_as_a_list() -> None:
    pictures = [torch.rand(20, 30, 3), torch.rand(50, 12, 3)]
    batch = {"image": pictures, "image_idx": torch.tensor([0, 1])}
    samples = sampler().sample_held_out(batch, 50, seed=0)
    assert bool(THIN.holds_out(samples["indices"]).all())
    for color, (image, row, column) in zip(samples["image"], samples["indices"].tolist()):
        assert torch.equal(color, pictures[image][row, column])


@pytest.mark.parametrize("rays", [5, 6])
def test_of_pictures_of_many_sizes_all_are_drawn_alike_and_in_any_order(rays: int) -> None:
    """nerfstudio's own wants an even number of rays, and draws of the last of the pictures only."""
    torch.manual_seed(0)
    pictures = [torch.rand(20 + number, 30, 3) for number in range(7)]
    batch = {"image": pictures, "image_idx": torch.tensor([3, 9, 8, 4, 6, 2, 5])}
    made, first, often = sampler(), torch.zeros(10), torch.zeros(10)
    made.set_num_rays_per_batch(rays)
    for _ in range(140):
        samples = made.sample(dict(batch))
        numbers = samples["indices"][:, 0]
        assert len(samples["image"]) == rays == len(numbers.unique())
        for color, (image, row, column) in zip(samples["image"], samples["indices"].tolist()):
            place = batch["image_idx"].tolist().index(image)
            assert torch.equal(color, pictures[place][row, column])
        often += torch.bincount(numbers, minlength=10)
        first[numbers[0]] += 1
    assert often[batch["image_idx"]].tolist() == pytest.approx([20 * rays] * 7, rel=0.2)
    assert bool((first[batch["image_idx"]] > 5).all())


@pytest.mark.parametrize("kind", ["tensor", "list"])
def test_no_pixels_have_no_values_of_the_right_shape_and_type(kind: str) -> None:
    images = torch.zeros(2, 20, 30, 3, dtype=torch.uint8)
    source = images if kind == "tensor" else list(images)
    values = look_up(source, torch.zeros(0, 3, dtype=torch.int64))
    assert values.shape == (0, 3) and values.dtype == torch.uint8


def test_images_of_many_sizes_that_are_masked_throughout_hold_no_held_out_pixel() -> None:
    pictures = [torch.rand(20, 30, 3), torch.rand(50, 12, 3)]
    masks = [torch.zeros(*picture.shape[:2], 1, dtype=torch.bool) for picture in pictures]
    batch = {"image": pictures, "mask": masks, "image_idx": torch.tensor([0, 1])}
    samples = sampler().sample_held_out(batch, 50, seed=0)
    assert samples["image"].shape == (0, 3) and samples["indices"].shape == (0, 3)


def test_masked_images_of_many_sizes_are_sampled_where_they_are_seen() -> None:
    pictures = [torch.rand(20, 30, 3), torch.rand(50, 12, 3)]
    masks = [torch.zeros(*picture.shape[:2], 1, dtype=torch.bool) for picture in pictures]
    masks[0][3:9, 5:20], masks[1][40:, :4] = True, True
    batch = {"image": pictures, "mask": masks, "image_idx": torch.tensor([0, 1])}
    samples = sampler().sample(batch)
    assert len(samples["indices"]) == 5000
    assert not bool(THIN.holds_out(samples["indices"]).any())
    for image, row, column in samples["indices"].tolist():
        assert bool(masks[image][row, column])


def test_a_mask_is_sampled_evenly() -> None:
    torch.manual_seed(0)
    mask = torch.zeros(1, 10, 20, 1, dtype=torch.bool)
    mask[0, 2, :4] = True
    found = sampler().rejection_sample_mask(mask, 4000, 1, 10, 20, "cpu")
    assert bool(mask[tuple(found.unbind(dim=-1))].all())
    assert (found[:, 2].bincount() - 1000).abs().max() < 150


def test_the_pixels_of_a_mask_are_not_listed_where_it_leaves_many(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A list of those of a survey has gigabytes, and takes longer than a step."""
    batch = images(masked=True)
    monkeypatch.setattr(batch["mask"].__class__, "nonzero", None)
    found = sampler().rejection_sample_mask(batch["mask"], 4000, 3, 40, 39, "cpu")
    monkeypatch.undo()
    assert bool(batch["mask"][tuple(found.unbind(dim=-1))].all())
    assert found.float().mean(dim=0).tolist() == pytest.approx([1.0, 19.5, 19.0], abs=0.8)


def test_a_mask_without_a_pixel_is_an_input_error() -> None:
    with refused("leave no pixel"):
        sampler().rejection_sample_mask(torch.zeros(1, 4, 4, 1), 3, 1, 4, 4, "cpu")


def inside_circle(places: torch.Tensor, sizes: torch.Tensor, radius: float) -> torch.Tensor:
    offsets = places[:, 1:] + 0.5 - sizes / 2
    return offsets.norm(dim=-1) <= radius


@pytest.mark.parametrize("kind", ["alike", "masked", "list"])
def test_nothing_is_drawn_outside_of_what_a_fisheye_shows(kind: str) -> None:
    batch: dict = images(masked=kind == "masked")
    if kind == "list":
        batch["image"] = list(batch["image"])
    made, sizes = sampler(fisheye_crop_radius=12.0), torch.tensor([40.0, 39.0])
    made.set_num_rays_per_batch(6000)
    torch.manual_seed(0)
    trained = made.sample(dict(batch))["image"].long()
    # nerfstudio's middle is half a pixel off
    assert bool(inside_circle(trained, sizes, 12.5).all())
    assert not bool(THIN.holds_out(trained).any())
    seen = batch["mask"][..., 0].long() if "mask" in batch else torch.ones(3, 40, 39).long()
    area = 3.14159 * 12.0**2 * 3 * float(seen.float().mean())
    assert 0.8 * area < len(trained.unique(dim=0)) < area
    calibrated = made.sample_held_out(batch, 1000, seed=0)["image"].long()
    assert len(calibrated) >= 3 and bool(inside_circle(calibrated, sizes, 12.5).all())
    assert bool(THIN.holds_out(calibrated).all())


def test_a_circle_that_shows_nothing_is_one_line() -> None:
    made = sampler(fisheye_crop_radius=0.5)
    with refused(r"a fisheye_crop_radius of 0\.5 pixels shows next to nothing"):
        made.sample(images())


def test_a_small_circle_fills_a_batch_however_its_pixels_fall(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(held_out_pixels, "TRIES", 1)
    made = sampler(fisheye_crop_radius=6.0)
    made.set_num_rays_per_batch(600)
    torch.manual_seed(0)
    trained = made.sample(images())["image"].long()
    assert len(trained) == 600
    assert bool(inside_circle(trained, torch.tensor([40.0, 39.0]), 6.5).all())
