"""Claims about the picture and the page of a chart, and about where names of points stand."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import needs_chromium, text_of_what_asks_nobody
from chart_results import grid, occupancy, results, run
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text
from page_text import figure_text
from PIL import Image

from leco_plugin.chart import picture
from leco_plugin.chart.page import write_page
from leco_plugin.chart.panels import Panel, Point
from leco_plugin.chart.picture import (
    BAR,
    Boxes,
    _draw_learning,
    balanced,
    covered,
    draw,
    draw_curves,
    draw_panel,
    name_ends,
    name_points,
    rims,
    spread,
)
from leco_plugin.chart.summary import best_so_far, lines_of
from leco_plugin.chart.theme import DARK, LIGHT, SOURCE, Theme, fingerprint, style

RUNS = [
    run(name, seed, psnr + seed) for name, psnr in (("A", 20.0), ("B", 23.0)) for seed in (0, 1)
]


def share_of(colour: str, path: Path) -> float:
    """Of the picture's pixels that have about this colour."""
    pixels = np.asarray(Image.open(path).convert("RGB")).astype(int)
    wanted = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)])
    return float((np.abs(pixels - wanted).max(axis=-1) < 8).mean())


@pytest.mark.parametrize("theme", [LIGHT, DARK], ids=["light", "dark"])
def test_every_contender_is_drawn_in_its_colour(theme: Theme, tmp_path: Path) -> None:
    path = draw(results(*RUNS), tmp_path / "chart.png", theme)
    assert share_of(theme.page, path) > 0.5
    assert all(share_of(colour, path) > 1e-3 for colour in theme.colours[:2])
    assert share_of(theme.colours[2], path) < 1e-3


def luminance(colour: str) -> float:
    """Relative luminance of WCAG 2."""
    parts = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    linear = [
        part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts
    ]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


@pytest.mark.parametrize("theme", [LIGHT, DARK], ids=["light", "dark"])
def test_every_colour_can_be_read_on_its_page(theme: Theme) -> None:
    for colour in (theme.ink, *theme.colours):
        low, high = sorted([luminance(theme.page), luminance(colour)])
        assert (high + 0.05) / (low + 0.05) >= 3.9, colour


def test_names_at_the_ends_of_curves_give_the_mean_of_the_last_psnr_as_the_title_does() -> None:
    seeds = [run("A", seed, 20.0 + seed) for seed in (0, 1)]
    for point in seeds[1]["curve"]:
        point[0] *= 2.0  # as many steps, twice the time
    (line,) = lines_of(results(*seeds))
    axes = Figure().add_subplot()
    name_ends(axes, [line], LIGHT)
    assert [text.get_text() for text in axes.texts] == [f"A  {line.psnr:.1f}"] == ["A  20.5"]
    assert line.curve()[1][-1] == line.psnr  # where its name points to


def test_the_front_of_the_curves_is_the_best_that_anybody_has_reached_by_then() -> None:
    early = run("A", curve=[[2.0, 10.0], [4.0, 14.0], [8.0, 13.0]])
    late = run("B", curve=[[4.0, 8.0], [8.0, 16.0]])
    times, best = best_so_far(lines_of(results(early, late)))
    at = dict(zip(times.round(6).tolist(), best.tolist()))
    assert (times[0], times[-1]) == (2.0, 8.0)
    assert at[2.0] == pytest.approx(10.0) and at[8.0] == pytest.approx(16.0)
    assert np.interp(6.0, times, best) == pytest.approx(14.0, abs=0.1)  # what was reached stays
    assert (np.diff(best) >= 0.0).all()


def test_nobody_has_reached_anything_before_the_first_point_of_a_curve() -> None:
    early = run("A", curve=[[2.0, 10.0], [8.0, 14.0]])
    late = run("B", curve=[[6.0, 13.5], [8.0, 16.0]])
    times, best = best_so_far(lines_of(results(early, late)))
    assert np.interp(4.0, times, best) == pytest.approx(11.3, abs=0.1)
    assert np.interp(6.1, times, best) == pytest.approx(13.6, abs=0.1)


def test_a_marker_that_others_lie_on_is_larger_than_they_are() -> None:
    axes = Figure(figsize=(5, 5)).add_subplot()
    axes.set(xlim=(0.0, 100.0), ylim=(0.0, 100.0))
    under, on, beside, far = rims(axes, [(50.0, 50.0), (50.5, 50.0), (53.0, 50.0), (90.0, 50.0)])
    assert under > on == beside == far == 0.0
    assert rims(axes, []) == []
    wide = Figure(figsize=(5, 3), dpi=150).add_axes((0.0, 0.0, 1.0, 1.0))
    wide.set(xlim=(0.0, 360.0), ylim=(0.0, 216.0))  # points
    places = [(50.0, 50.0), (53.9, 50.0), (50.0, 53.9), (50.0, 45.9), (54.1, 50.0)]
    assert rims(wide, places) == [8.0, 4.0, 0.0, 0.0, 0.0]


def test_what_names_share_with_others_is_an_area() -> None:
    some = np.array([[0.0, 0.0, 2.0, 1.0], [0.0, 0.0, 1.0, 4.0]])
    others = np.array([[1.0, 0.5, 3.0, 3.0], [0.5, 2.0, 6.0, 6.0]])
    assert covered(some, others) == 1.0 * 0.5 + 0.5 * 2.0


def points_at(*places: tuple[float, float], less: bool = True, more_x: bool = False) -> Panel:
    return Panel("a", tuple(Point("a", x, y, 0) for x, y in places), less, more_x)


@pytest.mark.parametrize(
    ("xs", "scale", "limits"),
    [
        ((1.0, 8.1), "log", (0.6, 1.7 * 8.1)),
        ((0.0, 1.0, 9.0), "log", (0.6, 15.3)),
        ((1.0, 7.9), "linear", (0.0, 1.15 * 7.9)),
    ],
)
def test_costs_of_a_wide_range_are_drawn_on_a_logarithmic_axis(
    xs: tuple[float, ...], scale: str, limits: tuple[float, float]
) -> None:
    axes: Any = Figure().add_subplot()
    draw_panel(axes, points_at(*((x, 2.0 * x) for x in xs)), LIGHT)
    assert (axes.get_xscale(), axes.get_yscale()) == (scale, "linear")
    assert axes.get_xlim() == pytest.approx(limits) and axes.yaxis_inverted()
    by_psnr: Any = Figure().add_subplot()
    draw_panel(by_psnr, points_at((1.0, 3.0), (2.0, 4.0), more_x=True, less=False), LIGHT)
    assert (by_psnr.get_xscale(), by_psnr.get_yscale()) == ("linear", "log")
    assert not by_psnr.yaxis_inverted()


@pytest.mark.parametrize(
    ("less", "more_x", "front"),
    [
        (True, False, [(1.0, 5.0), (2.0, 3.0)]),
        (False, False, [(1.0, 5.0), (4.0, 9.0)]),
        (True, True, [(4.0, 9.0), (3.0, 4.0), (2.0, 3.0)]),
        (False, True, [(4.0, 9.0)]),
    ],
)
def test_the_border_of_what_is_beaten_goes_from_the_worst_to_the_end_of_the_panel(
    less: bool, more_x: bool, front: list[tuple[float, float]]
) -> None:
    panel = points_at((1.0, 5.0), (2.0, 3.0), (3.0, 4.0), (4.0, 9.0), less=less, more_x=more_x)
    axes: Any = Figure().add_subplot()
    draw_panel(axes, panel, LIGHT)
    (left, right), worst = axes.get_xlim(), axes.get_ylim()[0]
    found = axes.lines[-1].get_xydata().tolist()
    end = (left if more_x else right, front[-1][1])
    expected = [(front[0][0], worst), *front, end]
    assert [tuple(each) for each in found] == pytest.approx(expected)


def test_curves_have_room_for_the_longest_run_and_bars_as_long_as_learning_took() -> None:
    runs = [run("A", train_seconds=30.0, learn_seconds=4.0), run("B", train_seconds=50.0)]
    runs += [run("C", train_seconds=20.0, learn_seconds=None), run("B", 1, train_seconds=10.0)]
    lines, axes = lines_of(results(*runs)), Figure().add_subplot()
    draw_curves(axes, lines, LIGHT)
    assert axes.get_xlim() == pytest.approx((0.0, 51.0))
    low, high = axes.get_ylim()
    _draw_learning(axes, lines, LIGHT)
    share = BAR * (2 + 2.2)  # of the panel's height, below the curves
    assert axes.get_ylim()[1] == high
    assert (low - axes.get_ylim()[0]) / (high - axes.get_ylim()[0]) == pytest.approx(share)
    ends = [segment.tolist() for segment in axes.collections[-1].get_segments()]
    of_a, of_b = BAR * 1.8, BAR * 0.8
    assert np.array(ends) == pytest.approx(
        np.array([[[0.0, of_a], [4.0, of_a]], [[0.0, of_b], [3.0, of_b]]])
    )


@pytest.mark.parametrize("x", [0.4, 0.48, 0.6])
def test_a_name_that_fits_nowhere_beside_its_point_stays_in_the_panel(x: float) -> None:
    figure = Figure(figsize=(4, 4))
    axes = figure.add_axes((0.1, 0.1, 0.8, 0.8))
    axes.set(xlim=(0.0, 1.0), ylim=(0.0, 1.0))
    name_points(axes, [(x, 0.5)], ["a name that is wide, far"], ["black"])
    (text,) = axes.texts
    box = text.get_window_extent().transformed(axes.transAxes.inverted())
    assert box.x0 > -0.01 and box.x1 < 1.01
    assert box.width > 0.53, "else it fits beside its point"
    anchor, other = (box.x0, box.x1) if text.get_ha() == "left" else (box.x1, box.x0)
    assert abs(anchor - x) <= abs(other - x) + 0.01, "the line leads to the nearer end"


@pytest.mark.parametrize(("count", "more"), [(2, " + learned occupancy without gifts"), (40, "")])
def test_names_and_bars_of_long_and_many_names_stay_in_the_picture(
    count: int, more: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(picture, "save_picture", lambda figure, *_, **__: figure)
    runs = [run(f"a method {number}{more}", warming_up=True) for number in range(count - 1)]
    odd = results(*runs, run("B"), scene={"name": r"$\odd$"})  # which is no formula
    figure: Any = draw(odd, tmp_path / "chart.png")
    figure.draw_without_rendering()
    axes, page = figure.axes[0], figure.bbox
    boxes = [text.get_window_extent() for text in axes.texts[1:]]
    assert len(boxes) == count and all(box.x1 <= page.x1 for box in boxes)
    assert min(box.y0 for box in boxes) > axes.bbox.y0 - 12.0
    assert axes.get_ylim()[0] < 15.0 < axes.get_ylim()[1], "there is room for the curves"
    assert len({str(style(number, LIGHT)) for number in range(count)}) == count


def test_one_run_with_one_point_is_drawn(tmp_path: Path) -> None:
    alone = run("A", curve=[[9.0, 20.0]], learn_seconds=None, field_queries_per_ray=0.0)
    assert draw(results(alone), tmp_path / "chart.png").stat().st_size > 10_000


def test_representations_and_grids_are_drawn(tmp_path: Path) -> None:
    ours = run("MLP", occupancy=occupancy(50_000, 0.1, [grid(64, 0.3)]))
    other = run("hash grid", sampler="learned-occupancy-hash", occupancy=occupancy(4_000_000, 0.2))
    path = draw(results(ours, other), tmp_path / "chart.png")
    assert all(share_of(colour, path) > 1e-3 for colour in LIGHT.colours[:2])


def test_a_picture_remembers_of_which_results_it_is(tmp_path: Path) -> None:
    with Image.open(draw(results(*RUNS), tmp_path / "chart.png")) as image:
        assert image.info[SOURCE] == fingerprint(results(*RUNS))
        assert image.info[SOURCE] != fingerprint(results(*RUNS[1:]))


def test_a_title_has_as_few_lines_as_it_can_and_no_short_one() -> None:
    text = "learned occupancy is ahead: 21.8 dB, 1.3 more than equal experts, no gate"
    first, second = balanced(text).split("\n")
    assert f"{first} {second}" == text and abs(len(first) - len(second)) < 12
    assert balanced("short") == "short"


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    held = [
        run("A <b>", occupancy=occupancy(50_000, 0.1)),
        run("B", sampler="learned-occupancy-hash", occupancy=occupancy(90, 0.2)),
    ]
    return write_page(results(*held), tmp_path_factory.mktemp("page") / "chart.html")


def test_the_page_asks_no_other_machine_for_anything(page: Path) -> None:
    assert not re.search(r"<(script|link|img|iframe)[^>]*\s(src|href)=", page.read_text())


@needs_chromium
@pytest.mark.slow
def test_a_browser_shows_the_chart_and_asks_nobody_else(page: Path, tmp_path: Path) -> None:
    shown = text_of_what_asks_nobody(page, tmp_path / "profile", ".scatterlayer .trace")
    assert "seconds of training" in shown and "A <b>" in shown, "names are no markup"


def test_every_contender_is_in_it_with_its_curve(page: Path) -> None:
    text = figure_text(page)
    assert text.count('"name":"B"') >= 4  # a curve and a point for each cost
    assert "seconds of training" in text and "volume kept at equal loss" in text


def test_bars_on_the_page_go_from_the_worst_seed_to_the_best(tmp_path: Path) -> None:
    seeds = [run("A", seed, psnr) for seed, psnr in enumerate((20.0, 21.0, 25.0))]
    traces = json.loads(figure_text(write_page(results(*seeds), tmp_path / "chart.html")))["data"]
    bars = [trace["error_y"] for trace in traces if "error_y" in trace]
    assert len(bars) == 3, "one for each cost"
    for bar in bars:  # around the mean, 22 dB
        assert (bar["array"], bar["arrayminus"]) == ([3.0], [2.0])


def test_a_chart_without_occupancies_has_no_row_for_them(tmp_path: Path) -> None:
    text = figure_text(write_page(results(run("A"), run("B")), tmp_path / "chart.html"))
    assert "volume kept at equal loss" not in text


def test_a_grid_without_a_learning_time_is_drawn_by_size_only(tmp_path: Path) -> None:
    ours = run("MLP", occupancy=occupancy(50_000, 0.1, [grid(64, 0.3)]))
    text = figure_text(write_page(results(ours), tmp_path / "chart.html"))
    ours, of_grid = text.count('"text":["MLP"]'), text.count('"text":["grid 64')
    assert (ours, of_grid) == (3 + 2, 1)  # three costs, size and learning time


def test_a_suite_by_steps_shows_what_its_title_is_about(tmp_path: Path) -> None:
    by_steps = {"suite": "losses", "protocol": {"seconds": None, "steps": 400}}
    runs = [run(name, occupancy=occupancy(50_000, 0.1)) for name in ("A (ours)", "B")]
    text = figure_text(write_page(results(*runs, **by_steps), tmp_path / "chart.html"))
    assert "space kept at equal loss, against PSNR" in text
    assert text.count('"legendgroup":"A (ours)"') == 1 + 3 + 1  # curve, costs, space kept


def panel() -> Any:
    figure = Figure(figsize=(9, 3))
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(0.0, 1.0), ylim=(0.0, 1.0))
    return axes


def boxes_of(axes: Any) -> Boxes:
    """[N, 4] what the names in a panel cover, as they are drawn."""
    axes.figure.canvas.draw()  # only then an annotation knows its place
    in_axes = axes.transAxes.inverted()
    extents = [Text.get_window_extent(text).transformed(in_axes) for text in axes.texts]
    return np.array([extent.extents for extent in extents])


@settings(deadline=None, max_examples=25)
@given(st.lists(st.tuples(*[st.floats(0.05, 0.95)] * 2), min_size=2, max_size=6))
def test_names_of_points_do_not_overlap(places: list[tuple[float, float]]) -> None:
    axes = panel()
    names = [f"the name {i}" for i in range(len(places))]
    name_points(axes, places, names, ["black"] * len(places))
    boxes = boxes_of(axes)
    assert [text.get_text() for text in axes.texts] == names
    assert boxes.min() > -1e-9 and boxes.max() < 1.0 + 1e-9
    assert no_two_overlap(boxes)


def no_two_overlap(boxes: Boxes) -> bool:
    return all(covered(boxes[i : i + 1], boxes[i + 1 :]) < 1e-9 for i in range(len(boxes)))


def test_long_names_at_one_edge_are_read_one_above_the_other() -> None:
    axes = panel()
    names = ["paper: imbalance and density", "paper without density loss", "as in Switch-NeRF"]
    others = [(0.03, 0.3), (0.07, 0.12), (0.87, 0.27)]
    name_points(axes, [(0.02, 0.12), (0.02, 0.12), (0.03, 0.12)], names, ["red"] * 3, others)
    assert no_two_overlap(boxes_of(axes))


def test_names_at_the_ends_of_curves_keep_apart_and_in_order() -> None:
    places = spread([0.5, 0.5, 0.51, 0.99, 0.98], 0.06)
    assert sorted(range(5), key=lambda i: places[i]) == [0, 1, 2, 4, 3]
    assert np.diff(sorted(places)).min() >= 0.06 - 1e-9
    assert max(places) <= 1.0


@given(st.lists(st.floats(0.0, 1.0), min_size=1, max_size=12))
def test_names_with_room_enough_never_leave_the_panel(wanted: list[float]) -> None:
    places = spread(wanted, 0.056)
    assert min(places) >= -1e-9 and max(places) <= 1.0 + 1e-9


def test_names_that_are_far_apart_stay_where_they_are() -> None:
    assert spread([0.9, 0.1, 0.5], 0.05) == [0.9, 0.1, 0.5]
