"""Claims about what the results page shows of charts, with results that are made up."""

from __future__ import annotations

import json
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from chart_results import results, run
from stored_charts import reading


@pytest.fixture
def sections(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> ModuleType:
    """The page's charts, of which none is stored yet."""
    return reading("chart_sections", tmp_path, monkeypatch)


def store(sections: ModuleType, name: str, made: dict[str, Any]) -> None:
    (sections.CHARTS / f"{name}.json").write_text(json.dumps(made))


def of_suite(suite: str, scene: str, *runs: dict[str, Any]) -> dict[str, Any]:
    command = f"leco chart --data {scene} --suite {suite}"
    made = {"date": "2024-02-29", "command": command, "version": "0.1.0", "commit": "1b"}
    return results(*runs, suite=suite, question="Why?", scene={"name": scene}, made=made)


def test_a_suite_is_shown_with_its_question_picture_figures_command_and_machine(
    sections: ModuleType,
) -> None:
    store(sections, "fox-losses", of_suite("losses", "fox", run("A", psnr=21.0), run("B")))
    text = "\n".join(sections.suite_sections())
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


def test_a_chart_that_belongs_to_no_suite_is_on_the_other_page(sections: ModuleType) -> None:
    store(sections, "z", of_suite("losses", "z", run("A")) | {"suite": None})
    assert "## z" in "\n".join(sections.chart_sections())
    assert sections.suite_sections() == []


def test_the_papers_rows_stand_once_and_beside_the_first_chart(sections: ModuleType) -> None:
    for scene in ("city", "fox"):
        made = of_suite("grid-resolution", scene, run("A"))
        store(sections, f"{scene}-grid", made)
    text = "\n".join(sections.suite_sections())
    assert text.count("| grid 256³ | 25.86, 0.764, 0.409 | 46.0 | 12.5 |") == 1
    assert text.index("25.86") < text.index("on fox")
