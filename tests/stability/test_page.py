"""Claims about docs/stability.md: its cases are those there are, its figures those stored."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from stability_runs import Runs, make, suite

from leco_plugin.stability.cases import CASES
from leco_plugin.stability.plan import SAMPLERS

PAGE = Path(__file__).parents[2] / "docs" / "stability.md"
BEGIN, END = "<!-- cases: generated -->", "<!-- end of the cases -->"


def test_the_page_lists_the_cases_there_are() -> None:
    text = PAGE.read_text()
    rows = text[text.index(BEGIN) + len(BEGIN) : text.index(END)].strip().splitlines()[2:]
    assert [row.split(" | ")[0] for row in rows] == [f"| `{name}`" for name in CASES]
    assert all(case.why in row for case, row in zip(CASES.values(), rows, strict=True))


def test_the_page_names_every_sampler() -> None:
    assert all(f"`{name}`" in PAGE.read_text() for name in SAMPLERS)


@pytest.fixture
def results(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of stored results."""
    monkeypatch.syspath_prepend(str(PAGE.parents[1] / "benchmarks"))
    folder = tmp_path / "results"
    folder.mkdir()
    return folder


def test_the_page_shows_the_stored_table(results: Path, tmp_path: Path) -> None:
    import stability_page

    empty = stability_page.page(PAGE.read_text(), results)
    assert empty.count("Not run yet.") == 2
    table = make(
        suite(tmp_path / "table", ("yard",), ("grid-128",), (0, 1)), Runs({"grid-128": 23.0})
    )
    (results / "stability.json").write_text(json.dumps(table))
    shown = stability_page.page(empty, results)
    assert "Grid 128³ passes 0 of 1 case." in shown
    assert "| a yard | **fail**: -2.00 dB (kept 25%, lost 0.1%, worst +0.00) |" in shown
    assert "| a yard | grid 128³ | 2.00 dB below dense |" in shown
    assert "4 runs, 0.0 hours of one core" in shown and table["machine"]["cpu"] in shown
    assert shown.count("Not run yet.") == 1 and str(tmp_path) not in shown
    assert stability_page.page(shown, results) == shown
