"""Draws the package: each module by its lines, each folder (a room), and the imports between rooms.

python benchmarks/house.py [--out FILE]        # docs/house.svg by default
"""

from __future__ import annotations

import argparse
import ast
from collections import Counter
from pathlib import Path

import checkout  # noqa: F401
import matplotlib.pyplot as plt
from matplotlib.patches import FancyArrowPatch, Rectangle

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = "leco_plugin"
OUT = ROOT / "docs" / "house.svg"
LINES_AN_INCH = 900.0
GROUND = ("space", "occupancy", "log", "entries")
"""Files beside the rooms that others stand on; the rest of them are commands and methods."""
STYLE = {"svg.hashsalt": PACKAGE}
"""Makes the identifiers in the file the same in every drawing."""
WIDTH, GAP = 1.75, 0.75
"""Of a room, and between two columns, inches."""


def modules(root: Path = ROOT) -> dict[str, Path]:
    """All modules of the package by dotted name."""
    found = {}
    for path in sorted((root / PACKAGE).rglob("*.py")):
        parts = path.relative_to(root).with_suffix("").parts
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

    Rooms stand in columns, from those that import nothing to the entrance. An arrow leads from the
    importing room to the imported one.
    """
    known = modules()
    lines = {name: len(path.read_text().splitlines()) for name, path in known.items()}
    edges: Counter[tuple[str, str]] = Counter()
    for name, path in known.items():
        for other in imports(path, known):
            if room_of(name) != room_of(other):
                edges[room_of(name), room_of(other)] += 1
    rooms = {room_of(name) for name in known}
    depth = depths(edges, rooms)
    columns: dict[int, list[str]] = {}
    for room in sorted(rooms):
        columns.setdefault(depth[room], []).append(room)
    figure, axes = plt.subplots()
    lowest = 0.0
    places: dict[str, tuple[float, float]] = {}
    for column, (_, inside) in enumerate(sorted(columns.items())):
        x, y = column * (WIDTH + GAP), 0.0
        for room in inside:
            names = sorted((n for n in known if room_of(n) == room), key=lambda n: -lines[n])
            height = 0.32 + sum(max(lines[n] / LINES_AN_INCH, 0.045) for n in names)
            axes.add_patch(Rectangle((x, y - height), WIDTH, height, fc="#f4f1ea", ec="#555555"))
            total = sum(lines[n] for n in names)
            axes.text(x + 0.05, y - 0.11, room, fontsize=9, weight="bold", va="center")
            counts = f"{len(names)} files, {total:,} lines"
            axes.text(x + 0.05, y - 0.23, counts, fontsize=6.5, va="center")
            top = y - 0.3
            for name in names:
                size = max(lines[name] / LINES_AN_INCH, 0.045)
                box = Rectangle((x + 0.06, top - size), WIDTH - 0.12, size)
                box.set(fc="#c9d8e8", ec="white", lw=0.5)
                axes.add_patch(box)
                if size > 0.11:
                    short = name.rsplit(".", 1)[-1]
                    axes.text(x + 0.1, top - size / 2, short, fontsize=7, va="center")
                top -= size
            places[room] = (x, y - height / 2)
            lowest = min(lowest, y - height)
            y -= height + 0.35
    for (user, used), count in sorted(edges.items()):
        (x, y), (to_x, to_y) = places[user], places[used]
        against = depth[user] <= depth[used]
        start, end = (x, y), (to_x + WIDTH, to_y)
        arrow = FancyArrowPatch(
            start,
            end,
            arrowstyle="-|>",
            mutation_scale=7,
            connectionstyle="arc3,rad=0.08",
            lw=0.4 + 0.12 * count**0.5,
            color="#c0392b" if against else "#888888",
            alpha=0.9 if against else 0.45,
        )
        axes.add_patch(arrow)
    right = len(columns) * (WIDTH + GAP)
    axes.set(xlim=(-GAP / 2, right - GAP / 2), ylim=(lowest - 0.1, 0.5))  # inches, as all above
    figure.set_size_inches(right, 0.6 - lowest)
    figure.subplots_adjust(0.0, 0.0, 1.0, 1.0)
    axes.set_axis_off()
    said = f"{len(known)} modules, {sum(lines.values()):,} lines; red: imports against the flow"
    axes.set_title(said, fontsize=14)
    with plt.rc_context(STYLE):
        figure.savefig(out, bbox_inches="tight", metadata={"Date": None})
    plt.close(figure)


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
