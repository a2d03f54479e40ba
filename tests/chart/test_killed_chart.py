"""A chart that is killed without a warning keeps what was finished, and makes the rest later."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import chart_results

from leco_plugin.chart.chart import Chart
from leco_plugin.chart.contender import Contender, Protocol
from leco_plugin.chart.runner import RUNS, UNFINISHED, ProcessRunner

NAMES = ("first", "second", "third")
WORKER = """
import json, sys, time
from pathlib import Path
work = Path(sys.argv[-1])
name = json.loads((work / "job.json").read_text())["contender"]["name"]
if name == "second" and sys.argv[1] == "slow":
    from leco_plugin.chart.runner import die_with_parent
    die_with_parent()
    (work / "progress").write_text("0.5")
    time.sleep(60)
run = json.loads(sys.argv[2])
(work / "result.json").write_text(json.dumps({**run, "name": name}))
"""
PARENT = """
import sys
from pathlib import Path
from test_killed_chart import make
make(Path(sys.argv[1]), Path(sys.argv[2]), "slow")
"""


def make(scene: Path, out: Path, pace: str) -> Chart:
    """A chart of three runs, of which `slow` never makes the second."""
    contenders = [Contender(name, name, "own") for name in NAMES]
    chart = Chart(scene, out, contenders, [0], Protocol(10.0))
    run = json.dumps(chart_results.run("", sampler="own"))
    command = [sys.executable, "-c", WORKER, pace, run]
    runner = ProcessRunner(scene, chart.protocol, chart.folder, command)
    chart.make(runner, say=lambda line: None, show=lambda share: None)
    return chart


def test_a_killed_chart_loses_only_the_run_under_way(tiny_scene: Path, tmp_path: Path) -> None:
    out, here = tmp_path / "chart", Path(__file__).resolve().parent
    found = os.environ.get("PYTHONPATH", "")
    paths = {**os.environ, "PYTHONPATH": f"{here}:{here.parent}:{found}"}
    parent = subprocess.Popen([sys.executable, "-c", PARENT, tiny_scene, out], env=paths)
    until = time.monotonic() + 120
    while not list(out.glob(f"{UNFINISHED}/second-*/progress")):
        assert parent.poll() is None and time.monotonic() < until
        time.sleep(0.1)
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    (stored,) = (out / RUNS).glob("*.json")
    before = stored.read_bytes(), stored.stat().st_mtime_ns
    assert len(json.loads((out / "results.json").read_text())["runs"]) == 1
    results = make(tiny_scene, out, "fast").results()
    assert [run["name"] for run in results["runs"]] == list(NAMES)
    assert (stored.read_bytes(), stored.stat().st_mtime_ns) == before
    assert not any((out / UNFINISHED).iterdir())
