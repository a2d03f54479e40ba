"""What the sections of generated pages are made of."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "benchmarks" / "results"
NOT_NOTED = "of an earlier commit, not noted"


def machine_line(report: dict[str, Any]) -> str:
    """What it ran on, in one line."""
    return ", ".join(f"{name}: {value}" for name, value in report["machine"].items())


def made_line(rows: Iterable[Mapping[str, Any]]) -> str:
    """Which code made some rows, and when, as far as they say so."""
    counted = Counter(_made(row) for row in rows)
    if len(counted) == 1:
        return next(iter(counted))
    return "; ".join(f"{count} {made}" for made, count in sorted(counted.items()))


def _made(row: Mapping[str, Any]) -> str:
    if "code" not in row:
        return NOT_NOTED
    code = row["code"]
    commit = code["commit"] or "no commit"
    return f"by leco_plugin {code['version']} at {commit}, sources {code['sources']}, {row['date']}"


def between(text: str, marks: tuple[str, str], body: str) -> str:
    """The text with what is between two marks renewed."""
    begin, end = marks
    before, rest = text.split(begin)
    return f"{before}{begin}\n{body}\n{end}{rest.split(end)[1]}"


def noted(folder: Path) -> dict[str, str]:
    """What is said of stored charts that were made before a mend, by their names."""
    file = folder / "notes.json"
    found: dict[str, str] = json.loads(file.read_text()) if file.exists() else {}
    return found


def size(kilobytes: float) -> str:
    """A size in words."""
    if kilobytes >= 1e3:
        return f"{kilobytes / 1e3:.1f} MB"
    return f"{kilobytes:.{0 if kilobytes >= 10.0 else 1}f} kB"


def span(values: Iterable[float], form: str = ",.1f") -> str:
    """The least and the most of some values, in words."""
    known = [*values]
    low, high = format(min(known), form), format(max(known), form)
    return low if low == high else f"{low} to {high}"


def picture(name: str) -> str:
    """A picture in the page, in the page's colours."""
    image = f"images/charts/{name}"
    return (
        f'<picture><source media="(prefers-color-scheme: dark)" srcset="{image}-dark.png">'
        f'<img alt="{name}" src="{image}.png"></picture>'
    )


def table(header: str, rows: Iterable[Iterable[str]]) -> list[str]:
    """The lines of a table in Markdown, of titles with bars between them, and rows of cells."""
    lines = [f"| {' | '.join(cells)} |" for cells in rows]
    return [f"| {header} |", "|" + "---|" * (header.count("|") + 1), *lines]


def section(
    title: str, command: str, report: dict[str, Any], table: str, note: str = ""
) -> list[str]:
    """Title, the command and the machine that made the table, and the table."""
    return [f"## {title}\n", f"`{command}`; {machine_line(report)}.{note}\n", f"{table}\n"]


def heading_anchor(title: str) -> str:
    """How a heading is linked to."""
    return re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-")
