"""The example runs as it stands, without nerfstudio, and learns."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
import torch

from leco_plugin.models.encodings import EncodingConfig
from leco_plugin.models.gate import Gate, GateConfig
from leco_plugin.occupancy import Occupancy
from leco_plugin.space import Space

SCRIPT = Path(__file__).parents[2] / "examples" / "plain_torch_nerfacc_loop.py"


@pytest.mark.parametrize("kind", ["box", "contraction"])
def test_the_example_trains_in_thirty_lines_without_nerfstudio(kind, tmp_path):
    pytest.importorskip("nerfacc")
    lines = SCRIPT.read_text().splitlines()
    assert len(lines) <= 30
    assert "nerfstudio" not in "".join(lines)
    torch.manual_seed(0)
    report = {"near": 0.05, "far": 3.0}
    small = GateConfig(EncodingConfig(octaves=2), width=16, layers=1)  # its cells are cached
    occupancy = Occupancy(Gate(small), Space(kind), threshold=0.7, report=report)
    occupancy.save(tmp_path / "occupancy.safetensors")
    command = [sys.executable, str(SCRIPT), str(tmp_path / "occupancy.safetensors"), "30"]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    losses = [float(line.split("loss ")[1].split(",")[0]) for line in result.stdout.splitlines()]
    assert losses[-1] < losses[0]
