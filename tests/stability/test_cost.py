"""Claims about how long a table takes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from leco_plugin.stability.cases import CASES, cases_named
from leco_plugin.stability.contenders import SAMPLERS, samplers_named
from leco_plugin.stability.cost import core_seconds, expected_seconds, in_words
from leco_plugin.stability.plan import Run, entries_of, runs_of
from leco_plugin.stability.sizes import FULL

RESULTS = Path(__file__).parents[2] / "benchmarks" / "results"


def runs(cases: tuple[str, ...], samplers: tuple[str, ...]) -> list[Run]:
    return runs_of(entries_of(cases_named(cases), samplers_named(samplers), (0,), FULL))


def stored() -> dict[tuple[str, str], dict[str, Any]]:
    """Runs of the stored table by scene and name."""
    rows = json.loads((RESULTS / "stability.json").read_text())["cases"]
    return {
        (row["scene"]["name"], run["name"]): run
        for row in rows
        for cell in row["cells"].values()
        for run in cell["runs"]
    }


@pytest.mark.parametrize("name", SAMPLERS)
def test_what_is_said_before_a_table_is_made_is_what_the_stored_one_took(name: str) -> None:
    compared = list(CASES.values()), list(SAMPLERS.values())
    made = stored()
    entries = entries_of(*compared, (0, 1, 2), FULL, beside=(0,))
    runs = [run for run in runs_of(entries) if run.key in made]
    of_sampler = [run for run in runs if run.job.contender.sampler == name]
    assert of_sampler
    took = sum(float(made[run.key]["processor_seconds"]) for run in of_sampler)
    assert core_seconds(of_sampler, [], FULL) == pytest.approx(took, rel=0.25)


def test_three_seeds_and_ten_where_seeds_are_the_question() -> None:
    entries = entries_of(list(CASES.values()), list(SAMPLERS.values()), (0, 1, 2), FULL)
    assert {len(one.seeds) for one in entries} == {3, 10}


def test_finer_cells_and_more_levels_take_longer() -> None:
    (coarse,), (fine,) = (
        [run for run in runs(("poles-and-wires",), (name,)) if run.job.contender.sampler == name]
        for name in ("grid-128", "grid-256")
    )
    (far,) = [
        run
        for run in runs(("far-terrain",), ("grid-128",))
        if run.job.contender.sampler == "grid-128"
    ]
    times = [expected_seconds(run, FULL) for run in (coarse, far, fine)]
    assert times == sorted(times) and times[2] > 3 * times[0]


def test_what_runs_took_replaces_what_they_were_thought_to_take() -> None:
    wanted = runs(("yard",), ("grid-128",))
    stored = [
        {"sampler": name, "processor_seconds": seconds}
        for name, seconds in (("grid-128", 5.0), ("grid-128", 7.0), ("dense", 1.0))
    ]
    assert core_seconds(wanted, stored, FULL) == pytest.approx(7.0)


@pytest.mark.parametrize(
    ("seconds", "words"), [(46.0, "46 s"), (600.0, "10 minutes"), (9000.0, "2.5 hours")]
)
def test_times_are_for_people(seconds: float, words: str) -> None:
    assert in_words(seconds) == words
