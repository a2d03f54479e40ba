"""Runs `gpu_suite*_cases.py` and prints the lines of the GPU suite that none of its cases reached.

A line that needs a card says so at its end: `# CUDA only`.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import pytest

HERE = Path(__file__).resolve().parent
SUITE = sorted((HERE.parent / "benchmarks").glob("gpu*.py"))
reached: dict[str, set[int]] = {str(path): set() for path in SUITE}


def trace(frame: FrameType, event: str, argument: object) -> Any:
    """Notes lines of the suite, and looks into nothing else."""
    lines = reached.get(frame.f_code.co_filename)
    if lines is None:
        return None
    lines.add(frame.f_lineno)
    return trace


def lines_of(code: CodeType) -> Iterator[int]:
    """All lines of a file that can be reached."""
    yield from (line for _, _, line in code.co_lines() if line)
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from lines_of(constant)


def main() -> int:
    """0 where all cases passed and reached all lines."""
    sys.path.insert(0, str(HERE.parent / "benchmarks"))
    sys.settrace(trace)
    options = ["-q", "-p", "no:cacheprovider", "-o", "timeout=0"]  # whoever starts this has one
    failed = int(pytest.main([*options, *map(str, sorted(HERE.glob("gpu_suite*_cases.py")))]))
    sys.settrace(None)
    for path in SUITE:
        text = path.read_text()
        source = text.splitlines()
        for line in sorted(set(lines_of(compile(text, str(path), "exec"))) - reached[str(path)]):
            if not source[line - 1].rstrip().endswith("# CUDA only"):
                print(f"not reached: {path.name}:{line}: {source[line - 1].strip()}")
                failed = 1
    return failed


if __name__ == "__main__":
    sys.exit(main())
