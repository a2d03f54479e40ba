"""The reviewers' questions, each with an answer from every scene."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import checkout  # noqa: F401
from chart_sections import by_scene, star
from page_parts import size, table

from leco_plugin.chart.learned import (
    Learned,
    falls,
    learned_of,
    ours_of,
    percent,
    still_rising,
    words_of,
)
from leco_plugin.chart.methods import SUITES
from leco_plugin.chart.panels import asks_what_was_learned, finding_of
from leco_plugin.chart.representations import COSTS, fronts_of, representations_of
from leco_plugin.chart.summary import RENDERING, Line, compare, lines_of, sentence
from leco_plugin.log import counted

HEAD = """## The answers with their figures

What each suite of `leco chart --suite` found on each scene. Costs, spread over seeds, pictures and
commands are below. Where (*) stands, a chart was made before a mend that is named there.
"""
KEPT = """Volume kept, of what rays reach, where each loses 0.1% of the surface mass, and the size
of the occupancy: less is better in both, and what is on the front is so in the median over seeds.
Grids, and a small gate of each kind, are made from the field that learned with our gate. A *grid*
is filled with densities, as hosts fill theirs; a *taught grid* has the lesson that small gates
have. *Sparse points* keep what is near one of the scene's. More sizes of all are
[elsewhere](measurements.md#how-much-a-scene-needs-gates-and-grids-at-equal-loss). Sizes are those
of numbers in bfloat16, and of grids as octrees; where no taught grid stands beside, grids are in
bits, one a cell.
"""
LEARNED = """Space that each gate keeps, of what rays reach, where it loses 0.1% of the surface, and
PSNR after equally many steps. A gate that was frozen with the last of them has guided nothing.
"""
TIMED = """PSNR after equal time, and seconds to render a test image. What keeping a grid up takes
is missing in training with it: a fine one shows here what it costs on two cores, and not how good
it would be. A method that gained more than 0.3 dB in the last third of the time is still rising.
One that ended more than 0.3 dB below its own best point fell. The others may gain by more time as
well: rates fall over whatever time is given.
"""

TIMES = """### How long the suites take

Minutes of all runs of a suite on two cores, two at a time, each from the start of its process to
its end. They are the processor's, in one thread: other programs do not lengthen them. Together,
runs that several suites share are counted once. Each was to take less than 45 and all of them
together 240.
"""


def answers_section() -> list[str]:
    """Suite by suite, a row for each scene; nothing where no suite is stored."""
    parts, shown = [], []
    for suite, its in SUITES.items():
        if charts := list(by_scene(suite).values()):
            parts += [f"### {its.question}\n", *_answer(charts)]
            shown += [results for _, results in charts]
    return [HEAD, *parts, *minutes_section(shown)] if parts else []


def _answer(charts: Sequence[tuple[str, dict[str, Any]]]) -> list[str]:
    kinds = [_kind(results) for _, results in charts]
    figures, cells_of = next((kind for kind in kinds if kind[0] == KEPT), kinds[0])
    cells = [cells_of(lines_of(results)) for _, results in charts]
    columns = list(dict.fromkeys(column for row in cells for column in row))
    rows = []
    for (name, results), row in zip(charts, cells):
        scene = _link(results) + star(name)
        shown = [row.get(column, "-") for column in columns]
        rows.append([scene, *shown, _answer_of(results), str(results["made"]["date"])])
    short = f"{in_short([results for _, results in charts])}\n"
    return [figures, *table(f"scene | {' | '.join(columns)} | | made", rows), "", short]


def in_short(charts: Sequence[Mapping[str, Any]]) -> str:
    """A sentence or two over the scenes of a suite, whose first contender is ours."""
    figures = {_kind(results)[0] for results in charts}
    if KEPT in figures:
        return _fronts(charts)
    if LEARNED in figures:
        best = sum(_none_is_better(learned_of(lines_of(results))) for results in charts)
        return (
            f"On {best or 'none'} of {scenes_of(charts)} the seeds show no other ahead of ours in "
            "space kept or PSNR that is not behind it in the other."
        )
    ours = sentence(lines_of(charts[0])[0].name)
    words = standing(_word(lines_of(results)) for results in charts)
    return f"*{ours}* is ahead of the best other {words}."


STANDINGS = {
    "level": "level with it",
    "behind": "behind it",
    "undecided": "undecided",
    None: "without a verdict",
}
"""Words for how it stands beside another where it is not ahead."""


def standing(words: Iterable[str | None]) -> str:
    """On how many scenes one is ahead of another, and how it stands on the rest."""
    counts = Counter(words)
    of = counted(counts.total(), "scene")
    rest = [f"{said} on {counts[word]}" for word, said in STANDINGS.items() if counts[word]]
    return ", ".join([f"on {counts['ahead'] or 'none'} of {of}", *rest])


def scenes_of(charts: Sequence[Any]) -> str:
    """How many scenes there are charts of, in words."""
    return counted(len(charts), "scene")


def _none_is_better(learned: Sequence[Learned]) -> bool:
    """Whether ours was measured, with a verdict on all others, and none is ahead of it in space or
    PSNR without being behind in the other."""
    ours = ours_of(learned)
    if ours is None or not ours.is_measured:
        return False
    rivals = [one for one in learned if one is not ours and one.is_measured]
    found = [words_of(one, ours) for one in rivals]
    return not any(None in said or ("ahead" in said and "behind" not in said) for said in found)


def _word(lines: Sequence[Line]) -> str | None:
    """How the PSNR of the first contender compares with that of the best other."""
    ours, *others = lines
    best = max(others, key=lambda line: line.psnr, default=ours)
    return compare(ours.psnrs, best.psnrs).word


def _link(results: Mapping[str, Any]) -> str:
    scene = results["scene"]["name"]
    return f"[{scene}](#suite-{results['suite']}-on-{scene})"


def _kind(results: Mapping[str, Any]) -> tuple[str, Callable[[Sequence[Line]], dict[str, str]]]:
    """What the figures of a suite are, and how those of a scene are found, by contender."""
    if representations_of(lines_of(results)):
        return KEPT, _kept
    return (LEARNED, _learned) if asks_what_was_learned(results) else (TIMED, _timed)


def _kept(lines: Sequence[Line]) -> dict[str, str]:
    held = representations_of(lines)
    return {one.name: f"{one.kept:.1f}%, {size(one.median('size'))}" for one in held}


def _learned(lines: Sequence[Line]) -> dict[str, str]:
    found = {one.name: one for one in learned_of(lines)}
    cells = {}
    for line in lines:
        one = found.get(line.name)
        if one is None or not one.facts:
            said = "not frozen"
        elif not one.is_measured:
            said = f"{len(one.facts)} of {one.seeds} frozen"
        else:
            said = percent(one.kept)
        if one is not None and one.guided_nothing:
            said += f" ({one.guided_nothing} of {one.seeds} frozen at the end)"
        cells[line.name] = f"{said}, {line.psnr:.1f} dB"
    return cells


def _timed(lines: Sequence[Line]) -> dict[str, str]:
    return {
        line.name: f"{line.psnr:.1f} dB, {line.median(RENDERING):.2g} s" + _kept_up(line)
        for line in lines
    }


def _kept_up(line: Line) -> str:
    return f" ({line.kept_up:.0%} of the time for its grid)" if line.kept_up else ""


def _fronts(charts: Sequence[Mapping[str, Any]]) -> str:
    """On the fronts of how many scenes each of ours is."""
    counts: dict[str, dict[str, int]] = {}
    for results in charts:
        held = representations_of(lines_of(results))
        for one in (one for one in held if one.ours):
            its = counts.setdefault(one.name, dict.fromkeys(COSTS, 0))
            for name in fronts_of(one, held):
                its[name] += 1
    of = scenes_of(charts)
    said = [
        f"{sentence(who)}: on {its['size']} of {of} nothing as small keeps less space, on "
        f"{its['learning time']} nothing that is learned as soon."
        for who, its in counts.items()
    ]
    return " ".join(said)


def _level(learned: Sequence[Learned]) -> str:
    """Who is level with ours in space kept and in PSNR, and of whom the seeds do not say it."""
    ours = ours_of(learned)
    if ours is None or not ours.is_measured:
        return ""
    others = [one for one in learned if one is not ours and one.is_measured]
    words = {one.name: words_of(ours, one) for one in others}
    level = [name for name, its in words.items() if its == {"level"}]
    unknown = [name for name, its in words.items() if "undecided" in its <= {"level", "undecided"}]
    said = f"; level with it: {', '.join(level)}" if level else ""
    return said + (f"; undecided: {', '.join(unknown)}" if unknown else "")


def _answer_of(results: Mapping[str, Any]) -> str:
    """The title of a chart, and who is level with ours, still rising, or has fallen."""
    lines = lines_of(results)
    if asks_what_was_learned(results) and not representations_of(lines):
        return finding_of(results) + _level(learned_of(lines))
    said = [finding_of(results)]
    if results["protocol"]["seconds"] is not None:
        rising = still_rising(lines)
        who = "all" if len(rising) == len(lines) else ", ".join(rising)
        said += [f"still rising at the end: {who}"] if rising else []
        said += filter(None, [falls(lines)])
    return "; ".join(said)


def minutes_section(charts: Sequence[dict[str, Any]]) -> list[str]:
    """What each suite took on each scene, and all of a scene without runs that it shares.

    Args:
        charts: their results, one for each scene and suite.
    """
    times: dict[str, dict[str, str]] = {}
    together: dict[str, float] = {}
    for results in charts:
        scene = results["scene"]["name"]
        its = times.setdefault(scene, {})
        spent = [run.get("wall_seconds") for run in results["runs"]]
        if None in spent:
            its[results["suite"]], together[scene] = "-", math.inf
            continue
        at_once = 60.0 * results["protocol"].get("at_once", 1)
        its[results["suite"]] = f"{sum(spent) / at_once:.0f}"
        own = [run["wall_seconds"] for run in results["runs"] if not run.get("reused")]
        together[scene] = together.get(scene, 0.0) + sum(own) / at_once
    rows = []
    for scene, its in times.items():
        total = "-" if math.isinf(together[scene]) else f"{together[scene]:.0f}"
        rows.append([scene, *(its.get(suite, "-") for suite in SUITES), total])
    lines = table(f"scene | {' | '.join(SUITES)} | together", rows)
    return ["\n".join([TIMES, *lines]) + "\n"]
