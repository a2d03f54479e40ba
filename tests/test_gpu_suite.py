"""The GPU suite runs to its end without a GPU, resumes, and then measures nothing."""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from leco_plugin.models.encodings import EncodingConfig
from leco_plugin.models.gate import GateConfig

BENCHMARKS = Path(__file__).resolve().parent.parent / "benchmarks"


def suite(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(BENCHMARKS / "gpu.py"), *arguments]
    environment = {**os.environ, "PYTHONPATH": str(BENCHMARKS.parent)}
    return subprocess.run(command, capture_output=True, text=True, timeout=280, env=environment)


def test_the_dry_run_does_every_part_and_a_second_one_none(tmp_path: Path) -> None:
    out = tmp_path / "gpu.json"
    done = suite("--dry-run", "--out", str(out))
    assert done.returncode == 0, done.stderr
    results = json.loads(out.read_text())
    assert list(results["parts"]) == ["correctness", "gate", "sampling", "training"]
    assert results["machine"]["torch"] == torch.__version__ and "driver" in results["machine"]
    again = suite("--dry-run", "--out", str(out))
    assert again.returncode == 0 and "floor / fused" not in again.stdout
    assert json.loads(out.read_text())["parts"] == results["parts"]


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU to be measured")
def test_without_a_gpu_nothing_is_measured() -> None:
    done = suite()
    assert done.returncode == 2 and "no CUDA device here" in done.stderr


def test_the_floor_is_the_larger_of_bytes_and_operations(monkeypatch) -> None:
    spec = importlib.util.spec_from_file_location("gpu_floor", BENCHMARKS / "gpu_floor.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "gpu_floor", module)
    spec.loader.exec_module(module)
    config = GateConfig(EncodingConfig(octaves=6), width=64, layers=3, scene_experts=4)
    assert module.operations_per_position(config) == 2 * (39 * 64 + 2 * 64 * 64 + 64 * 5)
    slow_memory = module.floor_seconds(config, 10, module.Ceilings(13.0, 1e12))
    assert slow_memory["floor"] == slow_memory["bytes"] == 10.0
    slow_products = module.floor_seconds(config, 10, module.Ceilings(1e12, 22016.0))
    assert slow_products["floor"] == slow_products["operations"] == pytest.approx(10.0)
