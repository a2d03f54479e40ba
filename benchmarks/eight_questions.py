"""The eight questions of the paper's reviewers, each answered in some three sentences."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import checkout  # noqa: F401
from answers import in_short, scenes_of, standing
from chart_sections import by_scene, longer, star
from growth_picture import cities, finding
from page_parts import heading_anchor, size, span
from sizes_tables import chosen_of

from leco_plugin.chart.learned import last_gain, learned_of, percent, still_rising
from leco_plugin.chart.panels import finding_of
from leco_plugin.chart.representations import (
    SMALL_OURS,
    Representation,
    keeps_all,
    representations_of,
)
from leco_plugin.chart.summary import Line, at_equal_loss, compare, lines_of, sentence

Reports = Mapping[str, Any]
"""Results of `leco capacity`, by scene."""


def eight_answers(reports: Reports) -> list[str]:
    """A list for `docs/results.md`; of a question whose suite is not stored, that it is open."""
    said = []
    for question, suite, answer in asked():
        charts = by_scene(suite)
        mark = star(*(name for name, _ in charts.values()))
        text = answer([results for _, results in charts.values()]) if charts else "Not measured."
        said.append((f"**{question}**{mark}", text))
    said += [
        ("**How large may a scene be, and when does it stop paying?**", _scenes(reports)),
        (
            "**What happens over training?**",
            "[A film](measurements.md#while-an-occupancy-is-learned) shows o(x), and the share and "
            "density of each expert, step by step. `leco inspect RUN --history learned.gif` draws "
            "it of any run.",
        ),
    ]
    return [f"{number}. {' '.join(one)}" for number, one in enumerate(said, start=1)]


def asked() -> list[tuple[str, str, Callable[[Sequence[Mapping[str, Any]]], str]]]:
    """The questions that suites answer: question, suite, and what says the answer."""
    return [
        ("Is a small MLP the best place for an occupancy?", "representations", _places),
        ("How long does learning it take?", "representations", _seconds),
        ("Why must the empty-space expert be small?", "empty-expert", _size_of_the_empty),
        ("Why freeze, and go on with the same network?", "freeze", _freezing),
        ("Does it pay at equal time, and with enough?", "enough-time", _enough),
        ("What if there is no empty-space expert?", "empty-expert", _no_empty),
    ]


def scenes_and_seeds() -> str:
    """Of how many scenes and seeds the answers of suites are, in words."""
    suites = [by_scene(suite).values() for _, suite, _ in asked()]
    seeds = {
        len(line.runs) for suite in suites for _, results in suite for line in lines_of(results)
    }
    return (
        f"{span(map(len, suites), 'd')} scenes each, "
        f"{span(seeds, 'd')} {'seed' if seeds == {1} else 'seeds'} a row"
    )


def _held(charts: Sequence[Mapping[str, Any]]) -> list[list[Representation]]:
    return [representations_of(lines_of(results)) for results in charts]


def _places(charts: Sequence[Mapping[str, Any]]) -> str:
    held = [some for some in _held(charts) if any(one.name == SMALL_OURS for one in some)]
    if not held:
        return "The small MLP was not measured."
    small = [next(one for one in some if one.name == SMALL_OURS) for some in held]
    others: dict[str, Callable[[Representation], bool]] = {
        "small gates on hash grids and planes": lambda one: (
            one.name.startswith("small ") and not one.ours
        ),
        "grids of densities": lambda one: one.is_grid,
        "grids with the MLP's own lesson": lambda one: one.name.startswith("taught grid"),
    }
    parts = []
    for name, belongs in others.items():
        pairs = [(ours, one) for ours, some in zip(small, held) for one in some if belongs(one)]
        if pairs:
            times = span(one.kept / ours.kept for ours, one in pairs)
            sizes = [one.median("size") for _, one in pairs]
            of = " to ".join(dict.fromkeys(size(some) for some in (min(sizes), max(sizes))))
            parts.append(f"{name} of {of} keep {times} times as much")
    least = {min(some, key=lambda one: one.kept).name for some in held}
    return (
        f"{'None' if len(least) > 1 else sentence(*least)} keeps least on every scene. A small MLP "
        f"of {span(one.median('size') for one in small)} kB that the trained field has taught "
        f"keeps {span(one.kept for one in small)}% of the space at equal loss in "
        f"{'; '.join([scenes_of(held), ', '.join(parts)] if parts else [scenes_of(held)])}."
        f"{_beside_them(charts)}"
    )


def _beside_them(charts: Sequence[Mapping[str, Any]]) -> str:
    """Where grids are in bits, for want of what an octree takes, and which are left out for keeping
    all in some run."""
    in_bits, full = list[str](), dict[str, None]()
    for results in charts:
        scene, measured = results["scene"]["name"], at_equal_loss(lines_of(results))
        if any("octree_bytes" not in row for one in measured for row in one["grids"]):
            in_bits.append(f"`{scene}`")
        rows = [row for one in measured for row in one.get("others", ())]
        full |= {f"{row['name']} on `{scene}`": None for row in rows if keeps_all(row)}
    said = f" Sizes of grids are of octrees, on {', '.join(in_bits)} a bit a cell." * bool(in_bits)
    return said + f" Left out, for keeping all in some run: {', '.join(full)}." * bool(full)


def _seconds(charts: Sequence[Mapping[str, Any]]) -> str:
    held = _held(charts)
    learned = [[one for one in some if one.kind is None and not one.is_grid] for some in held]
    ours = [one for some in learned for one in some if one.ours]
    rest = [one for some in learned for one in some if not one.ours and one.name in KINDS]
    beyond: dict[str, list[float]] = {"small gate": [], "taught grid": [], "grid of densities": []}
    for one in (one for some in held for one in some if one.has("beyond")):
        taught = "taught grid" if one.name.startswith("taught") else None
        kind = taught or ("small gate" if one.kind else "grid of densities" * one.is_grid)
        if kind:
            beyond[kind].append(one.median("beyond"))
    more = [f"a {kind} {span(some, '.0f')} s" for kind, some in beyond.items() if some]
    return (
        f"Our gate is learned in {span((one.median('learn_seconds') for one in ours), '.0f')} s "
        f"of a core, gates on hash grids and planes in "
        f"{span((one.median('learn_seconds') for one in rest), '.0f')}. From a field that has "
        f"learned, more is made: {', '.join(more)}. A GPU was not measured."
    )


KINDS = ("hash grid", "TensoRF planes", "K-planes")
"""Names of the gates that learn along with their field, beside ours."""


def _row(lines: Sequence[Line], name: str) -> Line:
    return next(line for line in lines if line.name == name)


def _above(charts: Sequence[Mapping[str, Any]], one: str, other: str, named: str) -> str:
    """By how many dB the mean of a row is above that of another, from scene to scene, and on how
    many its seeds say so.

    Args:
        named: what the other row is in a sentence.
    """
    rows = [lines_of(results) for results in charts]
    found = [compare(_row(lines, one).psnrs, _row(lines, other).psnrs) for lines in rows]
    by = span((verdict.difference for verdict in found), "+.1f")
    return f"{by} dB above {named} (ahead {standing(verdict.word for verdict in found)})"


def _size_of_the_empty(charts: Sequence[Mapping[str, Any]]) -> str:
    small, large = "imbalance loss alone, identity", "imbalance loss alone, large"
    lines = [line for results in charts for line in lines_of(results)]
    alone = [one for one in learned_of(lines) if one.name in (small, large)]
    kept = [share for one in alone for share in one.kept_by_seed.values()]
    gates = f"those gates keep {percent(min(kept))} to {percent(max(kept))} of the space"
    of_scene = "an expert of the scene's size"
    ours = _above(charts, "identity (ours)", "as large as a scene expert", "such an expert")
    return (
        "With the loss of the paper's abstract alone an identity ends "
        f"{_above(charts, small, large, of_scene)}. The paper's table has that order too, but "
        f"{gates if kept else 'those gates were never frozen'}, so that it is no counterpart. "
        f"With our loss an identity ends {ours}. {in_short(charts)}"
    )


def _freezing(charts: Sequence[Mapping[str, Any]]) -> str:
    on, never = "learn, freeze, go on", "never frozen"
    return (
        f"Going on ends {_above(charts, on, 'learn, freeze, from scratch', 'a new start')}, and "
        f"{_above(charts, on, never, 'a gate that is never frozen')}. {in_short(charts)}"
    )


def _enough(charts: Sequence[Mapping[str, Any]]) -> str:
    rising = sum("learned occupancy" in still_rising(lines_of(results)) for results in charts)
    seconds = charts[0]["protocol"]["seconds"]
    said = [
        "For equal time see the first table. Enough time is open: Switch-NeRF's runs of "
        f"{seconds:g} s still rise with a learned occupancy on {rising} of {scenes_of(charts)}. "
        f"{in_short(charts)}"
    ]
    for title, results in longer("enough-time"):
        gained, found = last_gain(lines_of(results)[0]), finding_of(results)
        said.append(
            f"After {results['protocol']['seconds']:g} s on `{results['scene']['name']}` "
            f"{found[0].lower()}{found[1:]}{_at_half(results)}; in the last third it gained "
            f"{gained:.1f} dB ([figures](suites.md#{heading_anchor(title)}))."
        )
    return " ".join(said)


def _at_half(results: Mapping[str, Any]) -> str:
    """Whether every seed was ahead of all others' after half of the time; nothing where not."""
    half = 0.5 * results["protocol"]["seconds"]
    ours, *others = (
        [psnr for run in line.runs for seconds, psnr in run["curve"] if round(seconds) == half]
        for line in lines_of(results)
    )
    ahead = len(ours) > 1 and min(ours) > max(itertools.chain(*others))
    return f"; after {half:g} s each of its seeds is ahead of all others'" if ahead else ""


def _no_empty(charts: Sequence[Mapping[str, Any]]) -> str:
    ours, none = "identity (ours)", "none: density is zero"
    worst = max(
        _row(lines_of(results), ours).psnr - min(_row(lines_of(results), none).psnrs)
        for results in charts
    )
    return (
        "Then density is zero where the gate says empty, and nothing corrects a gate that is "
        f"wrong. The identity ends {_above(charts, ours, none, 'that')}; the worst run without it "
        f"ended {worst:.1f} dB below the mean with it."
    )


def _scenes(reports: Reports) -> str:
    kept = {name: chosen_of(report)[0]["kept_volume"] for name, report in reports.items()}
    full = max(kept, key=lambda name: kept[name])
    return (
        f"{finding(cities(reports))} It pays least where a scene fills its box: on `{full}` the "
        f"gate keeps {kept[full]:.0%}."
    )
