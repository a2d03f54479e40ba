"""What new views lose beside what is promised: `python benchmarks/promises.py RUN=SCENE ...`.

Of runs of `leco-occupancy` in which photographs vouched for the occupancy. Both are of the field at
freezing, which photographs that vouch had taught nothing. Each test photograph is rendered densely;
what its occupancy skips near surfaces is what it loses. Stored in `results/promises.json`.
"""

from __future__ import annotations

import statistics
from pathlib import Path
from typing import Any

import checkout  # noqa: F401
import torch
from measured_runs import main
from page_parts import machine_line, made_line, table

from leco_plugin.capacity.sources import draw_test_rays, find_source
from leco_plugin.cli_occupancy import occupancy_of
from leco_plugin.learning.dense import dense_reference, in_chunks
from leco_plugin.log import by_number, counted
from leco_plugin.models.rendering import mapped_middles
from leco_plugin.occupancy import CAMERAS_THAT_VOUCH
from leco_plugin.scenes.pixels.held_out_pixels import SOME

RAYS = 2048
"""Of each test photograph."""
CITIES = (
    "`city-5` is of `leco city --aerial-only --blocks 5 --seed 1`, `city-streets` of `--blocks 3 "
    "--seed 2`, `city-sky` of `--aerial-only --blocks 4 --seed 3 --sky --far-terrain`"
)
"""Those that no other page names."""


@torch.no_grad()
def row_of(run: Path, data: Path) -> dict[str, Any]:
    """What each test photograph of a run loses: by the gate, and because no training ray comes
    near."""
    source = find_source(occupancy_of(run), data)
    mixture = source.frozen
    assert mixture is not None
    promised = mixture.report.get(CAMERAS_THAT_VOUCH)
    if not promised:
        raise SystemExit(f"no photograph vouched for the occupancy of {run}")
    occupancy, dataset = mixture.occupancy().eval(), source.manager.eval_dataset
    tests = draw_test_rays(source, occupancy, RAYS * min(SOME, len(dataset)))
    assert tests is not None
    rows = []
    for rays in in_chunks(tests.rays, RAYS):
        reference = dense_reference(mixture, rays)
        surface = reference.surface_weights.double()
        mapped = mapped_middles(mixture.region.space, rays, reference.intervals)
        by_gate = reference.skipped(float(mixture.threshold))
        unseen = ~occupancy.seen(mapped.clamp(-1.0, 1.0)) & ~reference.always_kept
        whole = max(float(surface.sum()), 1e-12)
        rows.append([float((surface * lost).sum()) / whole for lost in (by_gate, by_gate | unseen)])
    lost_to_gate, lost = (list(column) for column in zip(*rows))
    return {"promised": promised, "lost_to_gate": lost_to_gate, "lost": lost}


def promises_section(report: dict[str, Any]) -> list[str]:
    """The stored figures as a part of `docs/measurements.md`."""
    rows = [
        [
            scene,
            f"{found['promised']['bound']:.2%}",
            f"{found['promised']['confidence']:.0%}",
            f"{beyond(found)} of {len(found['lost'])}",
            f"{statistics.median(found['lost']):.2%}",
            f"{max(found['lost']):.2%}",
        ]
        for scene, found in report["scenes"].items()
    ]
    unseen = max(
        lost - to_gate
        for found in report["scenes"].values()
        for lost, to_gate in zip(found["lost"], found["lost_to_gate"], strict=True)
    )
    return [
        "## What new views lose, and what is promised\n",
        "`python benchmarks/promises.py RUN=SCENE ...`, of runs of `ns-train leco-occupancy "
        f"--max-num-iterations 700`; {machine_line(report)}. "
        f"Rows {made_line(report['scenes'].values())}.\n",
        f"{kept_promises(report)}. Shares are of the weight near surfaces, by the field at "
        f"freezing, {RAYS:,} rays of each. What lies where no training ray comes near is lost too; "
        f"it adds {unseen:.1%} at most. More cities: {CITIES}.\n",
        *table(
            "scene | promised: a new view loses at most | with a confidence of | beyond it | "
            "lost, median | lost, worst",
            rows,
        ),
        "",
    ]


def kept_promises(report: dict[str, Any]) -> str:
    """Of how many photographs a promise was broken, as the beginning of a sentence."""
    scenes = report["scenes"].values()
    broken = sum(map(beyond, scenes))
    lose = by_number(broken, "loses more of its", "lose more of their")
    photographs = counted(sum(len(found["lost"]) for found in scenes), "test photograph")
    where = counted(len(scenes), "scene")
    return f"Of {photographs} on {where} {broken} {lose} surfaces than was promised"


def beyond(found: dict[str, Any]) -> int:
    """How many photographs of a scene lose more than the bound."""
    return sum(one > found["promised"]["bound"] for one in found["lost"])


if __name__ == "__main__":
    main(row_of, "promises")
