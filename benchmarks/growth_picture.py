"""How gates and grids grow with a city, of the cities that `leco capacity` has measured."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import checkout  # noqa: F401
from page_parts import span, table
from sizes_tables import chosen_of

from leco_plugin.capacity.choice import Row, kilobytes, stored_bytes
from leco_plugin.chart.theme import (
    LIGHT,
    Theme,
    log_axis,
    new_figure,
    plain,
    save_picture,
    style,
    themed,
)
from leco_plugin.scenes.city.city import CityConfig
from leco_plugin.scenes.city.plan import choose_blocks

Reports = Mapping[str, Any]
"""Results of `leco capacity`, by the name of their scene."""
CITY = "city-"
"""How names of cities begin; the blocks a side follow."""
LINES = ("gate", "grid with the same lesson")


class Grown(NamedTuple):
    """A city with what occupies it."""

    blocks: int
    name: str
    """Of its report."""
    area: float
    """Built, square metres."""
    photographs: int
    gate: Row
    grid: Row
    """Chosen among grids, as octrees, as the gate is among gates: by bytes and volume kept."""

    @property
    def times(self) -> float:
        """How many times the gate's volume the grid keeps."""
        return float(self.grid["kept_volume"] / self.gate["kept_volume"])


def built_area(blocks: int) -> float:
    """Of the city with so many blocks a side, square metres. The city itself is not built."""
    config = CityConfig(blocks)
    return float(choose_blocks(blocks, config.seed).sum()) * config.block_size**2


def cities(reports: Reports) -> list[Grown]:
    """The cities among the reports, from small to large."""
    found = []
    for name, report in reports.items():
        blocks = name.removeprefix(CITY)
        if name == blocks or not blocks.isdigit():
            continue
        gate, grid = chosen_of(report)
        area, images = built_area(int(blocks)), report["scene"]["train_images"]
        found.append(Grown(int(blocks), name, area, images, gate, grid))
    return sorted(found)


def growth_table(reports: Reports) -> str:
    """A row a city, and the finding below."""
    grown = cities(reports)
    cells = [
        (
            f"{one.blocks}",
            f"{one.area:,.0f}",
            f"{one.photographs}",
            f"{one.gate['family']} {one.gate['size']}",
            f"{one.gate['bytes'] / 1000:.1f}",
            f"{one.gate['kept_volume']:.2%}",
            f"{one.grid['size']}^3",
            f"{one.grid['bytes'] / 1000:,.1f}",
            kilobytes(one.grid),
            f"{one.grid['kept_volume']:.2%}",
            f"{one.times:.1f}",
        )
        for one in grown
    ]
    header = (
        "blocks a side | built, m2 | photographs | gate | kB | keeps | grid | kB, a bit a cell "
        "| as an octree | keeps | times the gate's"
    )
    return "\n".join([*table(header, cells), "", finding(grown)])


def finding(grown: Sequence[Grown]) -> str:
    """What the cities show, in two sentences."""
    first, last = grown[0], grown[-1]
    kept = f"{span([100 * one.gate['kept_volume'] for one in grown])}% of the volume"
    times = f"{span([one.times for one in grown])} times as much"
    gates, octrees = (
        [stored_bytes(row) / 1000 for row in rows]
        for rows in zip(*((one.gate, one.grid) for one in grown))
    )
    sizes = {"the gate": gates, "the grid": octrees}
    rising = [name for name, its in sizes.items() if its == sorted({*its})]
    grows = f"The bytes of {' and '.join(rising)} grow with the area."
    return (
        f"From {first.blocks} to {last.blocks} blocks a side the gate takes "
        f"{span(gates)} kB and keeps {kept}. A grid with "
        f"the same lesson, chosen by the same rule, takes {span(octrees)} kB as an octree and "
        f"keeps {times}. {grows if rising else 'Neither follows the area.'}"
    )


def headline(grown: Sequence[Grown]) -> str:
    """The finding in ten words at most."""
    return f"An octree keeps {span([one.times for one in grown])} times a gate's volume"


def draw(path: Path, reports: Reports, theme: Theme = LIGHT) -> Path:
    """Volume kept and bytes of gate and grid, against the built area.

    Args:
        path: of the picture.
        reports: two cities among them at least.
        theme: of the page it is meant for.
    """
    grown = cities(reports)
    areas = [one.area / 1e4 for one in grown]
    pairs = [(one.gate, one.grid) for one in grown]
    panels = (
        ("volume kept, %", [[100 * row["kept_volume"] for row in pair] for pair in pairs]),
        ("kB, grids as octrees", [[stored_bytes(row) / 1000 for row in pair] for pair in pairs]),
    )
    with themed(theme, 11.5):
        figure = new_figure((10.0, 4.6), theme.page)
        figure.text(0.02, 0.965, headline(grown), va="top", fontsize=15, fontweight="bold")
        for number, (label, values) in enumerate(panels):
            axes: Any = figure.add_axes((0.075 + 0.5 * number, 0.14, 0.4, 0.64))
            for line, name in enumerate(LINES):
                heights = [pair[line] for pair in values]
                axes.plot(areas, heights, label=name, markersize=8, **style(line, theme))
            axes.set(xscale="log", yscale="log", xlabel="built area, hectares")
            axes.set_title(label, fontsize=12, loc="left")
            log_axis(axes, "x", (1.0,))
            log_axis(axes, "y", (1.0, 2.0, 5.0) if number == 0 else (1.0,))
            plain(axes, theme)
        handles, labels = axes.get_legend_handles_labels()
        figure.legend(
            handles, labels, loc="upper left", ncols=2, frameon=False, bbox_to_anchor=(0.01, 0.91)
        )
        return save_picture(figure, path, dict(reports), dpi=140)
