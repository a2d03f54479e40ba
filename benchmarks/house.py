"""Draws the package: its folders (rooms) by their lines, and how many imports lead between them.

python benchmarks/house.py [--out FILE]        # docs/house.svg by default
"""

from __future__ import annotations

import argparse
import ast
from collections import Counter
from pathlib import Path
from typing import Any

import checkout  # noqa: F401
import matplotlib.pyplot as plt
from matplotlib.patches import Rectangle

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = "leco_plugin"
OUT = ROOT / "docs" / "house.svg"
GROUND = ("space", "occupancy", "log", "names", "on_cpu")
"""Files beside the rooms that others stand on; the rest of them are commands and methods."""
STYLE = {"svg.hashsalt": PACKAGE}
"""Makes the identifiers in the file the same in every drawing."""
CELL, NAMES, HEAD, MARGIN = 0.46, 3.1, 1.75, 0.6
"""Inches: side of a square, width of the names beside them, height of what stands above, and what
the last name takes on the right."""


def modules() -> dict[str, Path]:
    """All modules of the package by dotted name."""
    found = {}
    for path in sorted((ROOT / PACKAGE).rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def imports(path: Path, known: dict[str, Path]) -> set[str]:
    """Modules of the package that a module imports when it is imported itself."""
    found: set[str] = set()

    def walk(body: list[ast.stmt]) -> None:
        for node in body:
            if isinstance(node, ast.If) and getattr(node.test, "id", "") == "TYPE_CHECKING":
                continue
            if isinstance(node, ast.ImportFrom) and node.module:
                names = [f"{node.module}.{alias.name}" for alias in node.names]
                found.update(name if name in known else node.module for name in names)
            elif isinstance(node, ast.Import):
                found.update(alias.name for alias in node.names)
            elif not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                for part in ("body", "orelse", "finalbody"):
                    walk(getattr(node, part, []))

    walk(ast.parse(path.read_text()).body)
    return found & known.keys()


def room_of(name: str) -> str:
    """The folder of a module below the package; its own files are the entrance."""
    parts = name.split(".")
    if len(parts) > 2:
        return parts[1]
    rooms = {path.name for path in (ROOT / PACKAGE).iterdir() if path.is_dir()}
    if parts[-1] in rooms:
        return parts[-1]
    return "ground" if parts[-1] in GROUND else "entrance"


def depths(edges: Counter[tuple[str, str]], rooms: set[str]) -> dict[str, int]:
    """How far each room is from those that import nothing; fewer imports against the flow win."""
    order: list[str] = []
    left = set(rooms)
    while left:  # the room that imports least of what is left goes first

        def wanted(room: str) -> int:
            return sum(edges[room, other] for other in left if other != room)

        order.append(min(sorted(left), key=wanted))
        left.remove(order[-1])
    depth: dict[str, int] = {}
    for room in order:
        below = [depth[other] for other in depth if edges[room, other]]
        depth[room] = 1 + max(below, default=-1)
    return depth


def draw(out: Path = OUT) -> None:
    """Writes the picture as SVG; the same package gives the same bytes.

    A row is a room that imports, a column one that is imported, a number the imports between their
    files. Both have one order, so that imports against the flow lie above the diagonal.
    """
    known = modules()
    lines = {name: len(path.read_text().splitlines()) for name, path in known.items()}
    edges: Counter[tuple[str, str]] = Counter()
    for name, path in known.items():
        for other in imports(path, known):
            if room_of(name) != room_of(other):
                edges[room_of(name), room_of(other)] += 1
    inside: dict[str, list[str]] = {}
    for name in known:
        inside.setdefault(room_of(name), []).append(name)
    depth = depths(edges, set(inside))
    rooms = sorted(inside, key=lambda room: (depth[room], room))
    side = CELL * len(rooms)
    figure, axes = plt.subplots(figsize=(NAMES + side + MARGIN, HEAD + side))
    figure.subplots_adjust(0.0, 0.0, 1.0, 1.0)
    axes.set(xlim=(-NAMES, side + MARGIN), ylim=(side, -HEAD))  # inches, as all below
    axes.set_axis_off()
    for row, room in enumerate(rooms):
        middle = CELL * (row + 0.5)
        axes.text(-NAMES + 0.1, middle, room, fontsize=12, weight="bold", va="center")
        total = sum(lines[name] for name in inside[room])
        counts = f"{len(inside[room])} files, {total:,} lines"
        axes.text(-0.12, middle, counts, fontsize=10, ha="right", va="center")
        axes.text(middle, -0.1, room, fontsize=12, rotation=55, va="bottom")
        for column, other in enumerate(rooms):
            _draw_cell(axes, row, column, edges[room, other], depth[room] <= depth[other])
    down = sum(count for (user, used), count in edges.items() if depth[used] < depth[user])
    said = f"{down / sum(edges.values()):.0%} of imports between rooms go one way"
    axes.text(-NAMES + 0.1, 0.3 - HEAD, said, fontsize=16, weight="bold", va="center")
    below = f"{len(known)} modules, {sum(lines.values()):,} lines; a row imports from the columns"
    axes.text(-NAMES + 0.1, 0.65 - HEAD, below, fontsize=11, va="center")
    with plt.rc_context(STYLE):
        figure.savefig(out, metadata={"Date": None})
    plt.close(figure)


def _draw_cell(axes: Any, row: int, column: int, count: int, against: bool) -> None:
    """One number in its square: red where rooms import against the flow."""
    ground = "#c9ccd1" if row == column else "#f3f4f6"
    if count:
        ground = "#f3c1ba" if against else "#c4d9ef"
    corner = (CELL * column + 0.02, CELL * row + 0.02)
    axes.add_patch(Rectangle(corner, CELL - 0.04, CELL - 0.04, fc=ground, ec="none"))
    middle = (CELL * (column + 0.5), CELL * (row + 0.5))
    axes.text(*middle, str(count or ""), fontsize=11, ha="center", va="center")


def main(args: list[str] | None = None) -> None:
    """Draws the picture to `--out`."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--out", type=Path, default=OUT, help="an SVG file (default: %(default)s)")
    out = parser.parse_args(args).out
    if out.suffix != ".svg":
        parser.error(f"--out {out}: the name must end in .svg")
    draw(out)
    print(f"wrote {out}")


if __name__ == "__main__":
    main()
