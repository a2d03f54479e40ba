"""Tables of what shows how much a scene needs: automatic sizes, shrunk gates, capacity."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from typing import Any

from page_parts import table
from sizes_figures import MAY_LOSE, bars, verdict

from leco_plugin.capacity.choice import (
    TOLD_APART,
    USUAL_GRID,
    choose,
    grid_that_nearly_suffices,
    grid_that_suffices,
    kilobytes,
    smallest_grid,
)

Report = Mapping[str, Any]

SHRUNK_BYTES, SHRUNK_LOSS, SHRUNK_SPEEDUP = 32_000, 1e-3, 3.0
"""Bars of a shrunk gate: bytes of its file and declared loss at most, queries at least so much
faster."""
FINE_GRID, SHARE_OF_ITS_BYTES = 256, 1 / 100
"""Cells along an axis of the finest grid beside which gates are put, and how many of its bytes they
may take."""


def sizes_table(report: Report) -> str:
    """Sizes that were chosen, the sweep, automatic beside its best, and the bars of two cities."""
    lines = [
        "| scene | photographs | texels | table | experts | parameters | of the device's |",
        "|---|---|---|---|---|---|---|",
    ]
    for scene in report["scenes"]:
        sizes, share = scene["sizes"], scene["parameters"] / scene["device_parameters"]
        lines.append(
            f"| {scene['scene']} | {scene['images']} | {scene['texels']:,} "
            f"| {sizes['field.encoding.levels']} x 2^{sizes['field.encoding.log2_table']} "
            f"| {sizes['field.experts.scene_experts']} | {scene['parameters']:,} | {share:.0%} |"
        )
    lines += [
        "",
        "| scene | sizes | parameters | seeds | PSNR, mean (least to most) |",
        "|---|---|---|---|---|",
    ]
    points: dict[tuple[str, str], list[Report]] = {}
    for row in report["runs"]:
        if row["point"] is not None:
            points.setdefault((row["scene"], row["point"]), []).append(row)
    for (scene, point), runs in sorted(points.items(), key=lambda item: item[0][0]):
        values = [run["psnr"] for run in runs]
        lines.append(
            f"| {scene} | {point} | {runs[0]['parameters']:,} | {len(runs)} "
            f"| {statistics.fmean(values):.2f} dB ({min(values):.2f} to {max(values):.2f}) |"
        )
    lines += [
        "",
        "| scene | seeds | automatic | best of the sweep | behind it by (95% interval) "
        "| within bounds |",
        "|" + "---|" * 6,
    ]
    for scene, found in verdict(report["runs"]).items():
        lines.append(
            f"| {scene} | {found['seeds']} | {found['psnr']:.2f} dB, {found['parameters']:,} "
            f"| {found['best']}: {found['best_psnr']:.2f} dB, {found['best_parameters']:,} "
            f"| {_with_margin(found['behind'], found['margin'])} dB "
            f"| {_told_apart(found, found['behind'] - MAY_LOSE)} |"
        )
    measured = bars(report["scenes"], report["runs"])
    if measured:
        lines += ["", "| figure | measured (95% interval) | at most | reached |"]
        lines.append("|---|---|---|---|")
    for bar in measured:
        value = _with_margin(bar["value"], bar["margin"])
        reached = _told_apart(bar, bar["value"] - bar["bar"])
        lines.append(f"| {bar['name']} | {value} | {bar['bar']:g} | {reached} |")
    return "\n".join(lines)


def shrink_table(reports: Mapping[str, Report]) -> str:
    """A row a scene: what a gate was shrunk to, what it declares, and how fast it answers.

    Args:
        reports: as `leco shrink --json` writes them, by the name of the scene.
    """
    rows = []
    for scene, report in reports.items():
        before, after = report["from"], report["to"]
        declared = after.get("lost_surface_mass")
        verified = after.get("verified_lost_surface_mass", declared)
        checked = report.get("checked") or {}
        lost = checked.get("lost_surface_mass")
        size, speed = after["bytes"], report["query_speedup"]
        now = _flagged(f"{size / 1000:.1f}", size <= SHRUNK_BYTES)
        price, skipped = after.get("image_price_db"), after.get("empty_fraction")
        cells = (
            _lowered(report["lowered"]),
            f"{before['params']} to {after['params']}",
            f"{before['bytes'] / 1000:.1f} to {now}",
            "-" if skipped is None else f"{100 * skipped:.1f}",
            "-" if declared is None else _flagged(f"{declared:.2e}", declared <= SHRUNK_LOSS),
            "-" if lost is None else _flagged(f"{lost:.2e}", lost <= (verified or 0.0)),
            "-" if price is None else f"{price:+.3f}",
            f"{len(report['rungs'])}",
            _flagged(f"{speed:.2f} x", speed >= SHRUNK_SPEEDUP),
        )
        rows.append((scene, *cells))
    header = (
        "scene | original lowered | values | file, kB | skipped, % | declared lost surface mass "
        "| lost on test photographs | image price, dB | gates tried | queries faster by"
    )
    return "\n".join(table(header, rows))


def _lowered(facts: Report | None) -> str:
    """How much more of the volume an original keeps at the threshold that smaller gates follow."""
    if facts is None:
        return "no"
    return f"{facts['from']:.2f} to {facts['to']:.2f}, keeps {facts['kept_volume']:.2f} x"


def samples_table(rows: Mapping[str, Report]) -> str:
    """A row a scene: what becomes of the candidates along a ray, and what rendering from the front
    saves.

    Args:
        rows: as `samples.py` stores them, by the name of the scene.
    """
    counts = ("candidates", "coarse", "formed", "gate", "kept", "shaded_from_the_front")
    cells = [
        (
            scene,
            *(f"{row[name]:.1f}" for name in counts),
            f"{row['psnr']:.3f} dB",
            f"{row['psnr_from_the_front']:.3f} dB",
            f"{row['time_from_the_front']:.2f} x",
        )
        for scene, row in rows.items()
    ]
    header = (
        "scene | candidates a ray | coarse questions | looked up in cells | left to the gate "
        "| kept | shaded, from the front | PSNR, all of them shaded | from the front | time of that"
    )
    return "\n".join(table(header, cells))


def capacity_table(reports: Mapping[str, Report]) -> str:
    """A row a scene: what was chosen, and the fine grid beside the best gate of few bytes.

    Args:
        reports: as `leco capacity` writes them, by the name of the scene.
    """
    cells = []
    for scene, report in reports.items():
        rows = report["representations"]
        chosen = choose(rows)
        grid, gate = beside_fine_grid(rows)
        figures = (
            f"{report['scene']['train_images']}",
            f"{chosen['family']} {chosen['size']}",
            f"{chosen['bytes'] / 1000:.1f}",
            f"{100 * chosen['kept_volume']:.2f}",
            _smallest_grid(rows, chosen),
        )
        cells.append((scene, *figures, *_beside(grid, gate)))
    header = (
        "scene | photographs | chosen | kB | keeps, % | smallest grid that keeps as little "
        f"| best grid up to {FINE_GRID}^3 keeps, % | gate of 1/100 of the bytes of {FINE_GRID}^3 "
        "keeps, % | no more"
    )
    return "\n".join([*table(header, cells), "", where_it_pays(reports)])


def where_it_pays(reports: Mapping[str, Report]) -> str:
    """For which scenes a taught grid suffices, may suffice, and keeps more than a gate."""
    grids: list[str] = []
    open_: list[str] = []
    gates: list[str] = []
    for scene, report in reports.items():
        rows = report["representations"]
        if grid_that_suffices(rows) is not None:
            grids.append(scene)
        elif grid_that_nearly_suffices(rows) is not None:
            open_.append(scene)
        else:
            gates.append(scene)
    grid, nearly, gate = (", ".join(names) or "none" for names in (grids, open_, gates))
    return (
        f"If the lesson that teaches a gate fills it, a grid of {USUAL_GRID}^3 cells or fewer "
        f"keeps as little as the gate that is chosen, for: {grid}. It keeps more, but less than "
        f"{TOLD_APART:g} times as much, which one field does not tell apart, for: {nearly}. The "
        f"gate keeps less for: {gate}. No host fills its own grid by that lesson."
    )


def beside_fine_grid(rows: Sequence[Report]) -> tuple[Report | None, Report | None]:
    """Of the grids up to the fine one the one that keeps least, and the same of the gates that take
    a hundredth of the fine one's bytes.

    Both are None where that was not measured.
    """
    sizes = {int(row["size"]): row for row in rows if row["family"] == "grid"}
    if FINE_GRID not in sizes:
        return None, None
    most = SHARE_OF_ITS_BYTES * sizes[FINE_GRID]["bytes"]
    grids = [row for size, row in sizes.items() if size <= FINE_GRID]
    gates = [row for row in rows if row["family"] != "grid" and row["bytes"] <= most]
    best = min(grids, key=lambda row: row["kept_volume"])
    return best, min(gates, key=lambda row: row["kept_volume"], default=None)


def _beside(grid: Report | None, gate: Report | None) -> tuple[str, str, str]:
    if grid is None or gate is None:
        return ("-",) * 3
    fine, few = (f"{100 * row['kept_volume']:.2f}" for row in (grid, gate))
    no_more = gate["kept_volume"] <= grid["kept_volume"]
    return (
        f"{fine} ({grid['size']}^3)",
        f"{few} ({gate['family']}, {gate['bytes'] / 1000:.1f} kB)",
        _yes(no_more),
    )


def _smallest_grid(rows: Sequence[Report], chosen: Report) -> str:
    grid = smallest_grid(rows, chosen)
    return "none" if grid is None else f"{grid['size']}^3, {kilobytes(grid)}"


def _with_margin(value: float, margin: float | None) -> str:
    return f"{value:.2f}" if margin is None else f"{value:.2f} ± {margin:.2f}"


def _yes(reached: bool) -> str:
    return "yes" if reached else "**no**"


def _told_apart(found: Report, beyond: float) -> str:
    """Whether a bar is reached, and whether its interval leaves that open or is not known.

    Args:
        found: `reached`, the `margin` of a figure, and of how many `seeds` it is.
        beyond: how far it lies above its bar.
    """
    said, margin = _yes(found["reached"]), found["margin"]
    if found["seeds"] == 1:
        return f"{said}, one seed"
    return f"{said}, within the interval" if margin and abs(beyond) < margin else said


def _flagged(value: str, reached: bool) -> str:
    """A figure with a bar; those that miss it stand out."""
    return value if reached else f"**{value}**"
