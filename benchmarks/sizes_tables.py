"""Tables of what shows how much a scene needs: automatic sizes, shrunk gates, capacity."""

from __future__ import annotations

import statistics
from collections.abc import Mapping
from typing import Any

from page_parts import span, table
from sizes_figures import MAY_HAVE, MAY_LOSE, bars, verdict

from leco_plugin.capacity.choice import best_gate, choose, kilobytes, stored_bytes

Report = Mapping[str, Any]

SHRUNK_BYTES, SHRUNK_LOSS, SHRUNK_SPEEDUP = 32_000, 1e-3, 3.0
"""Bars of a shrunk gate: bytes of its file and declared loss at most, queries at least so much
faster."""


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
            f"| {_within_bounds(found)} |"
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
    """A row a scene: gate and grid with the same lesson, each chosen among its like, and which of
    the two pays more.

    Args:
        reports: as `leco capacity` writes them, by the name of the scene.
    """
    cells = []
    for scene, report in reports.items():
        gate, grid = chosen_of(report)
        cells.append(
            (
                scene,
                f"{report['scene']['train_images']}",
                f"{gate['family']} {gate['size']}",
                kilobytes(gate),
                f"{gate['kept_volume']:.2%}",
                f"{grid['size']}^3",
                f"{grid['bytes'] / 1000:,.1f} kB",
                kilobytes(grid),
                f"{grid['kept_volume']:.2%}",
                "grid" if choose((gate, grid)) is grid else "gate",
            )
        )
    header = (
        "scene | photographs | gate | takes | keeps | grid, taught alike | a bit a cell "
        "| as an octree | keeps | pays more"
    )
    return "\n".join([*table(header, cells), "", where_it_pays(reports)])


def chosen_of(report: Report) -> tuple[Report, Report]:
    """The gate and the grid that pay most, of a report with both."""
    rows = report["representations"]
    gate = best_gate(rows)
    assert gate is not None
    return gate, choose([row for row in rows if row["family"] == "grid"])


def where_it_pays(reports: Mapping[str, Report]) -> str:
    """For which scenes a taught grid pays more than a gate, and for which the other way round."""
    pairs = {scene: chosen_of(report) for scene, report in reports.items()}
    grids = [scene for scene, pair in pairs.items() if choose(pair) is pair[1]]
    gates = [scene for scene in pairs if scene not in grids]
    times = [grid["kept_volume"] / gate["kept_volume"] for gate, grid in pairs.values()]
    ours, octrees = (
        f"{span(stored_bytes(row) / 1000 for row in some)} kB" for some in zip(*pairs.values())
    )
    return (
        f"Taught by the gate's lesson, a grid takes {octrees} as an octree, a gate {ours}, and the "
        f"grid keeps {span(times)} times the gate's volume, where both lose "
        f"0.1% on held-out pixels of training photographs. By size and volume the grid pays more "
        f"for: {', '.join(grids) or 'none'}; the gate for: {', '.join(gates) or 'none'}. No host "
        "fills its own grid by that lesson."
    )


def _with_margin(value: float, margin: float | None) -> str:
    return f"{value:.2f}" if margin is None else f"{value:.2f} ± {margin:.2f}"


def _yes(reached: bool) -> str:
    return "yes" if reached else "**no**"


def _within_bounds(found: Report) -> str:
    """Whether automatic sizes are near the best of a sweep in PSNR and in parameters; of these no
    interval leaves open whether they are too many."""
    if found["parameters"] > MAY_HAVE * found["best_parameters"]:
        return f"{_yes(False)}, too many parameters"
    return _told_apart(found, found["behind"] - MAY_LOSE)


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
