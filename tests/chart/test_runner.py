"""Claims about jobs in processes of their own, and the folder that keeps them."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from leco_plugin.chart.contender import Contender, Job, Protocol
from leco_plugin.chart.runner import (
    LOGS,
    RUNS,
    UNFINISHED,
    ProcessRunner,
    RunFailed,
    RunFolder,
    make_jobs,
)
from leco_plugin.scenes.input_error import InputError

SETTINGS = {"seconds": 10.0, "machine": {"cores": 2, "device": "cpu"}, "sizes": (1, 2)}
JOB = Job(Contender("A + b", "a", "b", {"x.y": 1}), 3)


@pytest.mark.parametrize("done", [0, 6])
def test_the_share_that_is_done_is_of_all_jobs_those_of_before_included(done: int) -> None:
    shares: list[float] = []

    def make_one(job: str, show: Callable[[float], None]) -> str:
        show(0.5)
        return job

    make_jobs("ab", make_one, lambda line: None, shares.append, done=done)
    steps = [0.0, 0.5, 1.0, 1.0, 1.5, 2.0]
    assert shares == pytest.approx([(done + step) / (done + 2) for step in steps])


def test_a_stored_run_is_found_again_under_its_job(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path / "new" / "chart", SETTINGS)
    assert folder.stored() == {}
    folder.store(JOB, {"psnr": 20.0})
    again = RunFolder(tmp_path / "new" / "chart", SETTINGS).stored()
    assert again[JOB.name]["run"] == {"psnr": 20.0}
    assert Contender.from_dict(again[JOB.name]["contender"]) == JOB.contender


def test_what_a_killed_process_left_is_no_run_and_is_cleared(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path, SETTINGS)
    (folder.path / RUNS / ".half.json.1.unfinished").write_text("{")
    left = folder.path / UNFINISHED / "job"
    left.mkdir()
    again = RunFolder(tmp_path, SETTINGS)
    assert again.stored() == {} and left.exists()  # of another process, for all it knows
    again.clear()
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
    RunFolder(tmp_path, SETTINGS)
    with pytest.raises(InputError, match=said) as refused:
        RunFolder(tmp_path, SETTINGS | change)
    assert "\n" not in str(refused.value) and "--out" in str(refused.value)


def test_a_folder_of_something_else_is_refused_and_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("")
    with pytest.raises(InputError, match="holds something else"):
        RunFolder(tmp_path, SETTINGS)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]


def test_a_folder_that_cannot_be_made_is_named_with_the_remedy() -> None:
    line = r"^nothing can be written into /proc/chart .*: name another folder with --out$"
    with pytest.raises(InputError, match=line):
        RunFolder(Path("/proc/chart"), SETTINGS)


def test_an_empty_folder_is_taken(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    RunFolder(tmp_path / "empty", SETTINGS)
    assert json.loads((tmp_path / "empty" / "settings.json").read_text())["seconds"] == 10.0


@pytest.mark.parametrize("text", ["{", "[]", "\\x00"])
def test_a_damaged_file_is_named(tmp_path: Path, text: str) -> None:
    folder = RunFolder(tmp_path, SETTINGS)
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
        RunFolder(tmp_path, SETTINGS)


OPENED = "import json, os, sys, time; from pathlib import Path; work = Path(sys.argv[-1]); "
SUCCEEDS = OPENED + (
    "(work / 'progress').write_text('0.5'); time.sleep(0.6); "
    "(work / 'occupancy.safetensors').write_text('gate'); "
    "job = json.loads((work / 'job.json').read_text()); "
    "(work / 'result.json').write_text(json.dumps({'psnr': 20.0, 'seed': job['seed']}))"
)
FAILURES = {
    "the gate calls all space empty": OPENED
    + "(work / 'failure.json').write_text(json.dumps({'reason': 'the gate calls all space empty'}))"
    + "; sys.exit(1)",
    "ended by SIGKILL; the machine may have run out of memory": OPENED + "os.kill(os.getpid(), 9)",
    "ended by SIGSEGV": OPENED + "os.kill(os.getpid(), 11)",
    "status 3: last words": OPENED + "print('first'); print('last words\\n'); sys.exit(3)",
    "status 0: it said nothing": OPENED,
}


def runner(folder: RunFolder, code: str) -> ProcessRunner:
    command = [sys.executable, "-c", code]
    return ProcessRunner(Path("scene"), Protocol(1.0), folder, command)


@pytest.fixture
def folder(tmp_path: Path) -> RunFolder:
    return RunFolder(tmp_path / "chart", {})


def test_a_result_comes_back_with_its_occupancy(folder: RunFolder) -> None:
    shares: list[float] = []
    result = runner(folder, SUCCEEDS)(JOB, shares.append)
    assert result == {"psnr": 20.0, "seed": 3}
    assert 0.5 in shares
    assert (folder.path / RUNS / f"{JOB.name}.safetensors").read_text() == "gate"
    assert not any((folder.path / UNFINISHED).iterdir())
    assert not any((folder.path / LOGS).iterdir())


@pytest.mark.parametrize("reason", FAILURES)
def test_a_process_that_fails_gives_its_reason(folder: RunFolder, reason: str) -> None:
    with pytest.raises(RunFailed, match=reason) as failed:
        runner(folder, FAILURES[reason])(JOB, lambda share: None)
    assert "\n" not in str(failed.value)
    assert (folder.path / LOGS / f"{JOB.name}.log").exists()


def test_stopping_the_chart_ends_the_run_that_is_under_way(folder: RunFolder) -> None:
    def stop(share: float) -> None:
        raise KeyboardInterrupt

    slow = OPENED + "(work / 'progress').write_text('0.1'); time.sleep(60)"
    began = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        runner(folder, slow)(JOB, stop)
    assert time.monotonic() - began < 30


def test_a_run_that_ctrl_c_has_ended_before_us_is_no_failure(folder: RunFolder) -> None:
    """All processes of a terminal get the signal, and a child may be the first to end."""
    ended = OPENED + "import signal; signal.signal(2, signal.SIG_DFL); os.kill(os.getpid(), 2)"
    with pytest.raises(KeyboardInterrupt):
        runner(folder, ended)(JOB, lambda share: None)


def test_a_run_ends_when_the_process_that_waits_for_it_is_gone() -> None:
    code = (
        "import time; from leco_plugin.chart.runner import die_with_parent; "
        "die_with_parent(); print('up', flush=True); time.sleep(60)"
    )
    child = subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    assert child.stdin is not None and child.stdout is not None
    assert child.stdout.readline() == b"up\n"
    child.stdin.close()
    assert child.wait(timeout=30) == 1
    child.stdout.close()
