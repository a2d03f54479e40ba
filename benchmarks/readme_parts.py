"""What the README shows of stored results: what a learned occupancy gains, and the demo."""

from __future__ import annotations

import json
import statistics
from collections.abc import Mapping, Sequence
from typing import Any

import checkout  # noqa: F401
from chart_sections import stored
from comparisons import beside, comparisons, in_words
from page_parts import RESULTS, between, noted, table
from walk import with_walk

from leco_plugin.chart.contender import LEARNED
from leco_plugin.chart.summary import Line, compare, describe_seeds, lines_of
from leco_plugin.evaluation.report import describe_cores
from leco_plugin.learning.calibration import in_decibels
from leco_plugin.log import counted

DEMO = "<!-- demo: generated -->", "<!-- end of the demo -->"
GAIN = "<!-- gain: generated -->", "<!-- end of the gain -->"
GAIN_CHART = "caliterra-hosts"
"""Each host with its own sampling and with a learned occupancy, in benchmarks/results/charts."""
DEMO_CHART = "city-3"
"""The demo's two rows on a city like its own, over seeds."""
GIFTS_CHART = "caliterra-gifts"
"""A host with a learned occupancy, with and without what else it gets, and with its own grid."""
FAILED = 5.0
"""dB below the worst run with its own grid, from which on a run has failed."""


def readme(text: str) -> str:
    """The README with its tables renewed."""
    text = between(text, DEMO, demo_sentence(json.loads((RESULTS / "demo.json").read_text())))
    return between(with_walk(text, ("lines",)), GAIN, gain("docs/", front=True))


def gain(folder: str = "", front: bool = False) -> str:
    """What a learned occupancy gains: for the page of results, or for the README in front of all,
    which leads with three numbers and says what else there is to know.

    Args:
        folder: of the pages, beside the one that this is for.
    """
    chart = stored(GAIN_CHART)
    found = in_words(comparisons((GAIN_CHART, GIFTS_CHART)), f"{folder}measurements.md")
    told = [gain_table(chart), found]
    if front:
        told = [lead(chart), told[0], f"- {found}\n- {without_gifts(stored(GIFTS_CHART))}"]
    return "\n\n".join([*told, *filter(None, [noted(RESULTS).get(GAIN_CHART)])])


def without_gifts(results: Mapping[str, Any]) -> str:
    """What a learned row of the gain has without what else it gets beside its gate."""
    whole, without, own = lines_of(results)
    ended = [psnr for psnr in without.psnrs if psnr >= min(own.psnrs) - FAILED]
    failed = len(without.psnrs) - len(ended)
    alone = f"{failed} of {counted(len(without.psnrs), 'run')} failed"
    if ended:
        alone = f"at {listed(ended)}" + (f" ({alone})" if failed else "")
    return (
        "**Not all of Instant-NGP's lead is the gate's.** Its field also begins opaque, it skips "
        "less at first, and sparse points end rays while the gate learns. In another test, of "
        f"{len(whole.psnrs)} seeds, runs with all of that end at {listed(whole.psnrs)} dB; with "
        f"gate and bounds alone {alone}; with its own grid at {listed(own.psnrs)} "
        "([more](docs/results.md#what-is-gained-in-the-same-time))."
    )


def demo_sentence(report: dict[str, Any]) -> str:
    """What `make demo` ends with, in short."""
    ours, other = report["runs"]
    facts, name = report["occupancy"], "render_seconds_per_image"
    return (
        f"`make demo` trains for {ours['train_seconds']:.0f} s on a made-up city, and freezes its "
        f"gate after {ours['freeze_seconds']:.0f}. It ends at {ours['psnr']:.1f} dB (one seed); "
        f"without freezing it ends at {other['psnr']:.1f} dB, and an image takes "
        f"{other[name] / ours[name]:.1f} times as long.{over_seeds(stored(DEMO_CHART))} The city "
        "is known exactly: "
        f"{facts['kept_surface_recall']:.1%} of its visible surface is kept, and "
        f"{facts['free_space_skipped']:.1%} of its free space skipped."
    )


def over_seeds(results: Mapping[str, Any]) -> str:
    """What both rows of a demo come to over seeds and in more time."""
    ours, other, *_ = lines_of(results)
    seconds, seeds = results["protocol"]["seconds"], describe_seeds(results)
    means = f"{ours.psnr:.1f} and {other.psnr:.1f} dB"
    spread = [f"{min(line.psnrs):.1f} to {max(line.psnrs):.1f}" for line in (ours, other)]
    word = compare(ours.psnrs, other.psnrs).word
    return f" After {seconds:g} s, {seeds}, that is {means} ({' and '.join(spread)}: {word})."


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
        f"candidates skipped for {in_decibels(facts['image_price_db'])} and "
        f"{facts['lost_surface_mass']:.1e} of the surface mass on held-out rays. Against the exact "
        f"city: {facts['kept_surface_recall']:.1%} of the visible surface kept, "
        f"{facts['free_space_skipped']:.1%} of free space skipped.",
    ]
    return "\n".join(lines)


def lead(results: Mapping[str, Any]) -> str:
    """Three numbers: of Instant-NGP, with a learned occupancy and with its best other sampling."""
    host = [line for line in lines_of(results) if line.method == "leco-ngp"]
    ours = next(line for line in host if line.learned)
    best = max((line for line in host if not line.learned), key=lambda line: line.psnr)
    image, of_best = (_median(line, "render_seconds_per_image") for line in (ours, best))
    queries, of_others = (_median(line, "field_queries_per_ray") for line in (ours, best))
    return (
        f"**Instant-NGP after {results['protocol']['seconds']:g} s** of one CPU core reaches "
        f"{ours.psnr:.1f} dB with a learned occupancy, {best.psnr:.1f} with the best other way to "
        f"sample. An image takes {image:.1f} s instead of {of_best:.1f}: its network is asked for "
        f"{queries:.0f} samples a ray, not {of_others:.0f}. Part of that lead is not the "
        "gate's: see below the table."
    )


def gain_table(results: Mapping[str, Any]) -> str:
    """Accuracy, rendering and queries of each contender, how the one with a learned occupancy
    stands beside it, and what the words mean."""
    lines = lines_of(results)
    learned = {line.method: line for line in lines if line.sampler == LEARNED}
    seconds, scene = results["protocol"]["seconds"], results["scene"]["name"]
    cores, seeds = describe_cores(results["machine"]), describe_seeds(results)
    head = f"`{scene}`, {seconds:g} s on {cores}, {seeds}"
    rows = [
        [
            f"**{line.name}**" if line.learned else line.name,
            f"{line.psnr:.1f} dB ({min(line.psnrs):.1f} to {max(line.psnrs):.1f})",
            f"{_median(line, 'render_seconds_per_image'):.1f} s",
            _queries(line),
            "" if line.learned or not (ours := learned.get(line.method)) else beside(ours, line),
        ]
        for line in lines
    ]
    words = (
        "A query asks a network about one point; *small* ones ask a proposal network or a gate. "
        "*LeCO* is the paper's model: networks, the *experts*, of which the gate chooses one for "
        "each point. This scene has one; larger ones have more. A *host* is a method that an "
        "occupancy guides. What is *never frozen* skips nothing; *long steps* take "
        "fewer samples of each ray. PSNR, which is better when higher, is a mean over seeds, with "
        "the least and the most; the others are medians. Behind ± stands a 95% interval."
    )
    columns = f"{head} | PSNR | to render an image | queries a ray | learned occupancy is"
    return "\n".join([*table(columns, rows), "", words])


def gifts_sentence(results: Mapping[str, Any], anchor: str) -> str:
    """What a learned row gets beside its gate is worth, seed by seed."""
    learned, without, own = (listed(line.psnrs) for line in lines_of(results))
    return (
        "**Is Instant-NGP's lead the gate's alone?** No. Its learned row also gets an opaque "
        "start, a careful one, and bounds and distances of sparse points. [Seed by "
        f"seed](measurements.md#{anchor}), after "
        f"{results['protocol']['seconds']:g} s: {learned} dB with all of it, {without} with gate "
        "and bounds alone, "
        f"{own} with its own grid. A host that begins transparent may never find a surface: that "
        "is what the opaque start is for. A grid keeps the whole box at first, and is opaque by "
        "itself. [Who gets what](gifts.md)."
    )


def listed(psnrs: Sequence[float]) -> str:
    """Some PSNRs, the best first."""
    return ", ".join(f"{psnr:.1f}" for psnr in sorted(psnrs, reverse=True))


def _queries(line: Line) -> str:
    """Of the field, and of proposal networks and gate, a rendered ray."""
    of_field, *small = (
        _median(line, f"{part}_queries_per_ray") for part in ("field", "proposal", "gate")
    )
    others = round(sum(small))
    return f"{of_field:.0f} + {others} small" if others else f"{of_field:.0f}"


def _median(line: Line, name: str) -> float:
    return statistics.median(run[name] for run in line.runs)
