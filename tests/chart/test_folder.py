"""Claims about the folder of a chart."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from leco_plugin.chart.contenders.contender import Contender
from leco_plugin.chart.runs.folder import RUNS, UNFINISHED, ChartFolder, Job
from leco_plugin.scenes.input_error import InputError

SETTINGS = {"seconds": 10.0, "machine": {"cores": 2, "device": "cpu"}, "sizes": (1, 2)}
JOB = Job(Contender("A + b", "a", "b", {"x.y": 1}), 3)


def test_a_stored_run_is_found_again_under_its_job(tmp_path: Path) -> None:
    folder = ChartFolder(tmp_path / "new" / "chart", SETTINGS)
    assert folder.stored() == {}
    folder.store(JOB, {"psnr": 20.0})
    again = ChartFolder(tmp_path / "new" / "chart", SETTINGS).stored()
    assert again[JOB.name]["run"] == {"psnr": 20.0}
    assert Contender.from_dict(again[JOB.name]["contender"]) == JOB.contender


def test_what_a_killed_process_left_is_no_run_and_is_cleared(tmp_path: Path) -> None:
    folder = ChartFolder(tmp_path, SETTINGS)
    (folder.path / RUNS / ".half.json.1.unfinished").write_text("{")
    left = folder.path / UNFINISHED / "job"
    left.mkdir()
    again = ChartFolder(tmp_path, SETTINGS)
    assert again.stored() == {} and left.exists()  # of another process, for all it knows
    with again.alone():
        assert not left.exists()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"seconds": 20.0}, r"another seconds \(10.0, not 20.0\)"),
        ({"machine": {"cores": 4, "device": "cpu"}}, r"another machine \(2, cpu, not 4, cpu\)"),
        ({"suite": "losses"}, r"another suite \(None, not losses\)"),
    ],
)
def test_runs_with_other_settings_are_refused_in_a_line(
    tmp_path: Path, change: dict[str, object], said: str
) -> None:
    ChartFolder(tmp_path, SETTINGS)
    with pytest.raises(InputError, match=said) as refused:
        ChartFolder(tmp_path, SETTINGS | change)
    assert "\n" not in str(refused.value) and "--out" in str(refused.value)


def test_a_folder_of_something_else_is_refused_and_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("")
    with pytest.raises(InputError, match="holds something else"):
        ChartFolder(tmp_path, SETTINGS)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]


def test_an_empty_folder_is_taken(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    ChartFolder(tmp_path / "empty", SETTINGS)
    assert json.loads((tmp_path / "empty" / "settings.json").read_text())["seconds"] == 10.0


@pytest.mark.parametrize("text", ["{", "[]", "\\x00"])
def test_a_damaged_folder_is_told_of_in_a_line_that_names_the_file(
    tmp_path: Path, text: str
) -> None:
    folder = ChartFolder(tmp_path, SETTINGS)
    run = folder.path / RUNS / "a.json"
    run.write_text(text)
    with pytest.raises(InputError, match=r"a\.json is damaged") as refused:
        folder.stored()
    assert "\n" not in str(refused.value)
    run.write_text('{"contender": 3}')
    with pytest.raises(InputError, match=r"a\.json is no run"):
        folder.stored()
    (tmp_path / "settings.json").write_text(text)
    with pytest.raises(InputError, match=r"settings\.json is damaged"):
        ChartFolder(tmp_path, SETTINGS)
