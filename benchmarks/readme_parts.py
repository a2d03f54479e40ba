"""What the README shows of stored results: what a learned occupancy gains, and the demo."""

from __future__ import annotations

import json
import statistics
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import checkout  # noqa: F401
from answers import in_short
from chart_sections import by_scene, longer, star, stored, titles
from page_parts import RESULTS, between, heading_anchor, noted, table
from walk import with_walk

from leco_plugin.chart.contender import LEARNED
from leco_plugin.chart.learned import last_gain
from leco_plugin.chart.summary import Line, compare, describe_seeds, lines_of
from leco_plugin.evaluation.report import describe_cores
from leco_plugin.learning.calibration import in_decibels
from leco_plugin.log import counted

DEMO = "<!-- demo: generated -->", "<!-- end of the demo -->"
GAIN = "<!-- gain: generated -->", "<!-- end of the gain -->"
GAIN_CHART = "caliterra-hosts"
"""Each host with its own sampling and with a learned occupancy, in benchmarks/results/charts."""
CITY_CHARTS = {"Instant-NGP": "city-4-ngp", "Nerfacto": "city-4-nerfacto"}
"""Hosts of the gain on another scene, one in each chart."""
HALF_HOUR_CHARTS = {"a drone survey": "caliterra-half-hour", "a city": "city-4-half-hour"}
"""Runs of half an hour, by the kind of scene; the first is the scene of the gain."""
FIVE_MINUTES = "-ngp-300"
"""How the names of charts of Instant-NGP end whose runs had 300 s."""
DEMO_CHART = "city-3"
"""The demo's two rows on a city like its own, over seeds."""
GIFTS_CHART = "caliterra-gifts"
"""A host with a learned occupancy, with and without what else it gets, and with its own grid."""
OURS = "leco-occupancy"
FAILED = 5.0
"""dB below the worst run with its own grid, from which on a run has failed."""
CLEAR = ("ahead", "behind")
STANDS = {
    "ahead": "ahead of",
    "level": "level with",
    "undecided": "undecided against",
    "behind": "behind",
}
"""Words before the name of a rival."""


def readme(text: str) -> str:
    """The README with its tables renewed."""
    text = between(text, DEMO, demo_sentence(json.loads((RESULTS / "demo.json").read_text())))
    later = filter(None, [f"{in_five_minutes()}{after_half_an_hour()}", of_the_papers_host()])
    text = with_walk(text, ("lines",))
    return between(text, GAIN, gain(without_gifts(stored(GIFTS_CHART)), *later))


def gain(*also: str) -> str:
    """What a learned occupancy gains: for the page of results, or with what else is to be known,
    for the README, which leads with three numbers."""
    chart = stored(GAIN_CHART)
    told = gain_table(chart), in_the_same_time(chart)
    if also:
        found = [f"{in_the_same_time(chart, most=1)} {on_a_city()}", *also]
        told = lead(chart), gain_table(chart), "\n".join(f"- {each}" for each in found)
    return "\n\n".join([*told, *filter(None, [noted(RESULTS).get(GAIN_CHART)])])


def after_half_an_hour() -> str:
    """What is left of the gain of the paper's model when there is time."""
    names = HALF_HOUR_CHARTS.values()
    here, there = (lines_of(stored(name)) for name in names)
    seeds = _seeds_of(map(stored, names))
    old = ", made before a later change of the code" if star(*names) else ""
    return (
        f"**After half an hour** LeCO has {here[0].psnr:.1f} dB with a learned occupancy, "
        f"{here[1].psnr:.1f} without a gate; on a city {there[0].psnr:.1f} and {there[1].psnr:.1f} "
        f"({seeds} each{old})."
    )


def on_a_city() -> str:
    """How hosts of the gain stand beside their best other row on another scene."""
    parts = []
    for host, name in CITY_CHARTS.items():
        ours, rival = _ranked(stored(name))[:2]
        parts.append(f"{host} is {_beside(ours, rival, host)}{star(name)}")
    return f"On a city of 4 x 4 blocks {'. '.join(parts)}."


def of_the_papers_host() -> str:
    """How its ways to sample end in the time of the suite, and where there was more."""
    charts = [results for _, results in by_scene("enough-time").values()]
    if not charts:
        return ""
    said = [f"After {charts[0]['protocol']['seconds']:g} s {in_short(charts)}"]
    for _, results in longer("enough-time"):
        ours, *others = lines_of(results)
        rest: dict[str, list[str]] = {}
        for line in sorted(others, key=lambda line: -line.psnr):
            rest.setdefault(_stands(ours, line), []).append(f"*{line.name}* ({line.psnr:.1f})")
        beside = "; ".join(f"{stands} {' and '.join(names)}" for stands, names in rest.items())
        said.append(
            f"After {results['protocol']['seconds']:g} s on `{results['scene']['name']}` "
            f"({describe_seeds(results)}) it has {ours.psnr:.1f} dB: {beside}."
        )
    return f"**Switch-NeRF, the paper's host.** {' '.join(said)}"


def half_an_hour() -> str:
    """What is left of the gain when there is time."""
    parts = []
    for place, name in HALF_HOUR_CHARTS.items():
        ours, other = lines = lines_of(stored(name))
        ends = [f"{line.psnr:.1f} dB ({last_gain(line):+.1f})" for line in lines]
        passed = ours.seconds_to(other.psnr)
        sooner = "" if passed is None else f"; after {passed:.0f} s the first had as much"
        parts.append(
            f"on {place} {ends[0]} with a learned occupancy, {ends[1]} as *{other.name}* "
            f"({compare(ours.psnrs, other.psnrs).said()}){sooner} "
            f"([figures](measurements.md#{heading_anchor(titles()[name])})){star(name)}"
        )
    return (
        f"**After half an hour** of one core LeCO has {'; '.join(parts)}. In brackets behind each "
        "PSNR what the last third of the time brought."
    )


def _ranked(results: Mapping[str, Any]) -> list[Line]:
    """The rows of a chart: that with a learned occupancy, then the best first."""
    lines = lines_of(results)
    return sorted(lines, key=lambda one: (one.sampler != LEARNED, not one.learned, -one.psnr))


def _stands(ours: Line, other: Line) -> str:
    """Words before the name of another row, for how ours stands beside it."""
    return STANDS.get(compare(ours.psnrs, other.psnrs).word or "", "beside")


def _of_host(line: Line, host: str) -> str:
    """What a row of a host is called beside it."""
    return f"*{line.name.removeprefix(host).lstrip(' +,')}*"


def _of_five_minutes() -> dict[str, Mapping[str, Any]]:
    return {name: stored(name) for name in titles() if name.endswith(FIVE_MINUTES)}


def in_five_minutes() -> str:
    """What Instant-NGP has after 300 s, and its best other row, scene by scene; nothing where no
    such chart is stored."""
    parts, beside_grids = [], []
    charts = _of_five_minutes()
    for name, results in charts.items():
        ours, taught, others = _by_occupancy(results)
        scene = f"{ours.psnr:.1f} dB on `{results['scene']['name']}`{star(name)}"
        rival = f"{_of_host(others[0], 'Instant-NGP')} ({others[0].psnr:.1f})"
        parts.append(f"{scene}, {_stands(ours, others[0])} {rival}")
        beside_grids += [(ours, taught)] if taught else []
    if not parts:
        return ""
    said = f"**After 300 s** ({_seeds_of(charts.values())}) Instant-NGP has {'; '.join(parts)}. "
    return f"{said}{_beside_taught_grids(beside_grids)}"


def _beside_taught_grids(rows: Sequence[tuple[Line, Sequence[Line]]]) -> str:
    """How taught grids of the best and of the worst size end, scene by scene, and what they take;
    nothing where there are none."""
    if not rows:
        return ""
    best, worst = (", ".join(f"{taught[i].psnr:.1f}" for _, taught in rows) for i in (0, -1))
    words = dict.fromkeys(_stands(ours, taught[0]) for ours, taught in rows)
    sizes = sorted({_megabytes(line) for _, taught in rows for line in taught}, key=float)
    return (
        f"A grid that learns as the gate does ends at {best} with the best size that was tried "
        f"(the gate is {' or '.join(words)} it), at {worst} with the worst; "
        f"its file takes {' to '.join((sizes[0], sizes[-1]))} MB, the gate's "
        f"{_megabytes(rows[0][0])}. "
    )


def after_five_minutes() -> str:
    """How Instant-NGP stands beside its other rows after 300 s, scene by scene; nothing where no
    such chart is stored."""
    parts, charts = [], _of_five_minutes()
    for name, results in charts.items():
        ours, taught, others = _by_occupancy(results)
        beside = " and ".join(_beside(ours, rival, "Instant-NGP") for rival in others)
        clear = min(ours.psnrs) > max(psnr for rival in others for psnr in rival.psnrs)
        grids = " and ".join(_beside(ours, rival, "Instant-NGP") for rival in taught)
        parts.append(
            f"- On `{results['scene']['name']}` {ours.psnr:.1f} dB "
            f"([figures](measurements.md#{heading_anchor(titles()[name])})){star(name)}, {beside}"
            + ("; each seed is ahead of each of theirs" if clear else "")
            + (f". {grids[0].upper()}{grids[1:]}" if grids else "")
            + "."
        )
    begin = (
        f"**After 300 s** ({_seeds_of(charts.values())}) Instant-NGP with a learned occupancy has"
    )
    return "\n".join([f"{begin}:", "", *parts]) if parts else ""


def _seeds_of(charts: Iterable[Mapping[str, Any]]) -> str:
    return " and ".join(dict.fromkeys(map(describe_seeds, charts)))


def _by_occupancy(results: Mapping[str, Any]) -> tuple[Line, list[Line], list[Line]]:
    """The row with our gate; those with another that learned as it did; those that learned none."""
    ours, *others = _ranked(results)
    return (
        ours,
        [line for line in others if line.learned],
        [line for line in others if not line.learned],
    )


def _megabytes(line: Line) -> str:
    """Of its file."""
    return f"{statistics.median(run['occupancy']['bytes'] for run in line.runs) / 1e6:.2g}"


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
    """Three numbers: of Instant-NGP, with a learned occupancy and with its own grid."""
    host = [line for line in lines_of(results) if line.method == "leco-ngp"]
    ours = next(line for line in host if line.learned)
    own = next(line for line in host if "own grid" in line.name)
    image, of_own = (_median(line, "render_seconds_per_image") for line in (ours, own))
    return (
        f"**Instant-NGP after {results['protocol']['seconds']:g} s** of one CPU core reaches "
        f"{ours.psnr:.1f} dB with a learned occupancy, {own.psnr:.1f} with its own grid. An image "
        f"takes {image:.1f} s instead of {of_own:.1f}: its network is asked for "
        f"{_queries(ours)} samples a ray, not {_queries(own)}. Part of that lead is not the "
        "gate's: see below the table."
    )


def gain_table(results: Mapping[str, Any]) -> str:
    """Accuracy, rendering and queries of each contender, and what the words mean."""
    lines = lines_of(results)
    seconds, scene = results["protocol"]["seconds"], results["scene"]["name"]
    cores, seeds = describe_cores(results["machine"]), describe_seeds(results)
    head = f"`{scene}`, {seconds:g} s on {cores}, {seeds}"
    rows = [
        [
            f"**{line.name}**" if line.learned else line.name,
            f"{line.psnr:.1f} dB ({min(line.psnrs):.1f} to {max(line.psnrs):.1f})",
            f"{_median(line, 'render_seconds_per_image'):.1f} s",
            _queries(line),
        ]
        for line in lines
    ]
    words = (
        "A query asks a network about one point; *small* ones ask a proposal network or a gate. "
        "*LeCO* is the paper's model: several networks, the *experts*, of which the gate chooses "
        "one for each point. A *host* is a method that an occupancy guides. *Long steps* take "
        "fewer samples of each ray. PSNR is a mean over seeds, with the least and the most; the "
        "others are medians. Behind ± stands a 95% interval."
    )
    columns = f"{head} | PSNR | to render an image | queries a ray"
    return "\n".join([*table(columns, rows), "", words])


def in_the_same_time(results: Mapping[str, Any], most: int | None = None) -> str:
    """`gains`, as a sentence of its own."""
    if most:
        return f"**Beside the best row without it:** {gains(lines_of(results), most)}"
    return f"**In the same time,** with a learned occupancy, {gains(lines_of(results))}"


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


def gains(lines: Sequence[Line], most: int | None = None) -> str:
    """How each method with a learned occupancy stands beside its other rows, or beside so many of
    the best of them; the paper's last."""
    learned = sorted((line for line in lines if line.learned), key=lambda line: line.method == OURS)
    parts = []
    for ours in learned:
        host = ours.name.split(" + ")[0]
        rivals = [line for line in lines if line.method == ours.method and not line.learned]
        rivals.sort(key=lambda line: -line.psnr)
        beside = [_beside(ours, rival, host) for rival in rivals[:most]]
        parts += [f"{host} is {' and '.join(beside)}"] if beside else []
    return ". ".join(parts) + "."


def _beside(ours: Line, rival: Line, host: str) -> str:
    """What ours gains over another row of its host."""
    times = _median(rival, "render_seconds_per_image") / _median(ours, "render_seconds_per_image")
    found = compare(ours.psnrs, rival.psnrs)
    by = f"{abs(found.difference) if found.word in CLEAR else found.difference:.1f}"
    margin = f"± {found.margin:.1f} dB" if found.margin is not None else f"dB, {found.by}"
    faster, slower = f"{times:.1f} times as fast", f"in {1.0 / times:.1f} times the time"
    how = "by" if found.word in CLEAR else "at"
    renders = faster if times >= 1.0 else slower
    return f"{_stands(ours, rival)} {_of_host(rival, host)} {how} {by} {margin} (renders {renders})"


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
