"""Claims about making a chart, and about taking runs over from others, with stand-ins for runs."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import chart_results
import pytest

from leco_plugin.chart import picture
from leco_plugin.chart.chart import Chart, why_not_shared
from leco_plugin.chart.contender import Contender, Job, Protocol
from leco_plugin.chart.runner import RUNS, RunFailed
from leco_plugin.scenes.input_error import InputError

CONTENDERS = [Contender(name, name, "own") for name in ("a", "b", "c")]
SEEDS = (0, 1)
IN_TURNS = [("a", 0), ("b", 0), ("c", 0), ("b", 1), ("c", 1), ("a", 1)]
"""Each seed begins with another."""


class Runner:
    """Makes runs at once, with the occupancy and grids that are asked for, and remembers them."""

    def __init__(self, stops_at: int | None = None, broken: str | None = None) -> None:
        self.made: list[tuple[str, int]] = []
        self.stops_at, self.broken = stops_at, broken

    def __call__(self, job: Job, show: Callable[[float], None]) -> dict[str, Any]:
        if len(self.made) == self.stops_at:
            raise KeyboardInterrupt
        name, sampler, grids = job.contender.name, job.contender.sampler, job.contender.grids
        self.made.append((name, job.seed))
        if name == self.broken:
            raise RunFailed(f"{name} is broken")
        made = [chart_results.grid(resolution, 0.5) for resolution in grids]
        held = None if sampler == "own" else chart_results.occupancy(50_000, 0.1, made)
        return chart_results.run(name, job.seed, sampler=sampler, occupancy=held)


Charts = Callable[..., Chart]


@pytest.fixture
def chart(tiny_scene: Path, tmp_path: Path) -> Charts:
    """Makes a chart of the tiny scene, in a folder of that name."""

    def made(out: str = "", **changes: Any) -> Chart:
        values = {"contenders": CONTENDERS, "seeds": SEEDS, "protocol": Protocol(10.0)} | changes
        return Chart(tiny_scene, tmp_path / out, **values)

    return made


class Made(NamedTuple):
    """What a chart holds once its runs are made, which runs these were, and what was said."""

    results: dict[str, Any]
    runs: list[tuple[str, int]]
    said: list[str]


def make(chart: Chart, runner: Any = None) -> Made:
    runner, said = runner or Runner(), []
    chart.make(runner, say=said.append, show=lambda share: None)
    return Made(chart.results(), getattr(runner, "made", []), said)


def shown(results: dict[str, Any]) -> list[tuple[str, int]]:
    return [(run["name"], run["seed"]) for run in results["runs"]]


def test_runs_at_once_are_under_way_beside_each_other(chart: Charts) -> None:
    meet = threading.Barrier(2, timeout=30)
    runner, shares = Runner(), []

    def two_at_a_time(job: Job, show: Callable[[float], None]) -> dict[str, Any]:
        meet.wait()
        show(0.5)
        return runner(job, show)

    made = chart(protocol=Protocol(10.0, at_once=2))
    said: list[str] = []
    made.make(two_at_a_time, say=said.append, show=shares.append)
    assert sorted(runner.made) == sorted((name, seed) for seed in SEEDS for name in "abc")
    assert shown(made.results()) == [(name, seed) for name in "abc" for seed in SEEDS]
    assert "6 runs of 10 s, 2 at a time, about 3 to 6 minutes" in said[0] and len(said) == 7
    assert min(shares) >= 0.0 and 0.8 < max(shares) <= 1.0


def test_stopping_ends_the_runs_beside_and_none_of_them_is_a_failure(chart: Charts) -> None:
    made = chart(protocol=Protocol(10.0, at_once=2))

    def stopped(job: Job, show: Callable[[float], None]) -> dict[str, Any]:
        if job.contender.name == "a":
            raise KeyboardInterrupt
        assert made.stop.wait(30)
        raise KeyboardInterrupt  # as `ProcessRunner` does

    with pytest.raises(KeyboardInterrupt):
        make(made, stopped)
    assert not made.folder.failures() and len(made.missing()) == 6


@pytest.mark.parametrize("stops_at", range(6))
def test_a_killed_chart_makes_what_is_missing(chart: Charts, tmp_path: Path, stops_at: int) -> None:
    first = Runner(stops_at)
    with pytest.raises(KeyboardInterrupt):
        make(chart(), first)
    found = json.loads((tmp_path / "results.json").read_text())
    assert (len(found["runs"]), found["missing"]) == (stops_at, 6 - stops_at)
    said = f"**{stops_at} of 6 runs so far**: what is said here may change."
    assert said in (tmp_path / "table.md").read_text()
    second = make(chart())
    assert first.made + second.runs == IN_TURNS
    assert second.results["runs"] == make(chart("whole")).results["runs"]


def test_a_run_that_was_too_short_to_learn_says_so(chart: Charts) -> None:
    def runner(job: Job, show: Callable[[float], None]) -> dict[str, Any]:
        frozen = 4.0 if job.seed else None
        sampler = job.contender.sampler
        return chart_results.run("a", job.seed, sampler=sampler, freeze_seconds=frozen)

    given = [Contender("a", "leco-ngp", sampler) for sampler in ("learned-occupancy", "own")]
    said = make(chart(contenders=given), runner).said
    assert [line.endswith("so that nothing was skipped") for line in said] == [
        *(False, True),  # the forecast; with seed 0 none was learned
        *(False, False, False),
    ]


def test_a_crash_is_a_row_and_is_tried_again(chart: Charts, tmp_path: Path) -> None:
    said = make(chart(), Runner(broken="b")).said
    results = json.loads((tmp_path / "results.json").read_text())
    assert [run["name"] for run in results["runs"]] == ["a", "a", "c", "c"]
    assert [(f["name"], f["seed"], f["reason"]) for f in results["failures"]] == [
        ("b", 0, "b is broken"),
        ("b", 1, "b is broken"),
    ]
    table = (tmp_path / "table.md").read_text()
    assert "| b | 0 | failed: b is broken |" in table and "so far" not in table
    assert "seed 1, b: failed: b is broken" in said
    again = make(chart())
    assert again.runs == [("b", 0), ("b", 1)] and not again.results["failures"]


def test_a_crash_stays_in_the_table_while_other_seeds_are_made(chart: Charts) -> None:
    make(chart(seeds=(0,)), Runner(broken="b"))
    others = make(chart(seeds=(1,))).results
    assert [(f["name"], f["seed"]) for f in others["failures"]] == [("b", 0)]
    assert len(others["runs"]) == 5


def test_methods_and_seeds_may_join_later_and_all_are_shown(chart: Charts) -> None:
    make(chart(contenders=CONTENDERS[:1], seeds=(0,)))
    later = make(chart(contenders=CONTENDERS[1:2], seeds=(0, 5)))
    assert later.runs == [("b", 0), ("b", 5)]
    assert shown(later.results) == [("b", 0), ("b", 5), ("a", 0)]


def test_results_have_the_agreed_form(chart: Charts, tiny_scene: Path) -> None:
    results = make(chart(command="leco chart --data ball")).results
    assert results["format"] == 1 and results["scene"]["name"] == tiny_scene.name
    assert results["held_out"] == {"kind": "spread"}
    assert {"machine", "scene", "occupancy", "runs", "failures", "made"} <= results.keys()
    assert results["made"]["command"] == "leco chart --data ball"
    assert {"date", "commit", "version"} <= results["made"].keys()


def test_all_commands_and_commits_are_named(chart: Charts, monkeypatch: pytest.MonkeyPatch) -> None:
    parts = ["leco chart --methods a", "leco chart --methods b"]
    for command, commit, one in zip(parts, ("1b", "2a"), CONTENDERS):
        code = {"version": "0.1.0", "commit": commit}
        monkeypatch.setattr("leco_plugin.chart.chart.describe_code", lambda code=code: code)
        made = make(chart(contenders=[one], command=command)).results["made"]
    assert (made["command"], made["commit"]) == (" && ".join(parts), "1b, 2a")
    whole = "leco chart --methods a b c"
    assert make(chart(command=whole)).results["made"]["command"] == whole


def test_runs_of_the_same_name_and_other_settings_are_not_in_its_line(chart: Charts) -> None:
    before = [Contender("a", "a", "own", {"rate": 1.0})]
    make(chart(contenders=[*before, CONTENDERS[1]]))
    results = make(chart(contenders=CONTENDERS[:1])).results
    assert shown(results) == [(name, seed) for name in "ab" for seed in SEEDS]


def test_a_failure_counts_where_its_settings_are_asked_for(chart: Charts) -> None:
    before = [Contender("b", "a", "own", {"rate": 1.0}), CONTENDERS[0]]
    failed = make(chart(contenders=before), Runner(broken="b")).results
    assert [(one["seed"], one["asked"]) for one in failed["failures"]] == [(0, True), (1, True)]
    finished = make(chart(contenders=CONTENDERS[:2])).results
    assert finished["failures"] == [] and len(finished["runs"]) == 4
    make(chart("asked"), Runner(broken="b"))
    others = make(chart("asked", contenders=CONTENDERS[:1])).results
    assert [(one["name"], one["asked"]) for one in others["failures"]] == [("b", False)] * 2


def test_a_run_says_which_code_has_made_it(chart: Charts) -> None:
    def with_code(job: Job, show: Callable[[float], None]) -> dict[str, Any]:
        code = {"version": "0.1.0", "commit": "1b", "sources": f"of seed {job.seed}"}
        return {**Runner()(job, show), "code": code}

    results = make(chart(contenders=CONTENDERS[:1]), with_code).results
    assert [run["code"] for run in results["runs"]] == ["of seed 0", "of seed 1"]
    assert results["made"]["commit"] == "1b"


def test_nothing_is_drawn_when_nothing_has_succeeded(
    chart: Charts, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = chart(contenders=CONTENDERS[1:2], seeds=(0,))
    make(made, Runner(broken="b"))
    monkeypatch.setattr(picture, "draw", None)
    assert made.draw()["failures"] and not (tmp_path / "chart.png").exists()


def test_nothing_to_compare_is_refused(chart: Charts, tmp_path: Path) -> None:
    for changes in ({"contenders": []}, {"seeds": ()}):
        with pytest.raises(ValueError, match="at least one"):
            chart("new", **changes)
    assert not (tmp_path / "new").exists()


PLAIN = Contender("learn", "leco-occupancy", "learned-occupancy", {"distortion": 0.1})
WITH_GRIDS = replace(PLAIN, name="ours", grids=(64, 128))
OTHER = Contender("other", "leco-occupancy", "dense")


def test_runs_of_another_chart_take_the_names_of_this_one(chart: Charts, tmp_path: Path) -> None:
    make(chart("a", contenders=[PLAIN], command="leco chart --suite a"))
    named, others = replace(PLAIN, name="identity (ours)"), [tmp_path / "a"]
    suite = ("losses", "What?")
    made = make(chart("b", contenders=[named, OTHER], suite=suite, reuse=others))
    assert made.runs == [("other", 0), ("other", 1)]
    assert made.said[0] == "2 runs taken over from other charts"
    names = [(name, seed) for name in (named.name, "other") for seed in SEEDS]
    assert shown(made.results) == names
    assert [run.get("reused", False) for run in made.results["runs"]] == [True, True, False, False]
    record = json.loads((tmp_path / "b" / RUNS / f"{Job(named, 0).name}.json").read_text())
    assert record["made"]["command"] == "leco chart --suite a"


def test_other_settings_of_the_method_are_another_run(chart: Charts, tmp_path: Path) -> None:
    make(chart("a", contenders=[PLAIN]))
    moved, others = replace(PLAIN, changes={"distortion": 0.2}), [tmp_path / "a"]
    made = make(chart("b", contenders=[moved], reuse=others, seeds=(0,)))
    assert made.runs == [("learn", 0)]
    made = make(chart("c", contenders=[PLAIN], reuse=others, seeds=(1, 2)))
    assert made.runs == [("learn", 2)]


def test_a_run_with_grids_serves_a_chart_without_them(chart: Charts, tmp_path: Path) -> None:
    make(chart("grids", contenders=[WITH_GRIDS]))
    results, made, _ = make(chart("plain", contenders=[PLAIN], reuse=[tmp_path / "grids"]))
    assert not made
    assert [run["occupancy"]["at_equal_loss"]["grids"] for run in results["runs"]] == [[], []]
    again = make(chart("again", contenders=[WITH_GRIDS], reuse=[tmp_path / "plain"]))
    assert again.runs == [("ours", 0), ("ours", 1)]


def test_the_occupancy_and_the_picture_of_a_run_come_with_it(chart: Charts, tmp_path: Path) -> None:
    make(chart("a", contenders=[PLAIN], seeds=(0,)))
    files = [f"{Job(PLAIN, 0).name}{ending}" for ending in (".safetensors", ".png")]
    for file in files:
        (tmp_path / "a" / RUNS / file).write_bytes(file.encode())
    make(chart("b", contenders=[PLAIN], seeds=(0,), reuse=[tmp_path / "a"]))
    for file in files:
        assert (tmp_path / "b" / RUNS / file).read_bytes() == file.encode()


def test_a_chart_with_other_settings_gives_no_runs(chart: Charts, tmp_path: Path) -> None:
    make(chart("a", contenders=[PLAIN]))
    for protocol, said in (
        (Protocol(11.0), r"another seconds \(10.0, not 11.0\)"),
        (Protocol(10.0, images=1), r"another images \(2, not 1\)"),
        (Protocol(10.0, None, 5.0), "another learn seconds"),
    ):
        with pytest.raises(InputError, match=said):
            chart("b", contenders=[PLAIN], protocol=protocol, reuse=[tmp_path / "a"])
    elsewhere = chart("c").settings
    stretch = {**elsewhere, "held_out": "stretch"}
    assert "another held out" in str(why_not_shared(tmp_path / "a", stretch))
    elsewhere["machine"] = {**elsewhere["machine"], "cpu": "another"}
    assert "another machine" in str(why_not_shared(tmp_path / "a", elsewhere))
    with pytest.raises(InputError, match="there is no chart"):
        chart("b", contenders=[PLAIN], reuse=[tmp_path])
    assert not (tmp_path / "b").exists()


def test_only_charts_of_the_same_settings_are_shared(chart: Charts, tmp_path: Path) -> None:
    long, beside = Protocol(11.0), Protocol(10.0, at_once=2)
    for name, protocol in (("a", Protocol(10.0)), ("long", long), ("beside", beside)):
        make(chart(name, contenders=[PLAIN], seeds=(0,), protocol=protocol))
    suite = chart("b", contenders=[PLAIN], seeds=(0,), suite=("losses", "What?"))
    folders = [tmp_path / name for name in ("long", "no-such", "a", "beside")]
    assert [one for one in folders if not why_not_shared(one, suite.settings)] == [tmp_path / "a"]
