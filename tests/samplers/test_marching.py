"""The marching rule against one step at a time, and what bad rays get."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from samplers.analytic_occupancy import Balls, camera_rays, slow_march
from waits import Waits

from leco_plugin.samplers import marching
from leco_plugin.samplers.boxes import intersect_box
from leco_plugin.samplers.estimator import LearnedOccupancyEstimator
from leco_plugin.samplers.grid import OccupancyGridEstimator
from leco_plugin.samplers.kernels import VARIABLE
from leco_plugin.samplers.marching import (
    RUN,
    March,
    Rays,
    by_column,
    march,
    places_by_column,
    places_by_column_in_runs,
)
from leco_plugin.samplers.rays import candidate_counts, candidate_edges

finite = st.floats(-2.0, 4.0)


def assert_marched(samples, expected) -> None:
    ray_indices, t_starts, t_ends = samples
    assert ray_indices.tolist() == [ray for ray, _, _ in expected]
    assert t_starts.tolist() == pytest.approx([start for _, start, _ in expected], abs=1e-9)
    assert t_ends.tolist() == pytest.approx([end for _, _, end in expected], abs=1e-9)


@settings(deadline=None, max_examples=60)
@given(
    bounds=st.lists(st.tuples(finite, finite), min_size=0, max_size=6),
    step_size=st.floats(0.01, 0.5),
    cone_angle=st.sampled_from([0.0, 0.004, 0.1, 1.0]),
    chunk_size=st.sampled_from([1, 7, 100, 10**6]),
    asked=st.booleans(),
)
def test_marching_is_one_step_after_the_other(bounds, step_size, cone_angle, chunk_size, asked):
    origins, directions = (rays.double() for rays in camera_rays(len(bounds)))
    t_mins, t_maxs = torch.tensor(bounds, dtype=torch.float64).reshape(-1, 2).unbind(-1)
    occupied = (lambda positions: positions[:, 0] > 0.0) if asked else None
    rays, rule = Rays(origins, directions, t_mins, t_maxs), March(step_size, cone_angle)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(marching, "CPU_CHUNK", chunk_size)
        samples = march(rays, rule, occupied)
    expected = slow_march(origins, directions, t_mins, t_maxs, step_size, cone_angle, occupied)
    assert_marched(samples, expected)


def test_neighbours_share_their_edge_exactly(monkeypatch):
    monkeypatch.setattr(marching, "CPU_CHUNK", 50)
    origins, directions = camera_rays(20)
    rays = Rays(origins, directions, torch.zeros(20), torch.full((20,), 3.0))
    for cone_angle in (0.0, 0.01):
        ray_indices, t_starts, t_ends = march(rays, March(0.01, cone_angle))
        same_ray = ray_indices[1:] == ray_indices[:-1]
        assert t_starts[1:][same_ray].equal(t_ends[:-1][same_ray])


@pytest.mark.parametrize("cone_angle", [0.0, 0.02])
def test_entering_late_leaves_candidates_where_they_are(cone_angle):
    origins, directions = camera_rays(30)
    t_mins, t_maxs = torch.zeros(30), torch.full((30,), 3.0)
    t_enters, _ = intersect_box(origins, directions, torch.tensor([-0.5] * 3 + [0.5] * 3))
    rays = Rays(origins, directions, t_mins, t_maxs, t_enters)
    samples = march(rays, March(0.05, cone_angle))
    expected = slow_march(
        origins.double(), directions.double(), t_mins, t_maxs, 0.05, cone_angle, None, t_enters
    )
    assert samples[0].tolist() == [ray for ray, _, _ in expected]
    assert samples[1].tolist() == pytest.approx([start for _, start, _ in expected], abs=1e-5)


@pytest.mark.parametrize("uniform", [True, False])
def test_a_coarse_question_changes_the_time_and_not_the_result(uniform):
    balls = Balls()
    origins, directions = camera_rays(200)
    t_mins = torch.zeros(200)
    t_maxs = torch.full((200,), 4.0) if uniform else torch.rand(200) * 4.0
    asked = {"coarse": 0, "near": 0}

    def near(positions, radii):
        distances = (positions[:, None] - balls.centers).norm(dim=-1) - balls.radii - 0.1
        answers = (distances < radii[:, None]).any(dim=-1)
        asked["coarse"] += len(answers)
        asked["near"] += int(answers.sum())
        return answers

    rays, rule = Rays(origins, directions, t_mins, t_maxs), March(0.01)
    plain = march(rays, rule, balls.occupied)
    questions = balls.asked
    balls.asked = 0
    coarse = march(rays, rule, balls.occupied, near)
    for one, other in zip(plain, coarse, strict=True):
        assert one.equal(other)
    assert balls.asked <= asked["near"] * RUN < 0.5 * questions


@pytest.mark.parametrize("length", [0.1, 1.0, 10.0])
def test_a_coarse_question_is_about_a_cube_that_holds_its_run(length):
    """However long directions are, of which t counts multiples."""
    origins, directions = camera_rays(50)
    rays = Rays(origins, length * directions, torch.zeros(50), torch.full((50,), 4.0 / length))
    asked, cubes = [], []

    def near(positions, radii):
        cubes.append((positions, radii))
        return torch.ones(len(positions), dtype=torch.bool)

    def occupied(positions):
        asked.append(positions)
        return torch.ones(len(positions), dtype=torch.bool)

    march(rays, March(0.01 / length), occupied, near)
    (centers, radii), places = cubes[0], asked[0]
    assert len(places) == RUN * len(centers)
    # in the coarse question rays are columns, as everywhere in a march
    runs = centers.view(-1, 50, 3).transpose(0, 1).reshape(-1, 3)
    wide = radii.view(-1, 50).T.reshape(-1)
    beyond = (places.view(RUN, -1, 3) - runs).abs().amax(dim=-1) - wide
    assert -0.01 < float(beyond.max()) <= 1e-5  # the outermost middles are half a step inside


def test_bad_rays_have_no_samples_and_good_ones_keep_theirs():
    origins, directions = camera_rays(8)
    t_mins, t_maxs = torch.zeros(8), torch.ones(8)
    rays = Rays(origins, directions, t_mins, t_maxs)
    clean = march(rays, March(0.1))
    origins[0, 1], directions[1, 2], origins[2, 0] = torch.nan, torch.nan, torch.inf
    directions[3] = 0.0
    t_mins[4], t_maxs[5] = 2.0, torch.nan
    ray_indices, t_starts, _ = march(rays, March(0.1))
    assert set(ray_indices.tolist()) == {6, 7}
    assert t_starts[ray_indices == 7].equal(clean[1][clean[0] == 7])


def test_no_rays_is_no_samples():
    nothing = Rays(torch.zeros(0, 3), torch.zeros(0, 3), torch.zeros(0), torch.zeros(0))
    ray_indices, t_starts, t_ends = march(nothing, March(0.1))
    assert ray_indices.dtype == torch.int64
    assert ray_indices.shape == t_starts.shape == t_ends.shape == (0,)


def test_rays_that_cannot_be_marched_are_refused_in_one_line():
    origins, directions = camera_rays(3)
    ones, zeros = torch.ones(3), torch.zeros(3)
    rays = Rays(origins, directions, zeros, ones)
    for far in (1e10, torch.inf):
        with pytest.raises(ValueError, match="give a far plane"):
            march(rays._replace(t_maxs=ones * far), March(1e-3))
    with pytest.raises(ValueError, match="begin nearer"):  # too far away to number the steps
        march(rays._replace(t_maxs=ones * 3e9, t_enters=ones * 2e9), March(1.0))
    missed = march(rays._replace(t_maxs=ones * 2e9, t_enters=ones * 3e9), March(1.0))
    assert missed[0].numel() == 0
    halves = Rays(*(tensor.half() for tensor in rays[:4]))
    for wrong, said in (
        (rays._replace(directions=directions[:2]), r"rays_d must be \[3, 3\], got \[2, 3\]"),
        (rays._replace(t_mins=zeros[:, None]), r"t_mins must be \[3\], got \[3, 1\]"),
        (rays._replace(t_maxs=ones.double()), r"t_maxs is torch\.float64"),
        (halves, r"float32 or float64, got torch\.float16"),
    ):
        with pytest.raises(ValueError, match=said):
            march(wrong, March(0.1))
    for rule in (March(0.0), March(torch.nan), March(0.1, -1.0)):
        with pytest.raises(ValueError, match="got"):
            march(rays, rule)


@pytest.mark.parametrize("length", [0.05, 10.0])
def test_memory_is_bounded_by_the_chunk(length, monkeypatch):
    monkeypatch.setattr(marching, "CPU_CHUNK", 500)
    origins, directions = camera_rays(100)
    largest = 0

    def occupied(positions):
        nonlocal largest
        largest = max(largest, len(positions))
        return positions[:, 0] > 10.0

    rays = Rays(origins, directions, torch.zeros(100), torch.linspace(0.0, length, 100))
    march(rays, March(0.01), occupied)
    assert largest <= 500


@pytest.fixture
def as_on_a_device(monkeypatch):
    """On a CPU packing searches twice, which costs nothing there; elsewhere once."""
    monkeypatch.setattr(marching, "places_by_column_in_runs", places_by_column)


@pytest.mark.usefixtures("as_on_a_device")
@pytest.mark.parametrize("chunk_size", [10**6, 2000])
def test_of_even_rays_each_chunk_is_waited_for_once(chunk_size, monkeypatch):
    monkeypatch.setattr(marching, "CPU_CHUNK", chunk_size)
    origins, directions = camera_rays(100)
    rays = Rays(origins, directions, torch.zeros(100), torch.ones(100))
    chunks = 0

    def occupied(positions):
        nonlocal chunks
        chunks += 1
        return positions[:, 0] > 0.0

    with Waits() as waits:
        march(rays, March(0.01), occupied)
    assert waits.seen == ["tolist"] + ["nonzero"] * chunks
    assert (chunks > 1) == (chunk_size < 10_000)


def through_cells():
    return LearnedOccupancyEstimator(Balls(), cache_bytes=1 << 16)


def grid():
    made = OccupancyGridEstimator([-1.0] * 3 + [1.0] * 3, resolution=16)
    made.binaries.fill_(True)
    return made


@pytest.mark.usefixtures("as_on_a_device")
@pytest.mark.parametrize(("build", "searches"), [(through_cells, 4), (grid, 2)])
def test_an_estimator_waits_as_often_as_docs_gpu_says(build, searches, monkeypatch):
    monkeypatch.setenv(VARIABLE, "native")  # which no device has
    estimator = build()

    def waits() -> list[str]:
        with Waits() as counted:
            estimator.sampling(*camera_rays(500), render_step_size=0.08, far_plane=6.0)
        return [name for name in counted.seen if name != "__bool__"]  # of a space, on a CPU only

    assert waits() == ["tolist"] + ["nonzero"] * searches


@settings(deadline=None)
@given(seed=st.integers(0, 2**16))
def test_boxes_are_entered_and_left_where_they_are_cut(seed):
    torch.manual_seed(seed)
    origins, directions = torch.randn(20, 3), torch.randn(20, 3)
    directions[0], origins[0, 1] = torch.tensor([1.0, 0.0, 0.0]), 0.3
    box = torch.tensor([-0.5, -0.7, -0.3, 0.4, 0.9, 0.6])
    for ray, face in ((1, box[0]), (2, box[3])):  # along a face
        directions[ray], origins[ray] = torch.tensor([0.0, 1.0, 0.0]), torch.tensor([face, 0, 0.1])
    enters, leaves = intersect_box(origins, directions, box)
    for ray in range(20):
        t = torch.linspace(-6.0, 6.0, 2001)
        points = origins[ray] + directions[ray] * t[:, None]
        inside = ((points >= box[:3]) & (points <= box[3:])).all(dim=-1)
        by_bounds = (t >= enters[ray]) & (t <= leaves[ray])
        assert (inside != by_bounds).sum() <= 2  # rounding on the two faces


@pytest.mark.parametrize("cone_angle", [0.0, 0.02])
def test_float32_edges_stay_within_rounding_of_float64(cone_angle):
    t_mins = torch.rand(50, 1) * 0.1
    steps = torch.arange(2000.0)
    edges = candidate_edges(t_mins, steps, 1e-3, cone_angle)
    exact = candidate_edges(t_mins.double(), steps.double(), 1e-3, cone_angle)
    torch.testing.assert_close(edges.double(), exact, rtol=5e-6, atol=1e-7)


@settings(deadline=None)
@given(seed=st.integers(0, 2**16), cone_angle=st.sampled_from([0.0, 0.003]))
def test_the_last_candidate_is_the_last_midpoint_in_front_of_the_end(seed, cone_angle):
    torch.manual_seed(seed)
    t_mins = torch.rand(100)
    t_maxs = t_mins + torch.rand(100) * 5.0
    counts = candidate_counts(t_mins, t_maxs, 0.01, cone_angle)
    edges = candidate_edges(t_mins[:, None], torch.arange(1003.0), 0.01, cone_angle)
    midpoints = (edges[:, :-1] + edges[:, 1:]) * 0.5
    assert counts.equal((midpoints < t_maxs[:, None]).sum(dim=-1).float())
    ends = torch.stack([t_maxs, t_mins - 1.0])
    assert candidate_counts(t_mins, ends, 0.01, cone_angle).equal(
        torch.stack([counts, torch.zeros(100)])
    )


def slow_by_column(wanted) -> list[tuple[int, int]]:
    n, m = wanted.shape
    return [(column, row) for column in range(m) for row in range(n) if wanted[row, column]]


@settings(deadline=None, max_examples=40)
@given(
    n=st.integers(1, 3 * RUN),
    m=st.integers(0, 9),
    share=st.sampled_from([0.0, 0.05, 0.5, 1.0]),
    seed=st.integers(0, 2**16),
)
def test_true_entries_come_by_column_then_row(n, m, share, seed):
    wanted = torch.rand(n, m, generator=torch.Generator().manual_seed(seed)) < share
    expected = slow_by_column(wanted)
    columns, rows = by_column(wanted)
    assert columns.dtype == rows.dtype == torch.int64
    assert list(zip(columns.tolist(), rows.tolist(), strict=True)) == expected
    for function in (places_by_column, places_by_column_in_runs):
        columns, places = function(wanted)
        assert columns.dtype == places.dtype == torch.int64
        assert columns.tolist() == [column for column, _ in expected]
        assert places.tolist() == [row * m + column for column, row in expected]
