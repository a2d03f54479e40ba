"""Claims about the picture of a chart."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from chart_results import occupancy, results, run
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.figure import Figure
from PIL import Image

from leco_plugin.chart.drawing.picture import CLOSE, _name_ends, balanced, draw, name_of_end, spread
from leco_plugin.chart.drawing.theme import DARK, LIGHT, Theme
from leco_plugin.chart.findings.summary import best_so_far, lines_of
from leco_plugin.evaluation.charts import SOURCE, fingerprint

RUNS = [
    run(name, seed, psnr + seed) for name, psnr in (("A", 20.0), ("B", 23.0)) for seed in (0, 1)
]


def share_of(colour: str, path: Path) -> float:
    """Of the picture's pixels that have about this colour."""
    pixels = np.asarray(Image.open(path).convert("RGB")).astype(int)
    wanted = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)])
    return float((np.abs(pixels - wanted).max(axis=-1) < 8).mean())


def test_the_end_of_a_curve_says_that_a_grid_does_not_skip_yet() -> None:
    warm, cold = lines_of(results(run("A", warming_up=False), run("B", warming_up=True)))
    assert (name_of_end(warm), name_of_end(cold)) == ("A  20.0", "B  20.0 (warm-up)")


@pytest.mark.parametrize("theme", [LIGHT, DARK], ids=["light", "dark"])
def test_every_contender_is_seen_in_its_colour_on_the_themes_page(
    theme: Theme, tmp_path: Path
) -> None:
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


def test_names_at_the_ends_of_curves_keep_apart_and_in_order() -> None:
    places = spread([0.5, 0.5, 0.51, 0.99, 0.98], 0.06)
    assert sorted(range(5), key=lambda i: places[i]) == [0, 1, 2, 4, 3]
    assert np.diff(sorted(places)).min() >= 0.06 - 1e-9
    assert max(places) <= 1.0


def test_names_at_the_ends_of_curves_give_the_mean_of_the_last_psnr_as_the_title_does() -> None:
    seeds = [run("A", seed, 20.0 + seed) for seed in (0, 1)]
    for point in seeds[1]["curve"]:
        point[0] *= 2.0  # as many steps, twice the time
    (line,) = lines_of(results(*seeds))
    axes = Figure().add_subplot()
    _name_ends(axes, [line], LIGHT)
    assert [text.get_text() for text in axes.texts] == [f"A  {line.psnr:.1f}"] == ["A  20.5"]
    assert line.curve()[1][-1] == line.psnr  # where its name points to


@given(st.lists(st.floats(0.0, 1.0), min_size=1, max_size=12))
def test_names_with_room_enough_never_leave_the_panel(wanted: list[float]) -> None:
    places = spread(wanted, CLOSE)
    assert min(places) >= -1e-9 and max(places) <= 1.0 + 1e-9


def test_names_that_are_far_apart_stay_where_they_are() -> None:
    assert spread([0.9, 0.1, 0.5], 0.05) == [0.9, 0.1, 0.5]


def test_the_front_of_the_curves_is_the_best_that_anybody_has_reached_by_then() -> None:
    early = run("A", curve=[[2.0, 10.0], [4.0, 14.0], [8.0, 13.0]])
    late = run("B", curve=[[4.0, 8.0], [8.0, 16.0]])
    times, best = best_so_far(lines_of(results(early, late)))
    at = dict(zip(times.round(6).tolist(), best.tolist()))
    assert (times[0], times[-1]) == (2.0, 8.0)
    assert at[2.0] == pytest.approx(10.0) and at[8.0] == pytest.approx(16.0)
    assert np.interp(6.0, times, best) == pytest.approx(14.0, abs=0.1)  # what was reached stays
    assert (np.diff(best) >= 0.0).all()


def test_one_run_with_one_point_is_drawn(tmp_path: Path) -> None:
    alone = run("A", curve=[[9.0, 20.0]], learn_seconds=None, field_queries_per_ray=0.0)
    assert draw(results(alone), tmp_path / "chart.png").stat().st_size > 10_000


def test_representations_and_grids_are_drawn(tmp_path: Path) -> None:
    grids = [{"resolution": 64, "bytes": 32768, "update_seconds": 2.0, "kept_reached_volume": 0.3}]
    ours = run("MLP", occupancy=occupancy(50_000, 0.1, grids))
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
