"""The results of `docs/upstream/leco_nerf.md`, the page for nerfstudio's own docs."""

from __future__ import annotations

import statistics

import checkout  # noqa: F401
from chart_sections import notes, star, stored
from page_parts import ROOT, between, table

from leco_plugin.chart.summary import MEMORY, RENDERING, Line, lines_of, sentence

PAGE = ROOT / "docs" / "upstream" / "leco_nerf.md"
MARKS = "<!-- results: generated -->", "<!-- end of the results -->"
CHARTS = {
    "leco-occupancy": "caliterra-hosts",
    "leco-ngp": "caliterra-hosts",
    "leco-nerfacto": "caliterra-hosts",
    "leco-switch-nerf": "caliterra-enough-time",
}
"""Which stored chart shows a method on a survey by drone."""
HEAD = "Method | Trained for | Sampling | Memory | PSNR | Rendering an image"
BELOW = r"""
75 drone photographs of a building site (OpenDroneMap's `odm_data_caliterra`, 480 x 360), on one CPU
core each. Memory is the most that the process held, a median. PSNR is of test photographs: the mean
of {seeds} seeds, with the least and the most. Below each method stands the same one without a
learned occupancy.{better}"""
OLD = r" A method marked (\*) has a chart that was made before a later change."


def page(text: str) -> str:
    """The page with its table renewed."""
    rows, seeds, better = [], set(), []
    for method, name in CHARTS.items():
        lines = [line for line in lines_of(stored(name)) if line.method == method]
        guided = next(line for line in lines if line.learned)
        other, *others = (line for line in lines if not line.learned)
        better += [
            f" {sentence(line.name)} takes `{method}` to {line.psnr:.1f} dB."
            for line in others
            if line.psnr > other.psnr and line.psnr == max(each.psnr for each in others)
        ]
        mark = r" (\*)" if name in notes() else ""
        rows += [[f"`{method}`{mark}", *_cells(guided)], ["", *_cells(other)]]
        seeds |= {len(guided.runs), len(other.runs)}
    count = " or ".join(str(some) for some in sorted(seeds))
    below = BELOW.format(seeds=count, better="".join(better)) + OLD * bool(star(*CHARTS.values()))
    return between(text, MARKS, "\n".join([*table(HEAD, rows), below]))


def _cells(line: Line) -> list[str]:
    """Training time, sampling, memory, PSNR and rendering of a line."""
    seconds = statistics.median(run["train_seconds"] for run in line.runs)
    memory, rendering = line.median(MEMORY), line.median(RENDERING)
    assert memory is not None and rendering is not None
    psnr = f"{line.psnr:.1f} ({min(line.psnrs):.1f} to {max(line.psnrs):.1f})"
    return [f"{seconds:.0f} s", line.name, f"{memory:.1f} GB", psnr, f"{rendering:.1f} s"]
