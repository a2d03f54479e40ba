"""The command line of benchmarks that measure finished runs, and store a row for each scene; and
rows that others have stored."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro
from page_parts import RESULTS

from leco_plugin.evaluation.report import (
    describe_code,
    describe_machine,
    made_by,
    read_object,
)
from leco_plugin.scenes.whole_files import write_json


@dataclass
class Options:
    """Settings of the benchmark."""

    runs: tyro.conf.Positional[tuple[str, ...]]
    """Folders of runs and their scenes, as RUN=SCENE."""
    out: Path | None = None
    """Where the figures go, in place of the project's results; rows of scenes that are not named
    stay."""


def main(
    row_of: Callable[[Path, Path], dict[str, Any]], name: str, args: Sequence[str] | None = None
) -> None:
    """Measures the runs that are named, one after the other.

    Args:
        row_of: from the folders of a run and its scene to the figures of the run.
        name: of the file among the results.
        args: of the command line, `sys.argv` by default.
    """
    options = tyro.cli(Options, args=args)
    out = options.out or RESULTS / f"{name}.json"
    known = read_object(out, "is damaged; delete it") if out.exists() else {}
    rows: dict[str, Any] = known.get("scenes", {})
    code = describe_code()
    for pair in options.runs:
        run, _, data = pair.partition("=")
        if not data:
            raise SystemExit(f"{pair} is not RUN=SCENE")
        scene = Path(data).resolve().name  # of `.` too
        rows[scene] = {**row_of(Path(run), Path(data)), **made_by(code)}
        print(scene, rows[scene], flush=True)
        write_json(out, {"format": 1, "machine": describe_machine(), "scenes": rows})


def stored_rows(out: Path, settings: dict[str, Any]) -> list[dict[str, Any]]:
    """Rows that an earlier run of the same settings has left.

    Raises:
        SystemExit: they are of other settings.
    """
    if not out.is_file():
        return []
    stored = json.loads(out.read_text())
    if stored["settings"] != settings:
        raise SystemExit(
            f"{out} holds runs of {stored['settings']}, not of {settings}; name another --out"
        )
    rows: list[dict[str, Any]] = stored["runs"]
    return rows
