"""Claims about making a table, with a stand-in for what makes a run."""

from __future__ import annotations

import json
import resource
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from stability_runs import TINY, Runs, make, suite

from leco_plugin.scenes.input_error import InputError
from leco_plugin.stability import plan
from leco_plugin.stability import suite as suite_module
from leco_plugin.stability.cases import cases_named
from leco_plugin.stability.photographs import grey
from leco_plugin.stability.plan import samplers_named

SAMPLERS = ("grid-128", "learned")


@pytest.fixture(autouse=True)
def one_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(suite_module, "usable_cores", lambda: 1)


def test_a_table_holds_every_cell_with_its_figures(tmp_path: Path) -> None:
    results = make(suite(tmp_path, ("glass",), SAMPLERS), Runs({"grid-128": 23.0}))
    (row,) = results["cases"]
    assert row["name"] == "glass" and row["why"]
    assert {name: cell["verdict"] for name, cell in row["cells"].items()} == {
        "learned": "pass",
        "grid-128": "fail",
        "dense": "pass",
    }
    assert row["cells"]["grid-128"]["gap"] == -2.0
    assert row["cells"]["learned"]["runs"][0]["measured"]["kept_fraction"] == 0.25
    assert json.loads((tmp_path / "stability.json").read_text()) == results


@pytest.mark.parametrize("stops_at", [0, 2, 5])
def test_after_a_kill_only_what_is_missing_is_made(tmp_path: Path, stops_at: int) -> None:
    cases, seeds = ("yard", "outline"), (0,)
    first, second = Runs(stops_at=stops_at), Runs()
    with pytest.raises(KeyboardInterrupt):
        make(suite(tmp_path, cases, SAMPLERS, seeds), first)
    results = make(suite(tmp_path, cases, SAMPLERS, seeds), second)
    assert len(first.made) + len(second.made) == 6
    assert not set(first.made) & set(second.made)
    whole = make(suite(tmp_path / "whole", cases, SAMPLERS, seeds), Runs())
    assert results["cases"] == whole["cases"]


def test_cases_and_seeds_may_join_later(tmp_path: Path) -> None:
    make(suite(tmp_path, ("yard",), ("grid-128",)), Runs())
    later = Runs()
    results = make(suite(tmp_path, ("yard", "few-rays"), ("grid-128",), (0, 1)), later)
    assert len(later.made) == 6 and ("yard", "dense", 0) in later.made  # of few rays
    assert [row["cells"]["dense"]["seeds"] for row in results["cases"]] == [2, 2]


def test_a_run_that_ends_without_a_result_fails_its_cell_and_no_other(tmp_path: Path) -> None:
    made = suite(tmp_path, ("yard",), SAMPLERS)
    cells = make(made, Runs(broken="learned"))["cases"][0]["cells"]
    assert cells["learned"]["verdict"] == "fail" and "is broken" in cells["learned"]["reason"]
    assert cells["grid-128"]["verdict"] == "pass"
    again = Runs()
    make(suite(tmp_path, ("yard",), SAMPLERS), again)
    assert again.made == [("yard", "learned", 0)]


def test_a_failure_stands_until_the_run_is_made(tmp_path: Path) -> None:
    make(suite(tmp_path, ("yard",), SAMPLERS, (0, 1)), Runs(broken="grid-128"))
    later = suite(tmp_path, ("yard",), SAMPLERS, (0, 1))
    cell = later.results()["cases"][0]["cells"]["grid-128"]
    assert cell["verdict"] == "fail" and "2 of 2 runs ended: grid-128 is broken" in cell["reason"]
    longer = suite(tmp_path, ("yard",), SAMPLERS, (0, 1, 2))
    tried = {run.job.contender.sampler for run in longer.missing()[-2:]}
    assert tried == {"grid-128"} and len(longer.missing()) == 5  # what has failed comes last
    cells = make(later, Runs())["cases"][0]["cells"]
    assert cells["grid-128"]["verdict"] == "pass" and not later.failures()


def test_a_run_that_renders_no_number_fails_and_the_others_go_on(tmp_path: Path) -> None:
    cells = make(suite(tmp_path, ("yard",), SAMPLERS), Runs({"learned": None}))["cases"][0]["cells"]
    assert cells["learned"]["reason"] == "seed 0 renders what is no number"
    assert cells["grid-128"]["verdict"] == "pass"


def test_a_folder_of_other_sizes_is_refused(tmp_path: Path) -> None:
    make(suite(tmp_path, ("yard",), ("grid-128",)), Runs())
    with pytest.raises(
        ValueError, match=r"other sizes, with --quick or without: steps \(40, not 41\)"
    ):
        longer = replace(TINY, steps=41)
        suite_module.Suite(tmp_path, cases_named(("yard",)), samplers_named(()), (0,), longer)


def test_fewer_cores_go_on_in_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make(suite(tmp_path, ("yard",), ("grid-128",)), Runs())
    fewer = suite_module.describe_machine() | {"cores": 1, "threads": 7}
    monkeypatch.setattr(suite_module, "describe_machine", lambda: fewer)
    assert not suite(tmp_path, ("yard",), ("grid-128",)).missing()


def test_the_time_it_takes_is_said_before_and_from_its_own_runs_later(tmp_path: Path) -> None:
    made = suite(tmp_path, ("yard",), SAMPLERS)
    assert made.estimate().startswith("3 of 3 runs are to be made, 1 at a time: about ")
    make(made, Runs())
    more = suite(tmp_path, ("yard",), SAMPLERS, (0, 1))
    assert more.estimate() == "3 of 6 runs are to be made, 1 at a time: about 30 s"


def test_a_run_takes_the_mean_of_its_sampler_or_as_long_as_any(tmp_path: Path) -> None:
    runs = suite(tmp_path, ("yard",), SAMPLERS).missing()
    assert sorted(run.job.contender.sampler for run in runs) == ["dense", "grid-128", "learned"]
    assert plan.core_seconds(runs, []) == 3 * plan.A_RUN
    stored = [("grid-128", 10.0), ("grid-128", 26.0), ("dense", 5.0)]
    records = [{"sampler": name, "processor_seconds": seconds} for name, seconds in stored]
    assert plan.core_seconds(runs, records) == 18.0 + 5.0 + 26.0


def test_pictures_are_as_many_and_as_large_as_the_sizes_say() -> None:
    (yard,) = cases_named(("yard",))
    sizes = replace(TINY, picture=0.5, views=0.25)
    capture = replace(yard.capture, width=60, height=40, test_views=20)
    found = plan.capture_of(replace(yard, capture=capture), sizes)
    assert (found.width, found.height, found.test_views) == (30, 20, 5)
    assert found.views == round(0.25 * capture.views)
    few = plan.capture_of(replace(yard, capture=replace(capture, views=3, test_views=2)), sizes)
    assert (few.views, few.test_views) == (4, 2)
    fixed = plan.capture_of(replace(yard, capture=replace(capture, views=7)), sizes)
    assert fixed.views == 7  # a case that fixes the number keeps it


def test_one_run_is_made_by_one_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(suite_module, "usable_cores", lambda: 64)
    made = suite(tmp_path, ("yard",), ("dense",))
    assert made.estimate() == "1 of 1 run is to be made, 1 at a time: about 2 min"


def test_other_pictures_are_another_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The scene's file has the places of its cameras, and not what they see."""
    make(suite(tmp_path, ("yard",), ("dense",)), Runs())
    yard = plan.STAGES["yard"]
    repainted = replace(yard, shapes=(replace(yard.shapes[0], paint=grey(0.1)), *yard.shapes[1:]))
    monkeypatch.setitem(plan.STAGES, "yard", repainted)
    with pytest.raises(InputError, match="another scene"):
        suite(tmp_path, ("yard",), ("dense",))


def test_a_run_says_which_code_its_own_process_had(tmp_path: Path) -> None:
    made = suite(tmp_path, ("yard",), ("dense",))
    runs = Runs()

    def later(scene: str) -> Any:
        return lambda job, show: runs(scene)(job, show) | {"code": {"sources": "later"}}

    made.runner = later  # type: ignore[method-assign]
    made.make(lambda line: None, lambda share: None)
    (run,) = made.results()["cases"][0]["cells"]["dense"]["runs"]
    assert run["made"] == made.made | {"sources": "later"}


def test_a_full_disk_leaves_the_older_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = suite(tmp_path, ("yard",), ("dense",))
    made.write()
    older = (tmp_path / "table.md").read_bytes()
    monkeypatch.setattr(suite_module, "table", lambda results: "x" * (1 << 20))
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 19, before[1]))
    try:
        with pytest.raises(OSError, match="File too large"):
            made.write()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert (tmp_path / "table.md").read_bytes() == older


def test_failures_are_drawn_beside_what_is_there(tmp_path: Path) -> None:
    made = suite(tmp_path, ("yard", "outline"), ("grid-128",))
    make(made, Runs({"grid-128": 20.0}, pictures=tmp_path))
    made.draw()
    drawn = sorted(path.name for path in (tmp_path / "failures").iterdir())
    assert drawn == ["outline--grid-128.png", "yard--grid-128.png"]
    assert (tmp_path / "stability.png").stat().st_size > 10_000
    assert (tmp_path / "stability-dark.png").exists()
    assert "**fail**" in (tmp_path / "table.md").read_text()
