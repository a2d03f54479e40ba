"""Claims about runs in processes of their own, with stand-ins for the process."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import pytest

from leco_plugin.chart.contenders.contender import Contender
from leco_plugin.chart.contenders.protocol import Protocol
from leco_plugin.chart.runs.folder import LOGS, RUNS, UNFINISHED, ChartFolder, Job
from leco_plugin.chart.runs.processes import ProcessRunner, RunFailed

JOB = Job(Contender("A + b", "a", "b"), 3)
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


def runner(folder: ChartFolder, code: str) -> ProcessRunner:
    command = [sys.executable, "-c", code]
    return ProcessRunner(Path("scene"), Protocol(1.0), folder, command)


@pytest.fixture
def folder(tmp_path: Path) -> ChartFolder:
    return ChartFolder(tmp_path / "chart", {})


def test_a_result_comes_back_with_its_occupancy_and_nothing_is_left_behind(
    folder: ChartFolder,
) -> None:
    shares: list[float] = []
    result = runner(folder, SUCCEEDS)(JOB, shares.append)
    assert result == {"psnr": 20.0, "seed": 3}
    assert 0.5 in shares
    assert (folder.path / RUNS / f"{JOB.name}.safetensors").read_text() == "gate"
    assert not any((folder.path / UNFINISHED).iterdir())
    assert not any((folder.path / LOGS).iterdir())


@pytest.mark.parametrize("reason", FAILURES)
def test_a_process_that_fails_has_a_reason_in_a_line_and_keeps_its_log(
    folder: ChartFolder, reason: str
) -> None:
    with pytest.raises(RunFailed, match=reason) as failed:
        runner(folder, FAILURES[reason])(JOB, lambda share: None)
    assert "\n" not in str(failed.value)
    assert (folder.path / LOGS / f"{JOB.name}.log").exists()


def test_stopping_the_chart_ends_the_run_that_is_under_way(folder: ChartFolder) -> None:
    def stop(share: float) -> None:
        raise KeyboardInterrupt

    slow = OPENED + "(work / 'progress').write_text('0.1'); time.sleep(60)"
    began = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        runner(folder, slow)(JOB, stop)
    assert time.monotonic() - began < 30


def test_a_run_ends_when_the_process_that_waits_for_it_is_gone() -> None:
    code = (
        "import time; from leco_plugin.chart.runs.worker import die_with_parent; "
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
