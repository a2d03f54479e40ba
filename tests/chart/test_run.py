"""Claims about making a chart, with a stand-in for what makes a run."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import chart_results
import pytest

from leco_plugin.chart.contenders.contender import Contender
from leco_plugin.chart.contenders.protocol import Protocol
from leco_plugin.chart.drawing import picture
from leco_plugin.chart.runs.folder import Job
from leco_plugin.chart.runs.processes import RunFailed
from leco_plugin.chart.runs.run import Chart

CONTENDERS = [Contender(name, name, "own") for name in ("a", "b", "c")]
SEEDS = (0, 1)
IN_TURNS = [("a", 0), ("b", 0), ("c", 0), ("b", 1), ("c", 1), ("a", 1)]
"""Each seed begins with another."""


class Runner:
    """Makes runs at once, and remembers them."""

    def __init__(self, stops_at: int | None = None, broken: str | None = None) -> None:
        self.made: list[tuple[str, int]] = []
        self.stops_at, self.broken = stops_at, broken

    def __call__(self, job: Job, show: Callable[[float], None]) -> dict[str, Any]:
        if len(self.made) == self.stops_at:
            raise KeyboardInterrupt
        name = job.contender.name
        self.made.append((name, job.seed))
        if name == self.broken:
            raise RunFailed(f"{name} is broken")
        return chart_results.run(name, job.seed, sampler="own", occupancy=None)


def chart(scene: Path, out: Path, **changes: Any) -> Chart:
    values = {"contenders": CONTENDERS, "seeds": SEEDS, "protocol": Protocol(10.0)} | changes
    return Chart(scene, out, **values)


def make(made: Chart, runner: Runner) -> dict[str, Any]:
    made.make(runner, say=lambda line: None, show=lambda share: None)
    return made.results()


def test_contenders_take_turns_within_a_seed(tiny_scene: Path, tmp_path: Path) -> None:
    runner = Runner()
    make(chart(tiny_scene, tmp_path), runner)
    assert runner.made == IN_TURNS


def test_runs_at_once_are_under_way_beside_each_other(tiny_scene: Path, tmp_path: Path) -> None:
    meet = threading.Barrier(2, timeout=30)
    runner, shares = Runner(), []

    def two_at_a_time(job: Job, show: Callable[[float], None]) -> dict[str, Any]:
        meet.wait()
        show(0.5)
        return runner(job, show)

    made = chart(tiny_scene, tmp_path, protocol=Protocol(10.0, at_once=2))
    said: list[str] = []
    made.make(two_at_a_time, say=said.append, show=shares.append)
    assert sorted(runner.made) == sorted((name, seed) for seed in SEEDS for name in "abc")
    assert [(run["name"], run["seed"]) for run in made.results()["runs"]] == [
        (name, seed) for name in "abc" for seed in SEEDS
    ]
    assert "6 runs of 10 s, 2 at a time, about 3 to 6 minutes" in said[0] and len(said) == 7
    assert min(shares) >= 0.0 and 0.8 < max(shares) <= 1.0


def test_stopping_ends_the_runs_beside_and_none_of_them_is_a_failure(
    tiny_scene: Path, tmp_path: Path
) -> None:
    made = chart(tiny_scene, tmp_path, protocol=Protocol(10.0, at_once=2))

    def stopped(job: Job, show: Callable[[float], None]) -> dict[str, Any]:
        if job.contender.name == "a":
            raise KeyboardInterrupt
        assert made.stop.wait(30)
        raise RunFailed("the process was ended by SIGINT")

    with pytest.raises(KeyboardInterrupt):
        made.make(stopped, say=lambda line: None, show=lambda share: None)
    assert not made.folder.failures() and len(made.missing()) == 6


@pytest.mark.parametrize("stops_at", range(6))
def test_after_a_kill_only_what_is_missing_is_made(
    tiny_scene: Path, tmp_path: Path, stops_at: int
) -> None:
    first, second = Runner(stops_at), Runner()
    with pytest.raises(KeyboardInterrupt):
        make(chart(tiny_scene, tmp_path), first)
    found = json.loads((tmp_path / "results.json").read_text())
    assert (len(found["runs"]), found["missing"]) == (stops_at, 6 - stops_at)
    said = f"**{stops_at} of 6 runs so far**: what is said here may change."
    assert said in (tmp_path / "table.md").read_text()
    results = make(chart(tiny_scene, tmp_path), second)
    assert first.made + second.made == IN_TURNS
    whole = make(chart(tiny_scene, tmp_path / "whole"), Runner())
    assert results["runs"] == whole["runs"]


def test_a_crash_is_a_row_and_the_others_finish(tiny_scene: Path, tmp_path: Path) -> None:
    said: list[str] = []
    made = chart(tiny_scene, tmp_path)
    made.make(Runner(broken="b"), say=said.append, show=lambda share: None)
    results = json.loads((tmp_path / "results.json").read_text())
    assert [run["name"] for run in results["runs"]] == ["a", "a", "c", "c"]
    assert [(f["name"], f["seed"], f["reason"]) for f in results["failures"]] == [
        ("b", 0, "b is broken"),
        ("b", 1, "b is broken"),
    ]
    table = (tmp_path / "table.md").read_text()
    assert "| b | 0 | failed: b is broken |" in table and "so far" not in table
    assert "seed 1, b: failed: b is broken" in said


def test_a_run_that_failed_is_tried_again(tiny_scene: Path, tmp_path: Path) -> None:
    make(chart(tiny_scene, tmp_path), Runner(broken="b"))
    again = Runner()
    results = make(chart(tiny_scene, tmp_path), again)
    assert again.made == [("b", 0), ("b", 1)] and not results["failures"]


def test_a_crash_stays_in_the_table_while_other_seeds_are_made(
    tiny_scene: Path, tmp_path: Path
) -> None:
    make(chart(tiny_scene, tmp_path, seeds=(0,)), Runner(broken="b"))
    others = make(chart(tiny_scene, tmp_path, seeds=(1,)), Runner())
    assert [(f["name"], f["seed"]) for f in others["failures"]] == [("b", 0)]
    assert len(others["runs"]) == 5


def test_methods_and_seeds_may_join_later_and_all_are_shown(
    tiny_scene: Path, tmp_path: Path
) -> None:
    make(chart(tiny_scene, tmp_path, contenders=CONTENDERS[:1], seeds=(0,)), Runner())
    later = Runner()
    results = make(chart(tiny_scene, tmp_path, contenders=CONTENDERS[1:2], seeds=(0, 5)), later)
    assert later.made == [("b", 0), ("b", 5)]
    assert [(run["name"], run["seed"]) for run in results["runs"]] == [("b", 0), ("b", 5), ("a", 0)]


def test_another_run_in_the_folder_is_refused(tiny_scene: Path, tmp_path: Path) -> None:
    make(chart(tiny_scene, tmp_path), Runner())
    with pytest.raises(ValueError, match="another seconds"):
        chart(tiny_scene, tmp_path, protocol=Protocol(11.0))
    with pytest.raises(ValueError, match="another suite"):
        chart(tiny_scene, tmp_path, suite=("losses", "What?"))


def test_results_have_the_agreed_form(tiny_scene: Path, tmp_path: Path) -> None:
    made = chart(tiny_scene, tmp_path, command="leco chart --data ball")
    results = make(made, Runner())
    assert results["format"] == 1 and results["scene"]["name"] == tiny_scene.name
    assert {"machine", "scene", "occupancy", "runs", "failures", "made"} <= results.keys()
    assert results["made"]["command"] == "leco chart --data ball"
    assert {"date", "commit", "version"} <= results["made"].keys()


def test_the_command_is_all_commands_that_made_what_is_shown(
    tiny_scene: Path, tmp_path: Path
) -> None:
    parts = {"leco chart --methods a": CONTENDERS[:1], "leco chart --methods b": CONTENDERS[1:2]}
    for command, compared in parts.items():
        results = make(chart(tiny_scene, tmp_path, contenders=compared, command=command), Runner())
    assert results["made"]["command"] == " && ".join(parts)
    whole = chart(tiny_scene, tmp_path, command="leco chart --methods a b c")
    assert make(whole, Runner())["made"]["command"] == "leco chart --methods a b c"


def test_the_commits_are_those_at_which_the_runs_were_made(
    tiny_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for commit, compared in (("1b", CONTENDERS[:1]), ("2a", CONTENDERS[1:2])):
        code = {"version": "0.1.0", "commit": commit}
        monkeypatch.setattr("leco_plugin.chart.runs.run.describe_code", lambda code=code: code)
        results = make(chart(tiny_scene, tmp_path, contenders=compared), Runner())
    assert results["made"]["commit"] == "1b, 2a"


def test_runs_of_the_same_name_and_other_settings_are_not_in_its_line(
    tiny_scene: Path, tmp_path: Path
) -> None:
    before = [Contender("a", "a", "own", {"rate": 1.0})]
    make(chart(tiny_scene, tmp_path, contenders=[*before, CONTENDERS[1]]), Runner())
    results = make(chart(tiny_scene, tmp_path, contenders=CONTENDERS[:1]), Runner())
    assert [(run["name"], run["seed"]) for run in results["runs"]] == [
        (name, seed) for name in "ab" for seed in SEEDS
    ]


def test_a_run_says_which_code_has_made_it(tiny_scene: Path, tmp_path: Path) -> None:
    def with_code(job: Job, show: Callable[[float], None]) -> dict[str, Any]:
        code = {"version": "0.1.0", "commit": "1b", "sources": f"of seed {job.seed}"}
        return {**Runner()(job, show), "code": code}

    made = chart(tiny_scene, tmp_path, contenders=CONTENDERS[:1])
    made.make(with_code, say=lambda line: None, show=lambda share: None)
    assert [run["code"] for run in made.results()["runs"]] == ["of seed 0", "of seed 1"]
    assert made.results()["made"]["commit"] == "1b"


def test_the_first_occupancy_stands_for_all(tiny_scene: Path, tmp_path: Path) -> None:
    def learns(job: Job, show: Callable[[float], None]) -> dict[str, Any]:
        held = chart_results.occupancy(51_000 + job.seed, 0.1)
        return chart_results.run(job.contender.name, job.seed, occupancy=held)

    made = chart(tiny_scene, tmp_path, contenders=CONTENDERS[:1])
    made.make(learns, say=lambda line: None, show=lambda share: None)
    assert made.results()["occupancy"]["bytes"] == 51_000


def test_nothing_is_drawn_when_nothing_has_succeeded(
    tiny_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = chart(tiny_scene, tmp_path, contenders=CONTENDERS[1:2], seeds=(0,))
    make(made, Runner(broken="b"))
    monkeypatch.setattr(picture, "draw", None)
    assert made.draw()["failures"] and not (tmp_path / "chart.png").exists()


@pytest.mark.parametrize("changes", [{"contenders": []}, {"seeds": ()}])
def test_nothing_to_compare_is_refused(
    tiny_scene: Path, tmp_path: Path, changes: dict[str, Any]
) -> None:
    with pytest.raises(ValueError, match="at least one"):
        chart(tiny_scene, tmp_path / "new", **changes)
    assert not (tmp_path / "new").exists()
