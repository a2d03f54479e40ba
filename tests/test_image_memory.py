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


def test_the_stored_result_stays_below_half_of_the_decoded_bytes() -> None:
    stored = json.loads((ROOT / "benchmarks" / "results" / "image-memory.json").read_text())
    (row,) = [row for row in stored["runs"] if row["way"] == "disk"]
    assert row["decoded_bytes"] == 3 * 2000 * 1500 * 59
    assert row["photographs_bytes"] < 0.5 * row["decoded_bytes"]
    assert row["added_bytes"] < 0.5 * row["decoded_float_bytes"]


@pytest.mark.slow
def test_memory_does_not_grow_with_the_photographs_on_disk(tmp_path: Path) -> None:
    """48 pictures decode to 432 MB in bytes, 1.7 GB in floats."""
    out = tmp_path / "out.json"
    command = [sys.executable, "-W", "ignore", str(SCRIPT), "--ways", "disk", "--steps", "2"]
    command += ["--images", "48", "--width", "2000", "--height", "1500", "--out", str(out)]
    done = subprocess.run(
        command,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    (row,) = json.loads(out.read_text())["runs"]
    assert row["photographs_bytes"] < 0.5 * row["decoded_bytes"]
