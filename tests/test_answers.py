"""Claims about the answers that stored suites give, with results that are made up."""

from __future__ import annotations

import json
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from chart_results import grid, occupancy, results, run
from stored_charts import reading

STEPS = {"protocol": {"seconds": None, "steps": 400}}


@pytest.fixture
def answers(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> ModuleType:
    """The answers' module, with no chart stored yet."""
    return reading("answers", tmp_path, monkeypatch)


@pytest.fixture
def store(answers: ModuleType, tmp_path: Path) -> Any:
    def write(suite: str, scene: str, *runs: dict[str, Any], **changes: Any) -> None:
        made = results(*runs, suite=suite, scene={"name": scene}, **changes)
        (tmp_path / "charts" / f"{scene}-{suite}.json").write_text(json.dumps(made))

    return write


def text_of(answers: ModuleType) -> str:
    return "\n".join(answers.answers_section())


def representations(other_seconds: float, grid_kept: tuple[float, ...] = (0.3,)) -> list[Any]:
    """Runs of our gate, grids from its field, and of a larger gate, for each seed."""
    runs = []
    for seed, kept in enumerate(grid_kept):
        held = occupancy(50_000, 0.125, [grid(64, kept)])
        runs.append(run("MLP (ours)", seed, occupancy=held, learn_seconds=9.0))
        larger = {"occupancy": occupancy(4_000_000, 0.1), "learn_seconds": other_seconds}
        runs.append(run("hash grid", seed, sampler="learned-occupancy-hash", **larger))
    return runs


def test_without_suites_there_are_no_answers(answers: ModuleType) -> None:
    assert answers.answers_section() == []


def test_it_is_said_for_every_scene_whether_ours_is_on_the_fronts(
    answers: ModuleType, store: Any
) -> None:
    store("representations", "city", *representations(other_seconds=10.0))
    store("representations", "fox", *representations(other_seconds=8.0))
    text = text_of(answers)
    assert "Of 2 scenes, MLP (ours) is on the front of size on 2 and of learning time on 1." in text
    link = "suites.md#suite-representations-on-city"
    kept = "| 12.5%, 50 kB | 30.0%, 33 kB | 10.0%, 4.0 MB |"
    assert (
        f"| [city]({link}) {kept} MLP (ours) is the soonest learned and on the front of size"
        in text
    )
    assert "MLP (ours) is on the front of size, behind hash grid in learning time" in text


def test_a_grid_that_is_smaller_and_keeps_less_is_named(answers: ModuleType, store: Any) -> None:
    store("representations", "city", *representations(10.0, grid_kept=(0.05,)), **STEPS)
    text = text_of(answers)
    assert "on the front of size on 0" in text and "behind grid 64³ in size |" in text


def test_one_that_keeps_less_with_most_seeds_only_is_named_too(
    answers: ModuleType, store: Any
) -> None:
    store("representations", "city", *representations(10.0, grid_kept=(0.05, 0.05, 0.3)), **STEPS)
    text = text_of(answers)
    assert "of size on 0 and of learning time on 1." in text
    assert "behind grid 64³ (not with every seed) in size |" in text


def test_minutes_are_those_of_runs_two_at_a_time_and_shared_ones_count_once(
    answers: ModuleType, store: Any
) -> None:
    two = {"protocol": {"seconds": 60.0, "at_once": 2}}
    shared = run("A", wall_seconds=120.0)
    store("enough-time", "fox", shared, run("B", wall_seconds=240.0), **two)
    store("grid-resolution", "fox", {**shared, "reused": True}, run("C", wall_seconds=60.0), **two)
    store("freeze", "city", run("A", wall_seconds=60.0), run("B"), **two)
    text = text_of(answers)
    assert "| fox | - | - | - | - | 3 | 2 | 4 |" in text  # 1.5 of the last: 3.0 and 0.5 of its own
    assert "| city | - | - | - | - | - | - | - |" in text


def test_gates_are_compared_by_what_they_keep_and_runs_of_equal_time_by_their_ends(
    answers: ModuleType, store: Any
) -> None:
    frozen, not_frozen = occupancy(50_000, 0.1), {"freeze_seconds": None}
    store("losses", "fox", run("A", occupancy=frozen), run("B", **not_frozen), **STEPS)
    store("freeze", "fox", run("A", psnr=21.0), run("B"))
    of_grid = {"sampler": "occupancy-grid-64", "train_seconds": 10.0, "learn_seconds": 5.0}
    store("grid-resolution", "fox", run("A"), run("B", **of_grid))
    text = text_of(answers)
    assert "| 20.0 dB, 1 s | 20.0 dB, 1 s (50% of the time for its grid) |" in text
    assert "| 10%, 20.0 dB | not frozen, 20.0 dB |" in text
    said = "A is ahead: 21.0 dB, 1.0 more than B; still rising at the end: all"
    assert f"| 21.0 dB, 1 s | 20.0 dB, 1 s | {said} |" in text


def test_a_gate_that_is_not_frozen_with_every_seed_says_with_how_many(
    answers: ModuleType, store: Any
) -> None:
    runs = [run("A", 0, occupancy=occupancy(5, 0.1)), run("A", 1, freeze_seconds=None)]
    store("losses", "fox", *runs, protocol={"seconds": None, "steps": 400})
    assert "| 1 of 2 frozen, 20.0 dB |" in text_of(answers)


def test_a_gate_that_was_frozen_with_the_last_step_is_told_apart(
    answers: ModuleType, store: Any
) -> None:
    runs = [run("A", 0, occupancy=occupancy(5, 0.03)), run("A", 1, occupancy=occupancy(5, 0.03))]
    runs[1]["freeze_seconds"] = runs[1]["train_seconds"]
    store("losses", "fox", *runs, protocol={"seconds": None, "steps": 400})
    assert "| 3.0% (1 of 2 frozen at the end), 20.0 dB |" in text_of(answers)


def test_a_scene_where_ours_has_no_figures_does_not_change_the_table_of_others(
    answers: ModuleType, store: Any
) -> None:
    store("representations", "city", run("MLP (ours)", freeze_seconds=None), **STEPS)
    store("representations", "fox", *representations(other_seconds=10.0), **STEPS)
    text = text_of(answers)
    assert "| 12.5%, 50 kB |" in text and "Of 2 scenes, MLP (ours)" in text


def test_a_contender_that_a_scene_lacks_has_no_figure_there(
    answers: ModuleType, store: Any
) -> None:
    store("freeze", "city", run("A"))
    store("freeze", "fox", run("A"), run("B"))
    assert "| 20.0 dB, 1 s | - | A: 20.0 dB; still rising at the end: all |" in text_of(answers)


def test_a_chart_with_a_note_is_marked(answers: ModuleType, store: Any, tmp_path: Path) -> None:
    store("freeze", "city", run("A"))
    (tmp_path / "notes.json").write_text('{"city-freeze": "Made before."}')
    assert "[city](suites.md#suite-freeze-on-city) (*) |" in text_of(answers)
