"""What docs/measurements.md says of how much a scene needs, from what is stored."""

from __future__ import annotations

import json
from typing import Any

from chart_sections import notes
from page_parts import RESULTS, made_line, picture, section
from sizes_figures import AS_GOOD, MAY_HAVE, MAY_LOSE
from sizes_tables import capacity_table, samples_table, shrink_table, sizes_table

CAPACITY = "capacity-"
"""How the names of pictures of `leco capacity` begin."""
CITY_STEPS = 800
"""Of the fields of cities; elsewhere as many as the command has by default."""


def sizes_sections() -> list[str]:
    """Of automatic sizes, shrunk gates and capacity, those that are stored."""
    parts = []
    if (sizes := RESULTS / "sizes.json").exists():
        report = json.loads(sizes.read_text())
        steps, learn = report["settings"]["steps"], report["settings"]["learn_steps"]
        note = (
            f" {steps} steps each, {learn} of them learning; PSNR of test pixels. Best is the "
            f"smallest that lies within {AS_GOOD:g} dB of the highest mean. Within bounds: at most "
            f"{MAY_LOSE:g} dB behind it, with at most {MAY_HAVE:g} times its parameters. Runs "
            f"{made_line(report['runs'])}. Experts are by the rule of then, one for 65,536 texels."
        )
        named = [scene["scene"] for scene in report["scenes"] if "blocks" not in scene]
        command = " ".join(["python benchmarks/sizes.py", *named])
        title = "Automatic sizes, and a sweep around them"
        parts += section(title, command, report, sizes_table(report), note)
    stored = scene_results("shrink").items()
    if shrunk := {name: report for name, report in stored if "to" in report}:  # not stopped
        note = (
            " Lowered: an original that itself loses too much is shrunk at a threshold at which it "
            "does not, and keeps so much more of the volume there. In bold: a bar is missed, 32 "
            "kB, a declared loss of 1e-3, three times faster queries (65536 positions, "
            "interleaved); or rays of test photographs, which decided nothing, lost more than "
            "those that verified the gate, and the file declares that. "
            f"Gates {made_line(shrunk.values())}."
        )
        command = (
            "leco shrink RUN --data SCENE --out FILE --json benchmarks/results/shrink/SCENE.json"
        )
        title = "Gates shrunk to what decides alike"
        parts += section(title, command, next(iter(shrunk.values())), shrink_table(shrunk), note)
    if (stored_samples := RESULTS / "samples.json").exists():
        samples = json.loads(stored_samples.read_text())
        rows = dict(sorted(samples["scenes"].items(), key=lambda item: _in_order(item[0])))
        note = (
            " The same runs, of 600 steps, on up to four test photographs. Of the candidates a "
            "coarse question, one for 16 in a row, jumps over empty stretches; cells answer for "
            "nearly all of the rest. What is shaded counts the backdrop that ends each ray; time "
            "is that of the same picture with all that is kept shaded, in turns. Rows "
            f"{made_line(rows.values())}."
        )
        command = "python benchmarks/samples.py RUN=SCENE ..."
        title = "Samples along a ray"
        parts += section(title, command, samples, samples_table(rows), note)
    if measured := scene_results("capacity"):
        first = next(iter(measured.values()))
        rows = [row for report in measured.values() for row in report["representations"]]
        note = (
            f" Each loses {first['lost_surface_mass']:.1%} of the weight near surfaces along "
            "held-out rays; kept is a share of the volume that training rays reach. Gate and grid "
            "are those that pay most of their kind: ten times the bytes must leave two thirds of "
            f"the volume. One field a scene: small differences mean nothing. Cities: add "
            f"`--learn-steps {CITY_STEPS}`. In the pictures, lines go from few bytes to many: left "
            f"what each keeps, right what each loses. Rows {made_line(rows)}."
        )
        command = "leco capacity --data SCENE --out DIR"
        title = "How much a scene needs: gates and grids at equal loss"
        head, *rest = section(title, command, first, capacity_table(measured), note)
        noted = [f"**{notes()['capacity']}**\n"] if "capacity" in notes() else []
        parts += [head, *noted, *(f"{picture(CAPACITY + name)}\n" for name in measured), *rest]
    return parts


def scene_results(folder: str) -> dict[str, Any]:
    """Stored results of a command, by the name of their scene; cities by their blocks first."""
    paths = sorted((RESULTS / folder).glob("*.json"), key=lambda path: _in_order(path.stem))
    return {path.stem: json.loads(path.read_text()) for path in paths}


def _in_order(name: str) -> tuple[int, int, str]:
    kind, _, blocks = name.partition("-")
    city = kind == "city" and blocks.isdigit()
    return (0, int(blocks), "") if city else (1, 0, name)
