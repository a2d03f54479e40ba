"""The GPU suite: every line runs without a GPU, on a bare machine, and from where it was killed."""

from __future__ import annotations

import json
import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import gpu_floor
import gpu_paper
import gpu_scale
import gpu_twin
import pytest
import torch
from results_page import RESULTS, check_gpu, gpu_table
from torch.utils.flop_counter import FlopCounterMode

from leco_plugin.models.encodings import EncodingConfig
from leco_plugin.models.field import HMoEField
from leco_plugin.models.gate import GateConfig

HERE = Path(__file__).resolve().parent
BENCHMARKS = HERE.parent / "benchmarks"
PARTS = ["correctness", "gate", "sampling", "experts", "learned", "dense"]

ON_A_BARE_MACHINE = """
import os, pathlib, runpy, sys
THERE = {
    "torch", "torchgen", "functorch", "numpy", "leco_plugin", "typing_extensions", "sympy",
    "mpmath", "networkx", "jinja2", "markupsafe", "fsspec", "filelock",
    *sys.stdlib_module_names, *(path.stem for path in pathlib.Path().glob("*.py")),
}
class FindsThese:
    def __init__(self, finder):
        self.finder = finder
    def __getattr__(self, name):
        return getattr(self.finder, name)
    def find_spec(self, name, path=None, target=None):
        package = name.split(".")[0]
        if package in THERE or package.startswith("_sysconfigdata"):
            return self.finder.find_spec(name, path, target)
sys.meta_path[:] = map(FindsThese, sys.meta_path)
import gpu  # and all that it imports, once for all runs
for out in map(str.strip, sys.stdin):
    child = os.fork()
    if child == 0:
        os.dup2(2, 1)
        sys.argv = ["gpu.py", "--dry-run", "--out", out]
        runpy.run_path("gpu.py", run_name="__main__")
    print(child, flush=True)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""
"""Torch and numpy are there, what torch itself requires, this package, and nothing else. A dry run,
in a fork, for each results file that is named; what is printed is its process and its status."""
A_MINUTE = 60.0


def environment() -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(BENCHMARKS.parent), "OMP_NUM_THREADS": "1"}


def seconds_of_ended_processes() -> float:
    """What processes that this one started and saw end have computed; waiting does not count."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


@pytest.mark.long
def test_every_line_is_exercised_without_a_gpu() -> None:
    command = [sys.executable, str(HERE / "gpu_suite_traced.py")]
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=280, env=environment(), cwd=HERE.parent
    )
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-2000:]


@contextmanager
def on_a_bare_machine(said: Path) -> Iterator[Callable[[Path], tuple[int, Callable[[], int]]]]:
    """Starts a dry run with a results file: returns its process, and what waits for its status.

    Args:
        said: a file for what the runs say.
    """
    command = [sys.executable, "-c", ON_A_BARE_MACHINE]
    pipes: Any = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with (
        said.open("w") as errors,
        subprocess.Popen(
            command, cwd=BENCHMARKS, env=environment(), stderr=errors, **pipes
        ) as machine,
    ):

        def answer() -> int:
            line = machine.stdout.readline()
            assert line, said.read_text()[-2000:]
            return int(line)

        def start(out: Path) -> tuple[int, Callable[[], int]]:
            print(out, file=machine.stdin, flush=True)
            return answer(), answer

        yield start


def test_a_killed_run_on_a_bare_machine_goes_on_where_it_stopped(tmp_path: Path) -> None:
    out, said, used = tmp_path / "gpu.json", tmp_path / "said", seconds_of_ended_processes()
    with on_a_bare_machine(said) as start:
        first, status = start(out)
        while not (out.exists() and "gate" in json.loads(out.read_text())["parts"]):
            assert Path(f"/proc/{first}").exists(), said.read_text()[-2000:]
            time.sleep(0.05)
        os.kill(first, signal.SIGKILL)
        assert status() == -signal.SIGKILL
        before = json.loads(out.read_text())["parts"]
        assert len(before) < len(PARTS)
        _, status = start(out)
        assert status() == 0, said.read_text()[-2000:]
    after = json.loads(out.read_text())["parts"]
    assert list(after) == PARTS and {name: after[name] for name in before} == before
    assert seconds_of_ended_processes() - used < A_MINUTE


def test_operations_on_paper_are_those_of_the_products() -> None:
    sizes = gpu_scale.PAPER
    with FlopCounterMode(display=False) as counted, torch.device("meta"):
        field = HMoEField(sizes.field, 1)
        features = field.projection(torch.empty(10, field.encoding.out_dim))
        field.density_head(field.experts.experts[1](features))
    assert counted.get_total_flops() == 10 * gpu_paper.field_operations(sizes)
    dense = gpu_paper.step_of(sizes, 10, 0, guided=False)
    assert dense.operations == 30 * (
        gpu_paper.field_operations(sizes) + gpu_paper.operations_per_position(sizes.gate)
    )


def test_bytes_of_the_twin_are_those_of_its_operations() -> None:
    values = torch.zeros(10, 4)
    with gpu_twin.Traffic() as traffic:
        values.T.relu()
    assert traffic.bytes == 2 * 10 * 4 * 4
    sizes = [GateConfig(EncodingConfig(octaves=1), width, 1, 1) for width in (8, 16)]
    narrow, wide = (gpu_twin.bytes_of_twin(config) for config in sizes)
    product, rectified, cast, normed, head = 2, 4, 6, 8, 4
    assert wide - narrow == 8 * (product + rectified + cast + normed + head)


def test_stored_results_are_of_cards_that_somebody_ran_on() -> None:
    for path in RESULTS.glob("gpu-*.json"):
        check_gpu(json.loads(path.read_text()))
    measured = {"dry": False, "machine": {"device": "NVIDIA H100", "driver": "570.86"}}
    check_gpu(measured)
    for fault in (
        {"dry": True},
        {"machine": {"device": "cpu", "driver": "570.86"}},
        {"machine": {"device": "NVIDIA H100", "driver": None}},
    ):
        with pytest.raises(ValueError, match="nobody ran on"):
            check_gpu({**measured, **fault})


def test_a_figure_is_shown_with_its_floor_beside_it() -> None:
    figure = gpu_scale.figure("gate: floor / fused", 0.6, 0.5, False, fused=2e-3, floor=1e-3)
    row = gpu_table({"parts": {"gate": {"figures": [figure]}}}).splitlines()[-1]
    assert row == "| gate: floor / fused | 0.6 | >= 0.5 | yes | fused 2, floor 1 |"


def test_figures_of_a_twin_are_shown_as_its_own() -> None:
    parts = {"gate": {"running": {"gate": True, "march": False}, "figures": []}}
    table = gpu_table({"parts": parts})
    assert table.endswith("Part gate: torch answered in place of the fused march.")


def test_the_trained_runs_are_shown_side_by_side() -> None:
    step = {"seconds": 0.01, "peak_bytes": 1 << 30}
    parts = {
        "learned": {
            "seconds": {"learning": 60.2, "freezing": 2.0, "guided": 60.1},
            "steps": {"learning": 100, "all": 350},
            "learning_step": step,
            "guided_step": step,
            "psnr": 21.5,
        },
        "dense": {"seconds": 122.0, "steps": 70, "step": step, "psnr": 20.25},
    }
    assert gpu_table({"parts": parts}).splitlines()[-3:] == [
        "| learning | 60 | 100 | 10.0 | 1.00 | - |",
        "| guided | 60 | 250 | 10.0 | 1.00 | 21.50 |",
        "| dense | 122 | 70 | 10.0 | 1.00 | 20.25 |",
    ]
    parts["dense"] = {"left_out": "out of memory"}
    assert gpu_table({"parts": parts}).endswith("Part dense was left out: out of memory")


def test_the_checkout_is_measured_and_not_what_is_installed(tmp_path: Path) -> None:
    (tmp_path / "leco_plugin").mkdir()
    (tmp_path / "leco_plugin" / "__init__.py").touch()
    command = [sys.executable, "-c", "import checkout, leco_plugin; print(leco_plugin.__file__)"]
    done = subprocess.run(
        command,
        cwd=BENCHMARKS,
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
        check=True,
    )
    assert Path(done.stdout.strip()).parent == BENCHMARKS.parent / "leco_plugin"


def test_the_floor_is_the_larger_of_bytes_and_operations() -> None:
    config = GateConfig(EncodingConfig(octaves=6), width=64, layers=3, scene_experts=4)
    assert gpu_floor.operations_per_position(config) == 2 * (39 * 64 + 2 * 64 * 64 + 64 * 5)
    slow_memory = gpu_floor.floor_seconds(config, 10, gpu_floor.Ceilings(13.0, 1e12))
    assert slow_memory["floor"] == slow_memory["bytes"] == 10.0
    slow_products = gpu_floor.floor_seconds(config, 10, gpu_floor.Ceilings(1e12, 22016.0))
    assert slow_products["floor"] == slow_products["operations"] == pytest.approx(10.0)
