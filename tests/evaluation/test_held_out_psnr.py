"""The PSNR on the screen is a young one, and measuring it takes little of a run."""

from __future__ import annotations

import math
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from nerfstudio.data.pixel_samplers import PixelSampler, PixelSamplerConfig
from torch import nn

from leco_plugin.evaluation import held_out_psnr
from leco_plugin.evaluation.held_out_psnr import HeldOutPsnr


class Clock:
    now = 0.0

    def monotonic(self) -> float:
        return self.now


class Host(nn.Module):
    """Takes a while for each ray, and long for the first after its occupancy has changed."""

    device = "cpu"

    def __init__(self, clock: Clock, seconds: float) -> None:
        super().__init__()
        self.clock, self.seconds, self.changed = clock, seconds, True
        self.rays = 0

    def forward(self, rays: torch.Tensor) -> dict[str, Any]:
        self.clock.now += 3.0 * self.changed + self.seconds * len(rays) / held_out_psnr.RAYS
        self.changed = False
        return {"rgb": torch.zeros(len(rays), 3)}


@pytest.mark.parametrize(("seconds", "oldest"), [(0.1, 16.0), (0.7, 36.0), (2.0, 250.0)])
def test_psnr_is_young_however_long_a_sampler_takes_to_build(
    monkeypatch: pytest.MonkeyPatch, seconds: float, oldest: float
) -> None:
    clock = Clock()
    monkeypatch.setattr(held_out_psnr, "time", clock)
    monkeypatch.setattr(held_out_psnr, "true_colours", lambda model, truth: truth)
    host = Host(clock, seconds)
    psnr = HeldOutPsnr(host, None)
    psnr.__dict__["has_pixels"] = True
    psnr.pixels = (torch.zeros(held_out_psnr.RAYS, 3), torch.rand(held_out_psnr.RAYS, 3))
    measured = [0.0]
    while clock.now < 300.0:
        clock.now += 1.0
        host.changed = host.changed or int(clock.now) in range(100, 104)
        before = psnr.spent
        psnr.look()
        if psnr.spent > before:
            measured.append(clock.now)
    ages = [later - sooner for sooner, later in pairwise(measured)]
    assert max(ages) < oldest
    assert psnr.spent < 0.035 * clock.now


@pytest.mark.parametrize(
    ("now", "spent", "cost", "measured"),
    [
        *((8.0, 0.0, 0.0, False), (10.0, 0.0, 0.0, True)),
        *((30.0, 5.0, 0.89, True), (29.0, 5.0, 0.89, False), (30.0, 5.0, 0.95, False)),
        *((400.0, 2.0, 2.0, True), (399.0, 2.0, 2.0, False)),
    ],
)
def test_psnr_is_measured_when_it_is_due_and_old_or_cheap(
    now: float, spent: float, cost: float, measured: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Measured before, due since 10 s; the run began 100 s before the clock of this test."""
    clock, asked = Clock(), []
    clock.now = 100.0
    monkeypatch.setattr(held_out_psnr, "time", clock)
    psnr = HeldOutPsnr(None, None)
    assert psnr.due == 108.0
    psnr.__dict__["has_pixels"] = True
    psnr.due, psnr.spent, psnr.cost, psnr.latest = 110.0, spent, cost, 20.0
    monkeypatch.setattr(psnr, "_measure", asked.append)
    clock.now += now
    psnr.look()
    assert asked == [held_out_psnr.RAYS] * measured


class OneColour(nn.Module):
    """Ten photographs, the Nth of colour N/10 throughout, and a host that shows 0.2 more."""

    device = "cpu"

    def __init__(self) -> None:
        super().__init__()
        self.cameras = SimpleNamespace(to=lambda device: self)
        self.asked: list[int] = []

    def __len__(self) -> int:
        return 10

    def get_data(self, number: int) -> dict[str, torch.Tensor]:
        return {"image": torch.full((5, 4, 3), number / 10)}

    def generate_rays(self, camera_indices: int, coords: torch.Tensor) -> torch.Tensor:
        assert bool((coords % 1.0 == 0.5).all())  # through the middles of pixels
        assert coords.amin(dim=0).tolist() == [0.5, 0.5]
        assert coords.amax(dim=0).tolist() == [4.5, 3.5]  # rows, columns
        self.asked.append(camera_indices)
        return torch.full((len(coords), 3), camera_indices / 10)

    def forward(self, rays: torch.Tensor) -> dict[str, torch.Tensor]:
        assert not self.training
        return {"rgb": rays + 0.2}


def test_at_the_end_test_photographs_are_looked_at() -> None:
    host = OneColour()
    psnr = HeldOutPsnr(host, SimpleNamespace(eval_dataset=host, train_dataset=None))
    error = (7 * 0.2**2 + 0.1**2) / 8  # 0.9 + 0.2 is shown as white
    assert psnr.look_at_tests() == pytest.approx(-10.0 * math.log10(error), abs=1e-4)
    assert host.asked == [0, 1, 3, 4, 5, 6, 8, 9]
    assert host.training and psnr.of_one_colour == pytest.approx(10.6, abs=0.3)
    assert HeldOutPsnr(host, SimpleNamespace(train_dataset=host)).look_at_tests() is None


class Hiding(OneColour):
    """The same, white but for four pixels in the middle; masks show those, and none of the first
    photograph."""

    def __init__(self, masked: bool) -> None:
        super().__init__()
        self.masked = masked

    def get_data(self, number: int) -> dict[str, torch.Tensor]:
        mask = torch.zeros(5, 4, 1, dtype=torch.bool)
        mask[1:3, 1:3] = True
        image = torch.where(mask, super().get_data(number)["image"], 1.0)
        return {"image": image} | ({"mask": mask & (number > 0)} if self.masked else {})

    def generate_rays(self, camera_indices: int, coords: torch.Tensor) -> torch.Tensor:
        return torch.full((len(coords), 3), camera_indices / 10)


@pytest.mark.parametrize(("masked", "radius", "ordinary"), [(True, None, 6), (False, 1.5, 7)])
def test_what_masks_and_lenses_hide_of_test_photographs_does_not_count(
    masked: bool, radius: float | None, ordinary: int
) -> None:
    host = Hiding(masked)
    manager = SimpleNamespace(
        eval_dataset=host,
        train_dataset=None,
        eval_pixel_sampler=PixelSampler(PixelSamplerConfig(fisheye_crop_radius=radius)),
    )
    error = (ordinary * 0.2**2 + 0.1**2) / (ordinary + 1)
    found = HeldOutPsnr(host, manager).look_at_tests()
    assert found == pytest.approx(-10.0 * math.log10(error), abs=0.2)


def test_drawing_pixels_is_part_of_the_time_spent(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock()

    def draw(_: Any, count: int, share: str) -> tuple[torch.Tensor, torch.Tensor]:
        clock.now += 5.0
        assert share == "all"  # those that calibration leaves for checks count too
        return torch.zeros(count, 3), torch.rand(count, 3)

    monkeypatch.setattr(held_out_psnr, "time", clock)
    monkeypatch.setattr(held_out_psnr, "true_colours", lambda model, truth: truth)
    monkeypatch.setattr(held_out_psnr, "held_out_bundle", draw)
    psnr = HeldOutPsnr(Host(clock, 0.5), None)
    for spent in (5.5, 6.0):  # the second time of the same pixels
        psnr._measure(held_out_psnr.RAYS)
        assert psnr.spent == pytest.approx(spent) and psnr.cost == pytest.approx(0.5)
        assert psnr.due == pytest.approx(clock.now + 10.0)


def test_all_pixels_count_in_however_many_parts_they_are_rendered(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    shown, truth = torch.rand(2, 2500, 3, generator=torch.Generator().manual_seed(0))
    monkeypatch.setattr(held_out_psnr, "true_colours", lambda model, truth: truth)
    monkeypatch.setattr(held_out_psnr, "held_out_bundle", lambda *_, **__: (shown, truth))
    host = OneColour()
    monkeypatch.setattr(host, "forward", lambda rays: {"rgb": rays})
    psnr = HeldOutPsnr(host, None)
    assert psnr._measure(2500) == 2500
    error = float(((shown - truth) ** 2).mean())
    assert psnr.latest == pytest.approx(-10.0 * math.log10(error), abs=1e-4)
    assert psnr.words() == f"{psnr.latest:.1f} dB on held-out pixels"


@pytest.mark.parametrize(("spent", "rays"), [(10.0, 5120), (0.0, 8192), (19.9, 1024)])
def test_the_last_look_is_at_as_many_pixels_as_time_is_left_for(
    spent: float, rays: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of 2,000 s a hundredth may be spent, and 256 pixels take half a second."""
    clock, psnr = Clock(), HeldOutPsnr(None, None)
    psnr.began, psnr.spent, psnr.cost, clock.now = 700.0, spent, 0.5, 2700.0
    psnr.__dict__["has_pixels"] = True
    monkeypatch.setattr(held_out_psnr, "time", clock)
    monkeypatch.setattr(psnr, "_measure", lambda count: count)
    assert psnr.look_last() == rays
