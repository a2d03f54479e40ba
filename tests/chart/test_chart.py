"""Claims about making a chart, and about taking runs over from others, with stand-ins for runs."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

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


def chart(scene: Path, out: Path, **changes: Any) -> Chart:
    values = {"contenders": CONTENDERS, "seeds": SEEDS, "protocol": Protocol(10.0)} | changes
    return Chart(scene, out, **values)


def make(made: Chart, runner: Runner) -> dict[str, Any]:
    made.make(runner, say=lambda line: None, show=lambda share: None)
    return made.results()


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


def test_a_run_that_was_too_short_to_learn_says_so(tiny_scene: Path, tmp_path: Path) -> None:
    def runner(job: Job, show: Callable[[float], None]) -> dict[str, Any]:
        frozen = 4.0 if job.seed else None
        sampler = job.contender.sampler
        return chart_results.run("a", job.seed, sampler=sampler, freeze_seconds=frozen)

    said: list[str] = []
    given = [Contender("a", "leco-ngp", sampler) for sampler in ("learned-occupancy", "own")]
    chart(tiny_scene, tmp_path, contenders=given).make(runner, say=said.append)
    assert [line.endswith("so that nothing was skipped") for line in said] == [
        *(False, True),  # the forecast; with seed 0 none was learned
        *(False, False, False),
    ]


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


def test_results_have_the_agreed_form(tiny_scene: Path, tmp_path: Path) -> None:
    made = chart(tiny_scene, tmp_path, command="leco chart --data ball")
    results = make(made, Runner())
    assert results["format"] == 1 and results["scene"]["name"] == tiny_scene.name
    assert results["held_out"] == {"kind": "spread"}
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
        monkeypatch.setattr("leco_plugin.chart.chart.describe_code", lambda code=code: code)
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


def test_a_failure_of_earlier_settings_is_none_of_the_chart_that_was_finished(
    tiny_scene: Path, tmp_path: Path
) -> None:
    before = [Contender("b", "a", "own", {"rate": 1.0}), CONTENDERS[0]]
    failed = make(chart(tiny_scene, tmp_path, contenders=before), Runner(broken="b"))
    assert [(one["seed"], one["asked"]) for one in failed["failures"]] == [(0, True), (1, True)]
    finished = make(chart(tiny_scene, tmp_path, contenders=CONTENDERS[:2]), Runner())
    assert finished["failures"] == [] and len(finished["runs"]) == 4


def test_a_failure_that_was_not_asked_for_is_told_apart(tiny_scene: Path, tmp_path: Path) -> None:
    make(chart(tiny_scene, tmp_path), Runner(broken="b"))
    others = make(chart(tiny_scene, tmp_path, contenders=CONTENDERS[:1]), Runner())
    assert [(one["name"], one["asked"]) for one in others["failures"]] == [("b", False)] * 2


def test_a_run_says_which_code_has_made_it(tiny_scene: Path, tmp_path: Path) -> None:
    def with_code(job: Job, show: Callable[[float], None]) -> dict[str, Any]:
        code = {"version": "0.1.0", "commit": "1b", "sources": f"of seed {job.seed}"}
        return {**Runner()(job, show), "code": code}

    made = chart(tiny_scene, tmp_path, contenders=CONTENDERS[:1])
    made.make(with_code, say=lambda line: None, show=lambda share: None)
    assert [run["code"] for run in made.results()["runs"]] == ["of seed 0", "of seed 1"]
    assert made.results()["made"]["commit"] == "1b"


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


PLAIN = Contender("learn", "leco-occupancy", "learned-occupancy", {"distortion": 0.1})
WITH_GRIDS = replace(PLAIN, name="ours", grids=(64, 128))
OTHER = Contender("other", "leco-occupancy", "dense")


def made(
    scene: Path, out: Path, *compared: Contender, **changes: Any
) -> tuple[dict[str, Any], Runner, list[str]]:
    runner, said = Runner(), []
    one = chart(scene, out, contenders=compared, **changes)
    one.make(runner, say=said.append, show=lambda share: None)
    return one.results(), runner, said


def test_what_another_chart_has_is_not_made_again_and_bears_the_name_it_has_here(
    tiny_scene: Path, tmp_path: Path
) -> None:
    made(tiny_scene, tmp_path / "a", PLAIN, command="leco chart --suite a")
    named = replace(PLAIN, name="identity (ours)")
    suite = ("losses", "What?")
    results, runner, said = made(
        tiny_scene, tmp_path / "b", named, OTHER, suite=suite, reuse=[tmp_path / "a"]
    )
    assert runner.made == [("other", 0), ("other", 1)]
    assert said[0] == "2 runs taken over from other charts"
    found = [(run["name"], run["seed"], run.get("reused", False)) for run in results["runs"]]
    assert found == [
        ("identity (ours)", 0, True),
        ("identity (ours)", 1, True),
        ("other", 0, False),
        ("other", 1, False),
    ]
    record = json.loads((tmp_path / "b" / RUNS / f"{Job(named, 0).name}.json").read_text())
    assert record["made"]["command"] == "leco chart --suite a"


def test_other_settings_of_the_method_are_another_run(tiny_scene: Path, tmp_path: Path) -> None:
    made(tiny_scene, tmp_path / "a", PLAIN)
    moved = replace(PLAIN, changes={"distortion": 0.2})
    _, runner, _ = made(tiny_scene, tmp_path / "b", moved, reuse=[tmp_path / "a"], seeds=(0,))
    assert runner.made == [("learn", 0)]
    _, runner, _ = made(tiny_scene, tmp_path / "c", PLAIN, reuse=[tmp_path / "a"], seeds=(1, 2))
    assert runner.made == [("learn", 2)]


def test_a_run_with_grids_is_also_the_one_without_and_not_the_other_way_round(
    tiny_scene: Path, tmp_path: Path
) -> None:
    made(tiny_scene, tmp_path / "grids", WITH_GRIDS)
    results, runner, _ = made(tiny_scene, tmp_path / "plain", PLAIN, reuse=[tmp_path / "grids"])
    assert not runner.made
    assert [run["occupancy"]["at_equal_loss"]["grids"] for run in results["runs"]] == [[], []]
    _, runner, _ = made(tiny_scene, tmp_path / "again", WITH_GRIDS, reuse=[tmp_path / "plain"])
    assert runner.made == [("ours", 0), ("ours", 1)]


def test_the_occupancy_of_a_run_comes_with_it(tiny_scene: Path, tmp_path: Path) -> None:
    made(tiny_scene, tmp_path / "a", PLAIN, seeds=(0,))
    name = Job(PLAIN, 0).name
    (tmp_path / "a" / RUNS / f"{name}.safetensors").write_bytes(b"gate")
    made(tiny_scene, tmp_path / "b", PLAIN, seeds=(0,), reuse=[tmp_path / "a"])
    assert (tmp_path / "b" / RUNS / f"{name}.safetensors").read_bytes() == b"gate"


def test_a_chart_with_other_settings_gives_no_runs(tiny_scene: Path, tmp_path: Path) -> None:
    made(tiny_scene, tmp_path / "a", PLAIN)
    for protocol, said in (
        (Protocol(11.0), r"another seconds \(10.0, not 11.0\)"),
        (Protocol(10.0, images=1), r"another images \(2, not 1\)"),
        (Protocol(10.0, None, 5.0), "another learn seconds"),
    ):
        with pytest.raises(InputError, match=said):
            made(tiny_scene, tmp_path / "b", PLAIN, protocol=protocol, reuse=[tmp_path / "a"])
    elsewhere = chart(tiny_scene, tmp_path / "c").settings
    stretch = {**elsewhere, "held_out": "stretch"}
    assert "another held out" in str(why_not_shared(tmp_path / "a", stretch))
    elsewhere["machine"] = {**elsewhere["machine"], "cpu": "another"}
    assert "another machine" in str(why_not_shared(tmp_path / "a", elsewhere))
    with pytest.raises(InputError, match="there is no chart"):
        made(tiny_scene, tmp_path / "b", PLAIN, reuse=[tmp_path])
    assert not (tmp_path / "b").exists()


def test_charts_that_fit_are_found_among_folders_that_may_hold_none(
    tiny_scene: Path, tmp_path: Path
) -> None:
    made(tiny_scene, tmp_path / "a", PLAIN, seeds=(0,))
    made(tiny_scene, tmp_path / "long", PLAIN, seeds=(0,), protocol=Protocol(11.0))
    made(tiny_scene, tmp_path / "beside", PLAIN, seeds=(0,), protocol=Protocol(10.0, at_once=2))
    suite = Chart(
        tiny_scene, tmp_path / "b", [PLAIN], (0,), Protocol(10.0), suite=("losses", "What?")
    )
    folders = [tmp_path / name for name in ("long", "no-such", "a", "beside")]
    assert [one for one in folders if not why_not_shared(one, suite.settings)] == [tmp_path / "a"]
