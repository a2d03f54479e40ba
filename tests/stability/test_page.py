"""Claims about docs/stability.md: its cases are those there are, its figures those stored."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from stability_runs import Runs, make, suite

from leco_plugin.stability.cases import CASES
from leco_plugin.stability.contenders import SAMPLERS

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


def test_the_page_shows_the_stored_table_and_says_where_its_runs_come_from(
    results: Path, tmp_path: Path
) -> None:
    import stability_page

    empty = stability_page.page(PAGE.read_text(), results)
    assert empty.count("Not run yet.") == 2
    table = make(
        suite(tmp_path / "table", ("yard",), ("grid-128",), (0, 1)), Runs({"grid-128": 23.0})
    )
    (results / "stability.json").write_text(json.dumps(table))
    shown = stability_page.page(empty, results)
    assert "Grid 128³ passes 0 of 1 cases." in shown
    assert "| a yard | **fail**: -2.00 dB (kept 25%, lost 0.1%, worst +0.00) |" in shown
    assert "| a yard | grid 128³ | 2.00 dB below dense |" in shown
    assert "4 runs, 0.0 hours of one core" in shown and table["machine"]["cpu"] in shown
    assert shown.count("Not run yet.") == 1 and str(tmp_path) not in shown
    assert stability_page.page(shown, results) == shown


def test_the_page_counts_kills_and_what_they_lost(results: Path) -> None:
    import stability_page

    def ended(psnr: float, *kills: tuple[int, int]) -> dict[str, object]:
        found = [
            {"seconds": 1.0, "first": -1, "before": before, "after": after}
            for before, after in kills
        ]
        return {"step": 59, "psnr": psnr, "frozen": True, "kills": found}

    def kill(before: int, **more: int) -> dict[str, object]:
        return {"seconds": 1.0, "first": before, "before": before, "after": before, **more}

    destroyed = {"step": -1, "kills": [kill(19) | {"before": -1, "after": -1}]}
    damaged = {"step": 19, "kills": [kill(19, damaged=1)]}
    stuck = {"step": 7, "kills": [kill(-1), kill(7)], "failed": "KeyError: 'gate'"}
    unfinished = [destroyed, damaged, stuck]
    stored = {
        "steps": 60,
        "undisturbed": [ended(13.0), ended(13.5)],
        "killed": [ended(13.2, (3, 3), (7, 11)), ended(13.1, (7, 3)), ended(9.0), *unfinished],
        "machine": {"cpu": "Some CPU"},
    }
    (results / "kills.json").write_text(json.dumps(stored))
    shown = " ".join(stability_page.page(PAGE.read_text(), results).split())
    assert "7 kills with SIGKILL at random moments of runs of 60 steps, 1 of them before" in shown
    assert ", 3 of processes that had saved something themselves; 3 of them lost" in shown
    assert "2 of 5 runs that were killed went on" in shown and "at 13.10 to 13.20 dB" in shown
    assert (
        "end at 13.00 to 13.50 dB (mean 13.25); the means differ by -0.10 dB with a standard error"
        in shown
    )
