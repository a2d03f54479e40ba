"""What the README and docs/results.md say is what is stored."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def test_the_published_tables_are_those_of_the_stored_results() -> None:
    finished = subprocess.run(
        [sys.executable, ROOT / "benchmarks" / "results_page.py", "--check"],
        capture_output=True,
        text=True,
    )
    assert finished.returncode == 0, finished.stderr
