"""Claims about how long a table takes."""

from __future__ import annotations

import pytest

from leco_plugin.stability.cases import CASES, cases_named
from leco_plugin.stability.contenders import SAMPLERS, samplers_named
from leco_plugin.stability.cost import core_seconds, expected_seconds, in_words
from leco_plugin.stability.plan import Run, entries_of, runs_of
from leco_plugin.stability.sizes import FULL


def runs(cases: tuple[str, ...], samplers: tuple[str, ...]) -> list[Run]:
    return runs_of(entries_of(cases_named(cases), samplers_named(samplers), (0,), FULL))


def test_the_stored_table_takes_two_cores_less_than_two_hours() -> None:
    # that of benchmarks/stability.py, by the stored figures of its parts
    compared = list(CASES.values()), list(SAMPLERS.values())
    everything = runs_of(entries_of(*compared, (0, 1, 2), FULL, beside=(0,)))
    assert core_seconds(everything, [], FULL) / 2 < 2 * 3600
    assert {len(one.seeds) for one in entries_of(*compared, (0, 1, 2), FULL)} == {3, 10}


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
