"""What the README and docs/results.md say is what is stored."""

from __future__ import annotations

import importlib
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


def test_a_sampling_section_says_when_and_of_which_code_it_is(monkeypatch) -> None:
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    results_page = importlib.import_module("results_page")
    report = {"machine": {"processor": "a processor"}, "figures": []}
    title, line, _ = results_page.sampling_section(report)
    assert title == "## Sampling: a processor\n" and line.endswith("Ratios within one run.\n")
    report |= {"date": "2026-11-23", "code": {"version": "0.1.0", "commit": "0123456789ab"}}
    title, line, _ = results_page.sampling_section(report)
    assert title == "## Sampling: a processor, 2026-11-23\n"
    assert line.endswith("within one run. leco_plugin 0.1.0 at 0123456789ab.\n")
