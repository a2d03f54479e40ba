"""Claims about what an occupancy says of itself, and about its picture."""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from ball_occupancy import CENTRE, HALF, RADIUS, WALLS, ball
from PIL import Image

from leco_plugin.chart.theme import new_figure
from leco_plugin.evaluation import occupancy_picture
from leco_plugin.evaluation.inspection import (
    KEPT,
    SKIPPED,
    UNSEEN,
    ViewBox,
    cameras_of,
    candidates,
    describe,
    exposed,
    ray_states,
    whole_box,
)
from leco_plugin.evaluation.occupancy_picture import (
    HORIZONTAL,
    differing_heights,
    draw,
    draw_slice,
    headline,
    heights_seen_from_above,
    interesting_box,
    kept_cells,
    surface_points,
)
from leco_plugin.occupancy import Occupancy

NO_CAMERAS = torch.zeros(0, 3)


def with_report(**report: object) -> Occupancy:
    """The ball with another report."""
    known = ball()
    return Occupancy(known.gate, known.space, known.threshold, report=report)


def test_cells_of_a_box_are_nearly_cubes_with_middles() -> None:
    box = ViewBox(torch.tensor([1.0, -2.0, 0.5]), torch.tensor([5.0, 0.0, 0.6]))
    assert box.cells(8) == (8, 4, 2) and box.middles(8).shape == (8, 4, 2, 3)
    for x, y, z in np.ndindex(8, 4, 2):
        middle = (1.25 + 0.5 * x, -1.75 + 0.5 * y, 0.525 + 0.05 * z)
        assert box.middles(8)[x, y, z].tolist() == pytest.approx(middle)
    drawn = box.draw(2000, seed=3)
    assert torch.equal(drawn, box.draw(2000, seed=3)) and not torch.equal(drawn, box.draw(2000))
    shares = (drawn - box.low) / (box.high - box.low)
    assert bool((shares.amin(dim=0).abs() < 0.01).all() and (shares.amax(dim=0) > 0.99).all())
    assert bool(((shares.mean(dim=0) - 0.5).abs() < 0.03).all())


def test_candidates_lie_evenly_between_the_walls_the_reach_and_the_crop_of_a_ray() -> None:
    """Rays straight down meet the walls at z = 2 and z = -1; steps are a 192nd of the cube."""
    origins = torch.tensor([[1.0, 2.0, 10.0], [1.0, 3.0, 0.5], [1.0, 2.0, 10.0]])
    down = torch.tensor([[0.0, 0.0, -1.0]]).expand(3, 3)
    crop = torch.tensor([0.0, 0.0, 9.0]), torch.tensor([20.0, 20.0, 10.0])
    of_ray, starts, ends = candidates(ball(), origins, down, crop)
    step = 2.0 * HALF / 192
    for ray, (first, last) in enumerate(((8.0, 11.0), (0.02 * HALF, 1.5), (9.0, 10.0))):
        mine = of_ray == ray
        assert float(starts[mine].min()) == pytest.approx(first, abs=1e-5)
        assert float(ends[mine].max()) == pytest.approx(last, abs=step)
        assert int(mine.sum()) == pytest.approx((last - first) / step, abs=1.0)


def test_the_seen_share_is_that_of_the_box() -> None:
    known = ball()
    partly = Occupancy(known.gate, known.space, 0.5, report=known.report).eval()
    partly.seen.cells[:, 48:] = False  # of 64 cells in y
    assert describe(partly)["seen_share_of_box"] == pytest.approx(0.75, abs=0.01)


def test_the_kept_share_is_that_of_the_ball_in_the_box_between_the_walls() -> None:
    volume = 4 / 3 * math.pi * RADIUS**3 / (2 * HALF * 2 * HALF * 3.0)
    assert describe(ball())["kept_share_of_box"] == pytest.approx(volume, rel=0.15)


def test_far_walls_do_not_widen_the_box() -> None:
    box = whole_box(ball())
    assert box.low.tolist() == [-1.0, 0.0, -1.0] and box.high.tolist() == [3.0, 4.0, 2.0]


@pytest.mark.parametrize(
    "report",
    [
        {},
        {"aabb": None, "cameras": 3},
        {"aabb": [0.0, 1.0], "cameras": [[1.0], "x"]},
        {"aabb": ["a"] * 6, "cameras": [[float("nan"), 0.0, 0.0]]},
        {"aabb": [9.0] * 3 + [8.0] * 3, "cameras": []},
    ],
)
def test_a_report_that_says_nothing_useful_is_done_without(report: dict[str, object]) -> None:
    occupancy = with_report(**report)
    assert whole_box(occupancy).low.tolist() == [-1.0, 0.0, -1.5]
    assert len(cameras_of(occupancy)) == 0


def test_what_is_drawn_is_what_is_kept_and_the_cameras() -> None:
    alone, watched = (interesting_box(ball(), c) for c in (NO_CAMERAS, cameras_of(ball())))
    low, high = torch.tensor(CENTRE) - RADIUS, torch.tensor(CENTRE) + RADIUS
    margin = 0.04 * 2.0 * RADIUS + (torch.tensor([4.0, 4.0, 3.0]) - 2.0) / 64
    assert bool(((alone.low - low + margin).abs() < 0.07).all())
    assert bool(((alone.high - high - margin).abs() < 0.07).all())
    everything = Occupancy(ball().gate, ball().space, 0.0, report=ball().report, walls=WALLS)
    box, whole = interesting_box(everything, NO_CAMERAS), whole_box(everything)
    assert torch.equal(box.low, whole.low) and torch.equal(box.high, whole.high)
    assert float(watched.high[2]) > 1.8
    above = interesting_box(ball(), cameras_of(ball()) + torch.tensor([0.0, 0.0, 0.5]))
    assert torch.equal(above.low, alone.low) and torch.equal(above.high, alone.high)


def test_a_camera_far_from_all_others_does_not_shrink_what_is_drawn() -> None:
    near = cameras_of(ball())
    middle = torch.tensor(CENTRE) + torch.tensor([0.0, 0.0, RADIUS])
    many = middle + 0.001 * torch.randn(9, 3, generator=torch.Generator().manual_seed(0))
    far = torch.cat([many, near[near[:, 2].argmax()][None]])
    box, usual = interesting_box(ball(), far), interesting_box(ball(), many)
    assert torch.equal(box.low, usual.low) and torch.equal(box.high, usual.high)


def test_points_are_on_the_surface_and_face_outwards() -> None:
    points, normals = surface_points(kept_cells(ball(), whole_box(ball())), -10.0)
    offsets = points - torch.tensor(CENTRE)
    assert len(points) > 1000
    assert float((offsets.norm(dim=-1) - RADIUS).abs().mean()) < 0.08
    outwards = torch.nn.functional.normalize(offsets, dim=-1)
    assert float((normals * outwards).sum(dim=-1).mean()) > 0.9


def test_points_of_a_picture_begin_two_cells_below_the_ground() -> None:
    ground, cell = 0.5, 4.0 / 128
    points, _ = surface_points(kept_cells(ball(), whole_box(ball())), ground)
    assert ground - 2.0 * cell <= float(points[:, 2].min()) < ground - cell


def few_others(at: torch.Tensor, usual: torch.Tensor) -> torch.Tensor:
    """Heights of the ground: a ditch in 3% of all columns, a pole in 0.1%, `usual` elsewhere."""
    x, y, _ = at.unbind(dim=-1)
    return usual.where(x > 0.12, 0.2).where((x < 3.9) | (y < 2.9), 3.9)


@pytest.mark.parametrize(
    ("kept", "seen"),
    [
        (lambda at: at[:, 2] < 9.0, (0.0, 4.0)),
        (lambda at: (at - 1.0).norm(dim=-1) > 0.3, (0.0, 4.0)),
        (lambda at: at[:, 2] > 9.0, (0.0, 4.0)),
        (lambda at: (at[:, 2] - 2.0).abs() < 0.03, (1.95, 2.08)),
        (lambda at: at[:, 2] < torch.where(at[:, 0] < 2.0, 1.0, 3.0), (0.98, 2.98)),
        (lambda at: at[:, 2] < few_others(at, torch.where(at[:, 0] < 2.0, 1.0, 3.0)), (0.98, 2.98)),
    ],
    ids=["all", "nearly all", "nothing", "a layer", "a step", "a ditch and a pole"],
)
def test_heights_are_those_of_what_is_met_from_above(kept: Any, seen: tuple[float, float]) -> None:
    value = torch.tensor(0.5)
    known: Any = SimpleNamespace(
        threshold=0.5, threshold_value=value, query=lambda at: kept(at).float()
    )
    box = ViewBox(torch.zeros(3), torch.tensor([4.0, 3.0, 4.0]))
    assert heights_seen_from_above(kept_cells(known, box)) == pytest.approx(seen, abs=0.05)


def test_slices_are_drawn_where_most_decisions_differ() -> None:
    """Below z = 1 a tenth of each layer is kept, above z = 2 nine tenths, and half between."""

    def kept(at: torch.Tensor) -> torch.Tensor:
        _, y, z = at.unbind(dim=-1)
        return y < torch.where(z < 1.0, 0.4, torch.where(z < 2.0, 2.0, 3.6))

    known: Any = SimpleNamespace(
        threshold=0.5, threshold_value=torch.tensor(0.5), query=lambda at: kept(at).float()
    )
    box = ViewBox(torch.zeros(3), torch.tensor([2.0, 4.0, 3.0]))
    lower, upper = differing_heights(known, box, 0.0, 3.0)
    assert 0.0 <= lower < 1.0 and 2.0 <= upper <= 3.0
    of_a_history = tuple(4.0 + 2.0 * share for share in HORIZONTAL)
    assert differing_heights(known, box, 4.0, 6.0) == pytest.approx(of_a_history)


def test_a_ray_that_meets_what_is_kept_says_so_whatever_lies_behind() -> None:
    known = ball()
    half_seen = Occupancy(known.gate, known.space, 0.5, report=known.report).eval()
    half_seen.seen.cells[:, 32:] = False  # beyond the middle in y
    shifts = torch.tensor([[0.0, -3.0, 0.0], [-3.0, 1.7, 0.0], [-3.0, -1.7, 0.0]])
    directions = torch.tensor([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    states = ray_states(half_seen, torch.tensor(CENTRE) + shifts, directions)
    assert states.tolist() == [KEPT, UNSEEN, SKIPPED]


@pytest.mark.parametrize("threshold", [0.0, 1.0])
def test_a_picture_is_made_whatever_is_kept(tmp_path: Path, threshold: float) -> None:
    known = ball()
    occupancy = Occupancy(known.gate, known.space, threshold, report=known.report)
    image = np.asarray(Image.open(draw(occupancy, tmp_path / "picture.png")).convert("L"))
    assert min(image.shape) > 600 and image.std() > 30


def test_a_narrow_slice_is_drawn_wider_and_its_numbers_do_not_overlap() -> None:
    figure = new_figure((10.5, 6.4))
    axes = figure.add_axes((0.6, 0.1, 0.3, 0.4))
    box = ViewBox(torch.tensor([0.9, 1.95, -0.7]), torch.tensor([1.1, 2.05, 1.6]))
    draw_slice(axes, ball(), box, 0, 1.0, pixels=64)
    figure.draw_without_rendering()
    assert axes.get_title("right") == "o(x) at x = 1\ny drawn 5.8 times as long"
    assert axes.bbox.width == pytest.approx(axes.bbox.height / 4, rel=0.01)
    boxes = [label.get_window_extent() for label in axes.get_xticklabels()]
    assert boxes and all(one.x1 < other.x0 for one, other in pairwise(boxes))


class Axes:
    """Notes what is asked of it."""

    def __init__(self) -> None:
        self.asked: dict[str, list[tuple[tuple[Any, ...], dict[str, Any]]]] = {}

    def __getattr__(self, name: str) -> Any:
        def ask(*args: Any, **options: Any) -> Any:
            self.asked.setdefault(name, []).append((args, options))
            return SimpleNamespace(set_edgecolor=lambda colour: None)

        return ask


def test_a_slice_shows_o_where_its_axes_say(monkeypatch: pytest.MonkeyPatch) -> None:
    def value(at: torch.Tensor) -> torch.Tensor:
        return at @ torch.tensor([0.1, 0.3, 0.2])

    known: Any = SimpleNamespace(threshold=0.25, threshold_value=torch.tensor(0.25), query=value)
    monkeypatch.setattr(occupancy_picture.inspection, "seen_at", lambda _, at: at[..., 0] < 4.0)
    box = ViewBox(torch.tensor([1.0, -2.0, 0.5]), torch.tensor([5.0, 0.0, 1.0]))
    cameras, under = torch.tensor([[2.0, -1.0, 0.7], [3.0, -1.5, 0.9]]), np.zeros((2, 3, 4))
    axes = Axes()
    draw_slice(
        axes, known, box, 1, -0.5, cameras, lambda at: at[:, 2] > 0.8, pixels=100, under=under
    )
    x, z = 1.0 + 0.04 * (np.arange(100) + 0.5), 0.5 + 0.5 * (np.arange(64) + 0.5) / 64
    shown = 0.1 * x - 0.3 * 0.5 + 0.2 * z[:, None]
    (below, its), ((values,), options) = axes.asked["imshow"]
    np.testing.assert_allclose(values, shown, rtol=1e-5)
    np.testing.assert_allclose(options["alpha"], np.minimum(shown / 0.75, 1.0), rtol=1e-5)
    assert below[0] is under and its["extent"] == options["extent"] == (1.0, 5.0, 0.5, 1.0)
    assert its["origin"] == options["origin"] == "lower"
    assert its["aspect"] == options["aspect"] == 2.0  # a quarter as high as it is wide
    (((u, v, unseen), _),) = axes.asked["contourf"]
    np.testing.assert_allclose(u, x, rtol=1e-5)
    np.testing.assert_allclose(v, z, rtol=1e-5)
    assert (unseen == np.broadcast_to(x >= 4.0, unseen.shape)).all()
    at_threshold, *solid = axes.asked["contour"]
    assert at_threshold[1]["levels"] == [0.25] and len(solid) == 2
    for (_, _, inside), options in solid:
        assert options["levels"] == [0.5]
        assert (inside.numpy() == np.broadcast_to(z[:, None] > 0.8, inside.shape)).all()
    ((places, _),) = axes.asked["scatter"]
    torch.testing.assert_close(torch.stack(places), cameras[:, [0, 2]].T)
    assert {"xlim": (1.0, 5.0), "ylim": (0.5, 1.0)} in [options for _, options in axes.asked["set"]]
    assert {"xlabel": "x", "ylabel": "z"} in [options for _, options in axes.asked["set"]]
    (((title,), _),) = axes.asked["set_title"]
    assert title == "o(x) at y = -0.5, z drawn 2.0 times as long"


def test_points_are_coloured_by_height_and_lit_from_above() -> None:
    from matplotlib import colormaps

    light = torch.nn.functional.normalize(torch.tensor([0.35, -0.55, 0.75]), dim=0)
    points = torch.tensor([[0.0, 0.0, 1.0], [2.0, 0.0, 2.0], [0.0, 3.0, 6.0]])
    axes = Axes()
    normals = torch.stack([light, -light, light])
    occupancy_picture._draw_points(axes, points, normals, (1.0, 5.0))
    (((x, y, z), options),) = axes.asked["scatter"]
    assert (x.tolist(), y.tolist(), z.tolist()) == tuple(points.T.tolist())
    paint, shade = colormaps["viridis"](np.array([0.0, 0.25, 1.0]))[:, :3], [[1.0], [0.55], [1.0]]
    np.testing.assert_allclose(options["c"], paint * shade, rtol=1e-5)
    assert axes.asked["set_box_aspect"] == [(([2.0, 3.0, 5.0],), {"zoom": 1.4})]


def test_exposed_cells_are_those_with_a_skipped_neighbour() -> None:
    kept = torch.rand(5, 6, 7, generator=torch.Generator().manual_seed(0)) < 0.8
    found, open_ended = exposed(kept), exposed(kept, beyond=True)
    for x, y, z in np.ndindex(*kept.shape):
        beside = [(x + d, y, z) for d in (-1, 1)]
        beside += [(x, y + d, z) for d in (-1, 1)] + [(x, y, z + d) for d in (-1, 1)]
        inside = [p for p in beside if all(0 <= a < n for a, n in zip(p, kept.shape))]
        free = not all(bool(kept[p]) for p in inside)
        assert bool(open_ended[x, y, z]) == (bool(kept[x, y, z]) and free)
        assert bool(found[x, y, z]) == (bool(kept[x, y, z]) and (free or len(inside) < 6))


def test_the_title_of_a_picture_has_ten_words_at_most() -> None:
    assert (
        headline(with_report(empty_fraction=0.739))
        == "This occupancy skips 73.9% of all candidates"
    )
    assert all(len(headline(one).split()) <= 10 for one in (ball(), with_report()))
