"""Photographs that are on disk need little memory, however many there are."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
SCRIPT = ROOT / "benchmarks" / "image_memory.py"


def test_the_stored_result_keeps_more_than_the_allowance_on_disk() -> None:
    stored = json.loads((ROOT / "benchmarks" / "results" / "image-memory.json").read_text())
    rows = {row["way"]: row for row in stored["runs"]}
    assert not rows["memory"]["within_allowance"]  # or nothing would have been enforced
    row = rows["disk"]
    assert row["within_allowance"]
    assert row["decoded_bytes"] == 3 * 2000 * 1500 * 239 > stored["allowance_bytes"]
    assert row["added_bytes"] < 0.5 * row["decoded_bytes"]


@pytest.mark.slow
@pytest.mark.long
def test_memory_does_not_grow_with_the_photographs_on_disk(tmp_path: Path) -> None:
    """72 pictures decode to 648 MB in bytes, 2.6 GB in floats."""
    out = tmp_path / "out.json"
    command = [sys.executable, "-W", "ignore", str(SCRIPT), "--steps", "2"]
    command += ["--ways", "disk", "memory"]
    command += ["--images", "72", "--width", "2000", "--height", "1500", "--out", str(out)]
    done = subprocess.run(
        command,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    disk, memory = json.loads(out.read_text())["runs"]
    photographs = disk["added_bytes"] - disk["added_on_a_tenth_bytes"]
    assert photographs < 0.5 * disk["decoded_bytes"]
    assert not memory["within_allowance"]
