"""The scene of the kit is known exactly, and its gate is a gate like any other."""

from __future__ import annotations

from typing import get_args

import pytest
import torch

from leco_plugin.conformance import scene
from leco_plugin.conformance.proposals import chords
from leco_plugin.conformance.rules import Broken
from leco_plugin.models.encodings import Kind
from leco_plugin.occupancy import Occupancy

SLABS = [scene.SLAB, scene.OTHER, scene.EVERYTHING, scene.TWO]


@pytest.mark.parametrize("kind", get_args(Kind))
@pytest.mark.parametrize("slab", SLABS)
def test_the_gate_decides_as_the_slab_is_defined(slab, kind):
    offsets = (torch.rand(100_000, 3) - 0.5) * 2.4 * scene.HALF
    positions = torch.tensor(scene.CENTRE) + offsets
    from_middle = (offsets @ torch.tensor(slab.normal)).abs()
    from_plane = (from_middle - slab.offset * scene.HALF).abs()
    expected = (offsets.abs().amax(dim=-1) <= scene.HALF) & (
        from_plane <= slab.half_width * scene.HALF
    )
    occupancy = slab.occupancy(kind)
    clear = slab.depth(positions).abs() > 1e-4  # nearer than that a rounding decides
    assert clear.float().mean() > 0.99
    assert occupancy.occupied(positions)[clear].equal(expected[clear])
    assert (slab.depth(positions)[clear] > 0.0).equal(expected[clear])
    assert slab.density(positions).shape == (100_000, 1)


def test_everything_is_all_of_the_box():
    positions = torch.tensor(scene.CENTRE) + (torch.rand(1000, 3) - 0.5) * 1.99 * scene.HALF
    assert scene.EVERYTHING.occupancy().occupied(positions).all()


@pytest.mark.parametrize("kind", get_args(Kind))
def test_the_gate_is_saved_and_loaded_like_a_learned_one(kind, tmp_path):
    scene.SLAB.occupancy(kind).save(tmp_path / "slab.safetensors")
    loaded = Occupancy.load(tmp_path / "slab.safetensors")
    positions = torch.tensor(scene.CENTRE) + torch.randn(1000, 3)
    assert loaded.query(positions).equal(scene.SLAB.occupancy(kind).query(positions))


def test_rays_cross_the_slab_or_have_nothing_to_sample():
    rays = scene.crossing()
    t = torch.linspace(0.0, 2.0 * scene.DISTANCE, 600)
    depths = scene.SLAB.depth(rays.origins[:, None] + rays.directions[:, None] * t[:, None])
    assert (depths.amax(dim=1) > scene.MARGIN).all()
    missing = scene.without_samples()["rays that miss the box"]
    depths = scene.EVERYTHING.depth(
        missing.origins[:, None] + missing.directions[:, None] * t[:, None]
    )
    assert (depths < 0.0).all()


def test_rays_from_within_begin_in_the_box_and_leave_it_also_along_each_axis():
    rays, (low, high) = scene.within(), scene.box().view(2, 3)
    assert ((rays.origins > low) & (rays.origins < high)).all()
    ends = rays.origins + rays.directions * rays.t_max[:, None]
    assert ((ends < low) | (ends > high)).any(dim=1).all()
    assert ((rays.directions == 0.0).sum(dim=1) == 2).sum() == 6


def test_a_chord_ends_where_the_slab_does_to_a_hundredth():
    rays = scene.cut_short()
    enters, leaves = chords(rays)
    met = leaves > enters
    assert met.any()

    def depth(t):
        return scene.SLAB.depth(rays.origins + rays.directions * t[:, None])[met]

    assert (depth(enters) >= 0.0).all() and (depth(leaves) >= 0.0).all()
    assert (depth(enters - 0.0101) < 0.0).all() and (depth(leaves + 0.0101) < 0.0).all()


@pytest.mark.parametrize(
    ("ray", "t", "is_covered"),
    [
        *((0, 0.5, False), (0, 1.5, True), (0, 2.5, False), (0, 3.5, True), (0, 4.5, False)),
        *((1, 0.5, False), (1, 1.5, False), (1, 2.5, True), (1, 3.5, False)),
    ],
)
def test_a_place_is_covered_between_the_ends_of_a_sample_of_its_own_ray(ray, t, is_covered):
    starts, ends = torch.tensor([3.0, 2.0, 1.0]), torch.tensor([4.0, 3.0, 2.0])
    samples = torch.tensor([0, 1, 0]), starts, ends  # in no order
    assert scene.covered(torch.tensor([ray]), torch.tensor([t]), samples).tolist() == [is_covered]


@pytest.mark.parametrize(
    ("edges", "problem"),
    [
        ([(1.0, 1.1), (1.5, 1.6), (1.94, 2.04)], None),  # its middle is before the far end
        ([(1.0, 1.1), (1.94, 2.08)], "middle beyond"),
        ([(1.0, 1.1), (2.04, 2.1)], "middle beyond"),
        ([(0.98, 1.1), (1.5, 1.6)], "begins before"),
        ([(0.9, 1.08)], "begins before"),
        ([(1.2, 1.1)], "does not end"),
        ([(1.1, 1.1)], "does not end"),
        ([(1.0, 1.2), (1.19, 1.3)], "overlaps"),
        ([(1.3, 1.4), (1.0, 1.1)], "overlaps"),
        ([], "no samples"),
    ],
)
@pytest.mark.parametrize("ray", [0, 1])
def test_samples_follow_one_another_between_the_ends_of_their_own_ray(ray, edges, problem):
    """The other ray goes from 3 to 9, and has one sample if this one has any."""
    near, far = torch.tensor([1.0, 3.0]), torch.tensor([2.0, 9.0])
    if ray == 1:
        near, far = near.flip(0), far.flip(0)
    nowhere = torch.zeros(2, 3)
    rays = scene.Rays(nowhere, nowhere, near, far)
    found = [(ray, *edge) for edge in edges] + [(1 - ray, 5.0, 6.0)] * bool(edges)
    numbers, *places = torch.tensor(sorted(found, key=lambda one: one[0])).view(-1, 3).T
    samples = numbers.long(), *places
    if problem is None:
        scene.check_intervals(rays, samples)
    else:
        with pytest.raises(Broken, match=problem):
            scene.check_intervals(rays, samples)
