"""Claims about what the results page shows of charts, with results that are made up."""

from __future__ import annotations

import importlib
import json
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from chart_results import occupancy, results, run

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture
def sections(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> ModuleType:
    """The page's charts, of which none is stored yet."""
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    monkeypatch.delitem(sys.modules, "chart_sections", raising=False)
    found = importlib.import_module("chart_sections")
    monkeypatch.setattr(found, "RESULTS", tmp_path)
    (tmp_path / "charts.json").write_text("{}")
    monkeypatch.setattr(found, "CHARTS", tmp_path / "charts")
    (tmp_path / "charts").mkdir()
    return found


def store(sections: ModuleType, name: str, made: dict[str, Any]) -> None:
    (sections.CHARTS / f"{name}.json").write_text(json.dumps(made))


def of_suite(suite: str, scene: str, *runs: dict[str, Any]) -> dict[str, Any]:
    command = f"leco chart --data {scene} --suite {suite}"
    made = {"date": "2024-02-29", "command": command, "version": "0.1.0", "commit": "1b"}
    return results(*runs, suite=suite, question="Why?", scene={"name": scene}, made=made)


def representations(scene: str, other_seconds: float, grid_kept: float = 0.3) -> dict[str, Any]:
    grids = [
        {
            "resolution": 64,
            "bytes": 32768,
            "update_seconds": 2.0,
            "kept_reached_volume": grid_kept,
        }
    ]
    ours = run("MLP (ours)", occupancy=occupancy(50_000, 0.125, grids), learn_seconds=9.0)
    other = run(
        "hash grid",
        sampler="learned-occupancy-hash",
        occupancy=occupancy(4_000_000, 0.1),
        learn_seconds=other_seconds,
    )
    return of_suite("representations", scene, ours, other)


def test_a_suite_is_shown_with_its_question_picture_figures_command_and_machine(
    sections: ModuleType,
) -> None:
    store(sections, "fox-losses", of_suite("losses", "fox", run("A", psnr=21.0), run("B")))
    text = "\n".join(sections.chart_sections())
    assert "## Suite `losses` on fox" in text and "Why?" in text
    assert "images/charts/fox-losses-dark.png" in text and "| A | 1 | 21.00 |" in text
    assert "`leco chart --data fox --suite losses`, 2024-02-29, leco_plugin 0.1.0 at 1b." in text
    assert "cores: 2, device: cpu." in text


def test_charts_with_a_title_come_first_and_suites_in_their_order(sections: ModuleType) -> None:
    for name, suite in (("a", "losses"), ("b", "representations"), ("c", "losses"), ("z", None)):
        store(sections, name, of_suite("losses", name, run("A")) | {"suite": suite})
    (sections.RESULTS / "charts.json").write_text('{"z": "Z"}')
    assert list(sections.titles()) == ["z", "b", "a", "c"]
    assert sections.titles()["z"] == "Z"


def test_it_is_said_for_every_scene_whether_ours_is_on_the_fronts(sections: ModuleType) -> None:
    store(sections, "one", representations("city", other_seconds=10.0))
    store(sections, "two", representations("fox", other_seconds=8.0))
    text = "\n".join(sections.chart_sections())
    assert "of 2 scenes, ours is on the front of size on 2 and of learning time on 1." in text
    assert "| city | 12.5 | yes | yes | MLP (ours) is on both fronts" in text
    beaten = "on the front of size only: it is beaten in learning time by hash grid"
    assert f"| fox | 12.5 | yes | **no** | MLP (ours) is {beaten} |" in text


def test_a_grid_that_is_smaller_and_keeps_less_is_named(sections: ModuleType) -> None:
    store(sections, "one", representations("city", other_seconds=10.0, grid_kept=0.05))
    text = "\n".join(sections.chart_sections())
    assert "| city | 12.5 | **no** | yes |" in text and "beaten in size by grid 64³" in text


def test_without_such_a_suite_nothing_is_said_of_fronts(sections: ModuleType) -> None:
    store(sections, "one", of_suite("losses", "fox", run("A")))
    assert "front, scene by scene" not in "\n".join(sections.chart_sections())


def test_the_papers_rows_stand_once_and_beside_the_first_chart(sections: ModuleType) -> None:
    for scene in ("city", "fox"):
        made = of_suite("grid-resolution", scene, run("A"))
        store(sections, f"{scene}-grid", made)
    text = "\n".join(sections.chart_sections())
    assert text.count("| grid 256³ | 25.86, 0.764, 0.409 | 46.0 | 12.5 |") == 1
    assert text.index("25.86") < text.index("on fox")
