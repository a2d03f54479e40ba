"""Claims about what the README shows of stored results, with results that are made up."""

from __future__ import annotations

import json
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from chart_results import grid, occupancy, results, run
from stored_charts import reading


@pytest.fixture
def parts(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> ModuleType:
    """The README's module, with no chart stored yet."""
    return reading("readme_parts", tmp_path, monkeypatch)


def store(folder: Path, suite: str, scene: str, *runs: dict[str, Any]) -> None:
    made = results(*runs, suite=suite, scene={"name": scene})
    (folder / "charts" / f"{scene}-{suite}.json").write_text(json.dumps(made))


def test_scenes_of_which_one_suite_is_missing_have_no_row(
    parts: ModuleType, tmp_path: Path
) -> None:
    assert parts.rivals_table() == "Not measured yet."
    store(tmp_path, "enough-time", "city", run("Switch-NeRF + learned occupancy"))
    assert parts.rivals_table() == "Not measured yet."


def test_ours_and_the_rivals_that_keep_least_stand_beside_equal_time(
    parts: ModuleType, tmp_path: Path
) -> None:
    facts = occupancy(23_000, 0.2, [grid(64, 0.3), grid(128, 0.25), grid(256, 0.28)])
    small = {"bytes": 4932, "seconds": 9.0, "kept_reached_volume": 0.1, "name": "MLP"}
    facts["at_equal_loss"]["taught"] = [small]
    planes = run("K-planes", sampler="learned-occupancy-k-planes", occupancy=occupancy(10**6, 0.3))
    store(tmp_path, "representations", "city", run("MLP (ours)", occupancy=facts), planes)
    own = run("Switch-NeRF + coarse and fine samples", psnr=17.25)
    ours = run("Switch-NeRF + learned occupancy", psnr=19.0)
    store(tmp_path, "enough-time", "city", ours, own)
    head, _, row, _, said = parts.rivals_table().splitlines()
    assert said == (
        "Of 1 scenes, `leco-occupancy` keeps less than the best other gate on 1 and less than the "
        "best grid on 1, a small MLP less than the best grid on 1; a learned occupancy has the "
        "highest PSNR with every seed on 1."
    )
    assert head.endswith(
        "| PSNR after 10 s: learned occupancy | PSNR after 10 s: coarse and fine samples |"
    )
    assert row == (
        "| city | 20.0%, 23 kB | 10.0%, 5 kB | 30.0%, 1.0 MB (K-planes) | 25.0%, 262 kB (128³) "
        "| 19.0 (19.0 to 19.0) | 17.2 (17.2 to 17.2) |"
    )


def test_columns_are_those_of_all_scenes_and_old_charts_are_marked(
    parts: ModuleType, tmp_path: Path
) -> None:
    for scene in ("city", "fox"):
        runs = [run("MLP (ours)", occupancy=occupancy(23_000, 0.2))]
        hashed = occupancy(10**6, 0.3)
        runs.append(run("hash grid", sampler="learned-occupancy-hash", occupancy=hashed))
        store(tmp_path, "representations", scene, *(runs if scene == "city" else runs[1:]))
        names = ["a", "b"] if scene == "city" else ["b"]
        store(tmp_path, "enough-time", scene, *(run(f"Host + {name}") for name in names))
    (tmp_path / "notes.json").write_text('{"fox-enough-time": "Made before."}')
    head, _, city, fox, _, said = parts.rivals_table().splitlines()
    assert said.startswith("Of 2 scenes, ") and "other gate on 1 and" in said
    assert head.count("|") == city.count("|") == fox.count("|")
    assert city.startswith("| city |") and fox.startswith("| fox (*) | - |")


def test_what_is_around_the_tables_is_left_as_it_is(
    parts: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(parts, "demo_table", lambda report: "demo")
    (before, after), (begin, end) = parts.DEMO, parts.RIVALS
    text = f"A\n{before}\nstale\n{after}\nB\n{begin}\n{end}\nC\n"
    expected = f"A\n{before}\ndemo\n{after}\nB\n{begin}\nNot measured yet.\n{end}\nC\n"
    assert parts.readme(text) == expected
