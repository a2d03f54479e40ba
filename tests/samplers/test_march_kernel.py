"""The fused march hands out the intervals of `march`, bit for bit where decisions agree."""

from __future__ import annotations

import functools

import pytest
import torch
from samplers.analytic_occupancy import camera_rays
from samplers.kernel_cases import DEVICE, NEAR_THRESHOLD, ON_KERNELS, occupancy
from waits import Waits

from leco_plugin.samplers.cells.build import build_cache
from leco_plugin.samplers.estimator import LearnedOccupancyEstimator
from leco_plugin.samplers.kernels.fused import twins_only
from leco_plugin.samplers.kernels.gate_weights import gate_weights
from leco_plugin.samplers.marching import March, Rays, Samples, march, number

pytestmark = ON_KERNELS

STEP = 1.0 / 16.0
"""A power of two: then a CPU, which may round a product before it adds, has the same edges."""


@functools.cache
def estimator(kind: str, precision: str = "float32") -> LearnedOccupancyEstimator:
    asked = occupancy(kind, precision, octaves=2, width=16)
    made = LearnedOccupancyEstimator(asked, cache_bytes=0)
    made.cache = build_cache(asked, budget=1 << 17, tolerance=1e-2, check_points=1 << 14)
    return made


def rays_of(count: int, t_maxs: torch.Tensor | float, near: float = 0.0) -> Rays:
    origins, directions = camera_rays(count)
    t_mins, t_maxs = torch.full((count,), near), torch.as_tensor(t_maxs).expand(count).clone()
    return Rays(*(tensor.to(DEVICE) for tensor in (origins, directions, t_mins, t_maxs)))


def fused(made: LearnedOccupancyEstimator, rays: Rays, rule: March) -> Samples:
    from leco_plugin.samplers.kernels.march_kernel import march_kept

    assert made.cache is not None
    return march_kept(made.cache, gate_weights(made.occupancy), number(rays, rule))


def twin(made: LearnedOccupancyEstimator, rays: Rays, rule: March) -> Samples:
    with twins_only():
        return march(rays, rule, *made.questions())


def as_set(samples: Samples) -> set[tuple[float, float, float]]:
    return set(zip(*(tensor.tolist() for tensor in samples), strict=True))


def assert_same(made: LearnedOccupancyEstimator, rays: Rays, rule: March) -> int:
    """The two agree, but for candidates close to the threshold; how many are kept."""
    ours, torchs = fused(made, rays, rule), twin(made, rays, rule)
    for one, other in zip(ours, torchs, strict=True):
        assert one.dtype == other.dtype and one.device == other.device
    order = ours[0].double() * 1e6 + ours[1].double()
    assert bool((order[1:] > order[:-1]).all())  # by ray, then t
    differing = sorted(as_set(ours) ^ as_set(torchs))
    assert len(differing) <= 2 + 0.005 * len(torchs[0])
    if differing:
        found = torch.tensor(differing, device=DEVICE)
        middles = (found[:, 1] + found[:, 2])[:, None] / 2.0
        which = found[:, 0].long()
        values = made.occupancy.query(rays.origins[which] + rays.directions[which] * middles)
        far = (values - made.occupancy.threshold_value).abs()
        # a plane of a cell decides within its own error of the threshold
        assert far.max() < NEAR_THRESHOLD["bfloat16"] + 0.05
    return len(torchs[0])


@pytest.mark.parametrize(
    ("kind", "precision", "cone_angle"),
    [
        ("box", "float32", 0.0),
        ("box", "bfloat16", 1.0 / 16.0),
        ("contraction", "float32", 1.0 / 16.0),
        ("contraction", "bfloat16", 0.0),
    ],
)
def test_intervals_are_those_of_the_twin(kind: str, precision: str, cone_angle: float) -> None:
    rays = rays_of(6, torch.linspace(0.4, 5.0, 6), near=0.5)
    assert assert_same(estimator(kind, precision), rays, March(STEP, cone_angle)) > 20


def test_a_box_and_a_jitter_are_honoured() -> None:
    generator = torch.Generator().manual_seed(2)
    jitter = (torch.rand(3, generator=generator) * 8.0).floor() / 8.0
    rays = rays_of(3, 3.0).shifted(jitter.to(DEVICE) * STEP)
    t_enters = torch.linspace(0.0, 3.5, 3, device=DEVICE)
    assert_same(estimator("box"), rays._replace(t_enters=t_enters), March(STEP))


def test_any_step_has_the_edges_of_the_twin_but_for_a_rounding() -> None:
    made, rays = estimator("box"), rays_of(2, 4.0)
    ours, torchs = fused(made, rays, March(0.07)), twin(made, rays, March(0.07))
    assert abs(len(ours[0]) - len(torchs[0])) <= 2
    if len(ours[0]) == len(torchs[0]):
        torch.testing.assert_close(ours[1], torchs[1], atol=1e-6, rtol=0.0)


@pytest.mark.parametrize("count", [0, 1])
def test_few_rays_and_rays_without_candidates(count: int) -> None:
    samples = fused(estimator("box"), rays_of(count, 0.0), March(STEP))
    assert [len(tensor) for tensor in samples] == [0, 0, 0]
    assert samples[0].dtype == torch.int64 and samples[1].dtype == torch.float32


def test_rays_that_are_no_rays_keep_nothing_and_harm_no_other() -> None:
    made, rays = estimator("contraction"), rays_of(5, 3.0)
    rays.origins[0], rays.origins[1, 2] = torch.nan, torch.inf
    rays.directions[2], rays.origins[3] = 0.0, 1e20
    rays.t_maxs[3] = -1.0
    samples = fused(made, rays, March(STEP))
    assert not torch.isin(samples[0], torch.tensor([0, 1, 2, 3], device=DEVICE)).any()
    assert as_set(samples) == as_set(twin(made, rays, March(STEP)))


def test_rays_wait_once_for_the_device(monkeypatch) -> None:
    from leco_plugin.samplers.kernels import march_kernel

    made, count = estimator("contraction"), 4
    weights = gate_weights(made.occupancy)
    launches = []

    class Kernel:
        def __getitem__(self, grid):
            def launch(*arguments, **_):
                launches.append(grid)
                arguments[7].fill_(3)  # found

            return launch

    monkeypatch.setattr(march_kernel, "_march_kernel", Kernel())
    rays = rays_of(count, 3.0)
    with Waits() as waits:
        candidates = number(rays, March(STEP, 1.0 / 64.0))
        samples = march_kernel.march_kept(made.cache, weights, candidates)
    assert waits.seen == ["tolist"] and launches == [(count,)] * 2
    assert [len(part) for part in samples] == [3 * count] * 3


def test_a_ray_without_an_end_is_named() -> None:
    with pytest.raises(ValueError, match="give a far plane"):
        fused(estimator("box"), rays_of(2, torch.tensor([1.0, 1e10])), March(STEP))
