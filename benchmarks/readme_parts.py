"""What the README shows of stored results: the demo, and ours beside its rivals on each scene."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import checkout  # noqa: F401
from chart_sections import by_scene, notes
from page_parts import RESULTS, between, size, table

from leco_plugin.chart.findings.representations import Representation, representations_of
from leco_plugin.chart.findings.summary import Line, ahead, lines_of

DEMO = "<!-- demo table: generated -->", "<!-- end of the demo table -->"
OURS = "kept, less is better: `leco-occupancy`"
SMALL, OTHER_GATE, GRID = "small MLP of ours", "best other gate", "best grid"
RIVALS = "<!-- rivals: generated -->", "<!-- end of the rivals -->"


def readme(text: str) -> str:
    """The README with its tables renewed."""
    text = between(text, DEMO, demo_table(json.loads((RESULTS / "demo.json").read_text())))
    return between(text, RIVALS, rivals_table())


def demo_table(report: dict[str, Any]) -> str:
    """The two runs of a demo, side by side."""
    lines = table(
        "run | PSNR | SSIM | steps | samples a ray | seconds to render an image",
        [
            [
                *(run["method"], f"{run['psnr']:.2f} dB", f"{run['ssim']:.3f}", str(run["steps"])),
                *(f"{run['samples_per_ray']:.1f}", f"{run['render_seconds_per_image']:.2f}"),
            ]
            for run in report["runs"]
        ],
    )
    facts = report["occupancy"]
    lines += [
        "",
        f"Occupancy: {facts['bytes'] / 1000:.0f} kB, learned and frozen in "
        f"{report['runs'][0]['freeze_seconds']:.0f} of "
        f"{report['runs'][0]['train_seconds']:.0f} s; {facts['empty_fraction']:.1%} of all "
        f"candidates skipped for {facts['image_price_db']:+.3f} dB and "
        f"{facts['lost_surface_mass']:.1e} of the surface mass on held-out rays. Against the exact "
        f"city: {facts['kept_surface_recall']:.1%} of the visible surface kept, "
        f"{facts['free_space_skipped']:.1%} of free space skipped.",
    ]
    return "\n".join(lines)


def rivals_table() -> str:
    """A row for each scene of which both suites are stored: what must be sampled, and accuracy
    after equal time, with the least and the most of all seeds."""
    space, times = by_scene("representations"), by_scene("enough-time")
    scenes = sorted(space.keys() & times.keys())
    best = {scene: _grouped(representations_of(lines_of(space[scene][1]))) for scene in scenes}
    rows = {
        _marked(scene, [space[scene][0], times[scene][0]]): {
            **_kept(best[scene]),
            **_reached(times[scene][1]),
        }
        for scene in scenes
    }
    if not rows:
        return "Not measured yet."
    columns = list(dict.fromkeys(column for row in rows.values() for column in row))
    cells = [[scene, *(row.get(name, "-") for name in columns)] for scene, row in rows.items()]
    lines = table(f"scene | {' | '.join(columns)}", cells)
    timed = [lines_of(times[scene][1]) for scene in scenes]
    return "\n".join([*lines, "", _standing(list(best.values()), timed)])


def _standing(best: Sequence[dict[str, Representation]], timed: Sequence[list[Line]]) -> str:
    """On how many scenes ours is ahead of its rivals, in a sentence."""
    many = len(timed)
    gates, grids = (sum(_less(of, OURS, one) for of in best) for one in (OTHER_GATE, GRID))
    small = sum(_less(of, SMALL, GRID) for of in best)
    ours = [next((line for line in lines if line.learned), None) for lines in timed]
    ahead_of_all = sum(
        one is not None and all(ahead(one, other) for other in lines if other is not one)
        for one, lines in zip(ours, timed)
    )
    return (
        f"Of {many} scenes, `leco-occupancy` keeps less than the best other gate on {gates} and "
        f"less than the best grid on {grids}, a small MLP less than the best grid on {small}; a "
        f"learned occupancy has the highest PSNR with every seed on {ahead_of_all}."
    )


def _less(best: dict[str, Representation], one: str, rival: str) -> bool:
    return one in best and rival in best and best[one].kept < best[rival].kept


def _marked(scene: str, charts: list[str]) -> str:
    """A scene, marked where one of its charts was made before a mend."""
    return f"{scene} (*)" if notes().keys() & set(charts) else scene


def _grouped(held: list[Representation]) -> dict[str, Representation]:
    """Each of ours, and those that keep least of the grids and of the other gates."""
    groups = {
        OURS: [one for one in held if one.ours and one.kind is None],
        SMALL: [one for one in held if one.ours and one.kind is not None],
        OTHER_GATE: [one for one in held if not one.ours and not one.is_grid],
        GRID: [one for one in held if one.is_grid],
    }
    return {title: min(some, key=lambda one: one.kept) for title, some in groups.items() if some}


def _kept(best: dict[str, Representation]) -> dict[str, str]:
    """What they keep, and their sizes."""
    return {
        title: f"{one.kept:.1f}%, {size(one.median('size'))}"
        + ("" if one.ours else f" ({one.name.removeprefix('grid ')})")
        for title, one in best.items()
    }


def _reached(results: dict[str, Any]) -> dict[str, str]:
    """PSNR of each contender at the end."""
    seconds = results["protocol"]["seconds"]
    return {
        f"PSNR after {seconds:g} s: {line.name.split(' + ')[-1]}": (
            f"{line.psnr:.1f} ({min(line.psnrs):.1f} to {max(line.psnrs):.1f})"
        )
        for line in lines_of(results)
    }
