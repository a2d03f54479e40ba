"""Claims about `leco chart`: bad input is one line before anything is started, a crash is a row."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import chart_results
import pytest

from leco_plugin import cli
from leco_plugin.chart import command
from leco_plugin.chart.chart import Chart
from leco_plugin.chart.contender import Job, Protocol
from leco_plugin.chart.methods import AT_ONCE, SUITES
from leco_plugin.chart.runner import UNFINISHED, ProcessRunner, RunFailed
from leco_plugin.scenes.whole_files import alone_in

ONE = ["--methods", "leco-occupancy"]
METHODS = [*ONE, "leco-occupancy-never-frozen"]
TIME = ["--seconds", 3]
Started = list[tuple[str, int]]
Run = Callable[..., int]


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> Started:
    """Nothing is trained; names and seeds of the runs that would have been. Dense ones crash."""
    runs: Started = []

    def runner_for(*arguments: Any) -> Callable[[Job, Callable[[float], None]], dict[str, Any]]:
        def make(job: Job, show: Callable[[float], None]) -> dict[str, Any]:
            runs.append((job.contender.name, job.seed))
            show(0.5)
            if job.contender.sampler == "dense":
                raise RunFailed("half-way there was no memory left")
            return chart_results.run(job.contender.name, job.seed)

        return make

    monkeypatch.setattr(command, "processes", runner_for)
    return runs


@pytest.fixture
def not_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Results are written, and no pictures of them."""
    monkeypatch.setattr(Chart, "draw", Chart.write)


@pytest.fixture
def run(tiny_scene: Path, tmp_path: Path) -> Run:
    """Runs `leco chart` on the tiny scene, into the folder `chart` or another one; its status."""

    def chart(*arguments: object, out: str = "chart") -> int:
        words = ["chart", "--data", tiny_scene, "--out", tmp_path / out, *arguments]
        return cli.main([str(word) for word in words])

    return chart


def test_a_crash_is_a_row_the_others_finish_and_the_status_is_one(
    started: Started, run: Run, tmp_path: Path, capsys: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "chart"
    arguments = [*METHODS, *TIME, "--seeds", 0, 1]
    assert run(*arguments) == 1
    assert len(started) == 4
    row = "| LeCO, never frozen | 1 | failed: half-way there was no memory left |"
    assert row in (out / "table.md").read_text()
    assert len(json.loads((out / "results.json").read_text())["runs"]) == 2
    for name in ("chart.png", "chart-dark.png", "chart.html"):
        assert (out / name).stat().st_size > 10_000
    said = capsys.readouterr()
    assert "2 of 4 runs failed" in said.err and said.err.count("\n") == 1
    monkeypatch.setattr(Chart, "draw", Chart.write)
    assert run(*arguments) == 1 and len(started) == 6  # only what crashed is made again


@pytest.mark.usefixtures("not_drawn", "started")
def test_how_long_it_takes_is_said_before_it_is_started(run: Run, printed: Any) -> None:
    for out, words, said in (
        ("a", ["--seconds", 75, "--seeds", 0, 1], "2 runs of 75 s, about 4 minutes on two CPU"),
        ("a", ["--seconds", 75, "--seeds", 0, 1, 2], "1 run of 75 s, about 2 minutes on two CPU"),
        ("steps", ["--steps", 9, "--seeds", 0], "1 run of 9 steps, about 1 minute on"),
        ("beside", ["--seconds", 75, "--at-once", 2], "3 runs of 75 s, 2 at a time, about 3 min"),
    ):
        assert run(*ONE, *words, out=out) == 0
        found = printed()
        assert said in found and ("cores (2 more are there" in found) == ("1 run of 75" in said)


@pytest.mark.usefixtures("not_drawn")
def test_a_second_process_in_the_folder_of_a_chart_is_refused(
    started: Started, run: Run, refused: Any, tiny_scene: Path, tmp_path: Path
) -> None:
    out, arguments = tmp_path / "chart", [*ONE, *TIME, "--seeds"]
    assert run(*arguments, 0) == 0
    under_way = out / UNFINISHED / "a-run"
    under_way.mkdir()
    with alone_in(out, "chart"):
        error = refused("chart", "--data", tiny_scene, "--out", out, *arguments, 0, 1)
    assert "another process makes the chart in" in error
    assert len(started) == 1 and under_way.exists()
    assert run(*arguments, 0, 1) == 0 and len(started) == 2


@pytest.mark.usefixtures("not_drawn")
def test_suites_have_folders_and_share_runs(started: Started, run: Run, tmp_path: Path) -> None:
    names = ["losses", "empty-expert", "representations"]
    assert run("--seeds", 0, "--suite", *names, "--json", tmp_path / "all.json") == 0
    shown = {name: {one.name for one in SUITES[name].contenders} for name in names}
    stored = json.loads((tmp_path / "all.json").read_text())["charts"]
    for name in names:
        assert {one["name"] for one in stored[name]["runs"]} == shown[name]
        results = tmp_path / "chart" / name / "results.json"
        assert stored[name] == json.loads(results.read_text())
        words = stored[name]["made"]["command"]
        assert f"--suite {name} --steps" in words and f"--at-once {AT_ONCE}" in words
    keys = {one.alone().key for name in names for one in SUITES[name].contenders}
    assert len(started) == len(keys)
    assert run("--seeds", 0, "--suite", *names) == 0
    assert run("--seeds", 0, "--suite", "freeze", "losses", "--seconds", 7) == 2  # losses had steps
    assert len(started) == len(keys)


@pytest.mark.usefixtures("not_drawn")
def test_all_suites_are_every_suite(started: Started, run: Run, tmp_path: Path) -> None:
    assert run("--suite", "all", "--seeds", 0) == 1
    assert {path.name for path in (tmp_path / "chart").iterdir()} == set(SUITES)
    crashing = {("never frozen", 0), ("equal experts, no gate", 0)}  # as this stand-in has it
    assert crashing <= set(started) and len(started) == len(set(started))


def test_runs_beside_each_other_share_the_threads_of_the_machine(
    tiny_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    machine = {"cpu": "x", "cores": 8, "threads": 8, "device": "cpu"}
    monkeypatch.setattr("leco_plugin.chart.chart.describe_machine", lambda: dict(machine))
    for at_once, threads, variable in (
        (1, 8, os.environ.get("OMP_NUM_THREADS")),
        (2, 4, "4"),
        (16, 1, "1"),
    ):
        protocol, one = Protocol(1.0, at_once=at_once), SUITES["losses"].contenders[0]
        made = Chart(tiny_scene, tmp_path / str(at_once), [one], (0,), protocol)
        runner = command.processes(made)
        assert isinstance(runner, ProcessRunner) and runner.stop is made.stop
        assert made.machine["threads"] == threads
        assert runner.environment.get("OMP_NUM_THREADS") == variable


@pytest.mark.usefixtures("not_drawn")
def test_the_stored_command_makes_the_same_runs(
    started: Started, run: Run, tiny_scene: Path, tmp_path: Path
) -> None:
    chosen = [*METHODS, *TIME, "--seeds", 4, 5, "--images", 1, "--learn-seconds", 2]
    assert run(*chosen, out="first") == 1
    stored = json.loads((tmp_path / "first" / "results.json").read_text())["made"]["command"]
    words = stored.split()
    assert words[:4] == ["leco", "chart", "--data", tiny_scene.name]
    assert run(*words[4:], out="again") == 1
    assert started[:4] == started[4:] and len(started) == 8
    settings = [(tmp_path / name / "settings.json").read_text() for name in ("first", "again")]
    assert json.loads(settings[0]) == json.loads(settings[1])


BAD = {
    "'no-such'": ["--methods", "no-such", *TIME],
    "no sampler 'no-such'": ["--methods", "leco-ngp", "--samplers", "no-such", *TIME],
    "no suite 'no-such'": ["--suite", "no-such"],
    "give --suite or --methods": ["--suite", "losses", *METHODS],
    "nothing to chart": [*TIME],
    "give --seconds or --steps": METHODS,
    "a positive number, not 0": [*METHODS, "--seconds", 0],
    "a positive number, not -1": [*METHODS, "--steps", -1],
    "a positive number, not nan": [*METHODS, "--seconds", "nan"],
    "not -1": [*METHODS, *TIME, "--seeds", -1],
    "there is no chart in it": [*METHODS, *TIME, "--reuse", "no-such"],
    "at least one of the images": [*METHODS, *TIME, "--images", 0],
    "at least one of the runs at once": [*METHODS, *TIME, "--at-once", 0],
    "9 cameras, and a stretch is held out of": [*METHODS, *TIME, "--held-out", "stretch"],
    "share their runs by themselves": ["--suite", "losses", "freeze", "--reuse", "no-such"],
}


@pytest.mark.parametrize("cause", BAD)
def test_bad_input_is_one_line_and_nothing_is_started(
    cause: str, started: Started, refused: Any, tiny_scene: Path, tmp_path: Path
) -> None:
    out = tmp_path / "chart"
    assert cause in refused("chart", "--data", tiny_scene, "--out", out, *BAD[cause])
    assert not started and not out.exists()


def test_folders_and_scenes_that_do_not_fit_are_one_line_too(
    started: Started, run: Run, refused: Any, tiny_scene: Path, tmp_path: Path
) -> None:
    good, taken, new = (tmp_path / name for name in ("good", "taken", "new"))
    assert run("--suite", "losses", "--seeds", 0, out="good") == 0
    begun = len(started)
    assert begun == len(SUITES["losses"].contenders)
    taken.mkdir()
    (taken / "thesis.txt").write_text("")
    before = sorted(str(path) for path in good.rglob("*"))
    for cause, out, arguments in (
        ("another suite", good, [*METHODS, *TIME]),
        ("another seconds", good, ["--suite", "losses", "--seconds", 7]),
        ("holds something else", taken, [*METHODS, *TIME]),
        ("else (thesis.txt)", taken, ["--suite", "losses", "freeze"]),
        ("else (chart-dark.png)", good, ["--suite", "all"]),
        ("thesis.txt", taken / "thesis.txt", [*METHODS, *TIME]),
        ("nowhere", new, [*METHODS, *TIME]),
    ):
        data = tmp_path / "nowhere" if out is new else tiny_scene
        assert cause in refused("chart", "--data", data, "--out", out, *arguments)
    assert len(started) == begun and not new.exists()
    assert sorted(str(path) for path in good.rglob("*")) == before
    assert [path.name for path in taken.iterdir()] == ["thesis.txt"]
