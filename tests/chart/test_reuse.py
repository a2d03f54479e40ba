"""Claims about runs that are taken over from other charts."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import chart_results
import pytest

from leco_plugin.chart.contenders.contender import Contender
from leco_plugin.chart.contenders.protocol import Protocol
from leco_plugin.chart.runs.folder import RUNS, Job
from leco_plugin.chart.runs.reuse import fitting
from leco_plugin.chart.runs.run import Chart
from leco_plugin.scenes.input_error import InputError

PLAIN = Contender("learn", "leco-occupancy", "learned-occupancy", {"distortion": 0.1})
WITH_GRIDS = replace(PLAIN, name="ours", grids=(64, 128))
OTHER = Contender("other", "leco-occupancy", "dense")


class Runner:
    """Makes runs at once, with an occupancy and the grids that are asked for."""

    def __init__(self) -> None:
        self.made: list[tuple[str, int]] = []

    def __call__(self, job: Job, show: Callable[[float], None]) -> dict[str, Any]:
        self.made.append((job.contender.name, job.seed))
        grids = [
            {
                "resolution": n,
                "bytes": n**3 // 8,
                "update_seconds": 1.0,
                "kept_reached_volume": 0.5,
            }
            for n in job.contender.grids
        ]
        held = chart_results.occupancy(50_000, 0.1, grids)
        return chart_results.run(job.contender.name, job.seed, occupancy=held)


def made(
    scene: Path, out: Path, *compared: Contender, seeds: tuple[int, ...] = (0, 1), **changes: Any
) -> tuple[dict[str, Any], Runner, list[str]]:
    values = {"protocol": Protocol(10.0)} | changes
    runner, said = Runner(), []
    chart = Chart(scene, out, compared, seeds, **values)
    chart.make(runner, say=said.append, show=lambda share: None)
    return chart.results(), runner, said


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


def test_a_run_that_does_not_say_how_it_was_made_is_of_what_its_chart_says(
    tiny_scene: Path, tmp_path: Path
) -> None:
    made(tiny_scene, tmp_path / "a", PLAIN, seeds=(0,))
    file = tmp_path / "a" / RUNS / f"{Job(PLAIN, 0).name}.json"
    record = json.loads(file.read_text())
    del record["made"]
    file.write_text(json.dumps(record))
    said = tmp_path / "a" / "results.json"
    said.write_text(json.dumps({"made": {"commit": "1b", "command": "leco chart"}}))
    results, _, _ = made(tiny_scene, tmp_path / "b", PLAIN, seeds=(0,), reuse=[tmp_path / "a"])
    assert results["made"]["commit"] == "1b"


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
    assert fitting(folders, suite.settings) == [tmp_path / "a"]


def test_charts_from_before_runs_could_be_beside_each_other_had_one_at_a_time(
    tiny_scene: Path, tmp_path: Path
) -> None:
    made(tiny_scene, tmp_path / "a", PLAIN, seeds=(0,))
    file = tmp_path / "a" / "settings.json"
    settings = json.loads(file.read_text())
    assert settings.pop("at_once") == 1
    file.write_text(json.dumps(settings))
    _, runner, _ = made(tiny_scene, tmp_path / "b", PLAIN, seeds=(0,), reuse=[tmp_path / "a"])
    assert not runner.made
    with pytest.raises(InputError, match="another at once"):
        made(tiny_scene, tmp_path / "a", PLAIN, protocol=Protocol(10.0, at_once=2))
