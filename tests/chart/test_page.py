"""Claims about the interactive page of a chart."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from chart_results import occupancy, results, run

from leco_plugin.chart.drawing.page import write_page


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> str:
    held = [
        run("A <b>", occupancy=occupancy(50_000, 0.1)),
        run("B", sampler="learned-occupancy-hash", occupancy=occupancy(90, 0.2)),
    ]
    return write_page(results(*held), tmp_path_factory.mktemp("page") / "chart.html").read_text()


def test_the_page_asks_no_other_machine_for_anything(page: str) -> None:
    assert not re.search(r"<(script|link|img|iframe)[^>]*\s(src|href)=", page)


def test_every_contender_is_in_it_with_its_curve(page: str) -> None:
    assert page.count('"name":"B"') >= 4  # a curve and a point for each cost
    assert "seconds of training" in page and "volume kept at equal loss" in page


def test_a_chart_without_occupancies_has_no_row_for_them(tmp_path: Path) -> None:
    text = write_page(results(run("A"), run("B")), tmp_path / "chart.html").read_text()
    assert "volume kept at equal loss" not in text


def test_a_grid_without_a_learning_time_stands_where_sizes_are_compared_alone(
    tmp_path: Path,
) -> None:
    grids = [{"resolution": 64, "bytes": 32768, "update_seconds": 2.0, "kept_reached_volume": 0.3}]
    ours = run("MLP", occupancy=occupancy(50_000, 0.1, grids))
    text = write_page(results(ours), tmp_path / "chart.html").read_text()
    named = re.findall(r'"text":\["MLP"(,"grid 64[^"]*")?\]', text)
    assert len(named) == 2 and [bool(grid) for grid in named] == [True, False]


def test_a_suite_by_steps_shows_what_its_title_is_about(tmp_path: Path) -> None:
    by_steps = {"suite": "losses", "protocol": {"seconds": None, "steps": 400}}
    runs = [run(name, occupancy=occupancy(50_000, 0.1)) for name in ("A (ours)", "B")]
    text = write_page(results(*runs, **by_steps), tmp_path / "chart.html").read_text()
    assert "space kept at equal loss, against PSNR" in text
    assert text.count("% of the space") >= 2
