"""Every stored comparison of a method with a learned occupancy and without, as one table."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import checkout  # noqa: F401
from chart_sections import star, stored, titles
from page_parts import heading_anchor, table

from leco_plugin.chart.contender import LEARNED
from leco_plugin.chart.summary import (
    RENDERING,
    Line,
    Verdict,
    compare,
    describe_seeds,
    lines_of,
)

SUITE = "enough-time"
"""The suite whose charts are among them: those of others compare gates."""
TITLE = "Every comparison with the best rival"
HEAD = """A method with a learned occupancy and its best *rival*, in equal time, one comparison for
each stored chart. Rivals are the other rows of the method whose gate, if they have one, is never
frozen. A *taught grid* is none: it learns its occupancy as the gate does. *Renders* compares with
the rival; *each seed ahead* says that each has more than each of the rival's. Of an *unseen
stretch* no neighbouring photograph is trained on.
"""


class Comparison(NamedTuple):
    """Rows of one method in a stored chart."""

    chart: str
    title: str
    results: Mapping[str, Any]
    host: str
    ours: Line
    """That with our learned occupancy."""
    taught: list[Line]
    """Those with another that learned as it did, the best first."""
    others: list[Line]
    """Those that learned none, the best first."""

    @property
    def verdict(self) -> Verdict:
        """How ours stands beside the best of those that learned none."""
        return compare(self.ours.psnrs, self.others[0].psnrs)


def comparisons(apart: Sequence[str]) -> list[Comparison]:
    """Of all stored charts but some that are shown apart, method by method."""
    found = []
    for chart, title in titles().items():
        results = stored(chart)
        if chart not in apart and results["suite"] in (None, SUITE):
            found += _of_chart(chart, title, results)
    hosts = list(dict.fromkeys(one.host for one in found))
    return sorted(found, key=lambda one: hosts.index(one.host))


def _of_chart(chart: str, title: str, results: Mapping[str, Any]) -> list[Comparison]:
    lines, found = lines_of(results), []
    for ours in (line for line in lines if line.sampler == LEARNED):
        rest = [line for line in lines if line.method == ours.method and line is not ours]
        rest.sort(key=lambda line: -line.psnr)
        taught = [line for line in rest if line.learned]
        host = str(ours.runs[0]["name"]).split(" + ")[0]
        others = [line for line in rest if not line.learned]
        found.append(Comparison(chart, title, results, host, ours, taught, others))
    return found


def in_words(found: Sequence[Comparison], table_is: str) -> str:
    """How often methods are ahead of their best rival, all together and one by one."""
    hosts = dict.fromkeys(one.host for one in found)
    said = [f"{host} {_standing([one for one in found if one.host == host])}" for host in hosts]
    behind = sum(one.verdict.word == "behind" for one in found)
    return (
        f"**In {len(found)} other comparisons** with the best rival (more scenes, an unseen "
        f"stretch, up to half an hour) a learned occupancy is {_standing(found)}, behind in "
        f"{behind or 'none'}. By method: {'; '.join(said)} "
        f"([all of them]({table_is}#{heading_anchor(TITLE)}))."
    )


def _standing(found: Sequence[Comparison]) -> str:
    """Such as "ahead in 2 of 6, undecided in 3, without a verdict in 1"."""
    counts = Counter(one.verdict.word for one in found)
    rest = [f"{word} in {counts[word]}" for word in ("level", "undecided") if counts[word]]
    rest += [f"without a verdict in {counts[None]}"] if counts[None] else []
    return ", ".join([f"ahead in {counts['ahead']} of {len(found)}", *rest])


def comparison_section(found: Sequence[Comparison]) -> list[str]:
    """All of them, for the page of measurements."""
    columns = "method, scene, time, seeds | learned | best rival | learned is | renders | "
    return [
        f"## {TITLE}\n",
        HEAD,
        "\n".join(table(f"{columns}taught grids", map(_row, found))) + "\n",
    ]


def _row(one: Comparison) -> list[str]:
    results, page = one.results, "suites.md" if one.results["suite"] else ""
    what = f"{one.host}, `{results['scene']['name']}`"
    if results.get("held_out", {}).get("test"):
        what += ", unseen stretch"
    where = f"{what}, {results['protocol']['seconds']:g} s, {describe_seeds(results)}"
    best = one.others[0]
    clear = min(len(best.runs), len(one.ours.runs)) > 1 and min(one.ours.psnrs) > max(best.psnrs)
    return [
        f"[{where}]({page}#{heading_anchor(one.title)}){star(one.chart)}",
        f"{one.ours.psnr:.1f} dB",
        f"{best.psnr:.1f} dB, {called(best, one.host)}",
        beside(one.ours, best) + (", each seed ahead" if clear else ""),
        faster(one.ours, best),
        "; ".join(
            f"{line.name.split()[-1]} {line.psnr:.1f} dB: {beside(one.ours, line)}"
            for line in one.taught
        ),
    ]


def called(line: Line, host: str) -> str:
    """What a row of a host is called beside it."""
    return line.name.removeprefix(host).lstrip(" +,")


def beside(ours: Line, other: Line) -> str:
    """How ours stands beside another row, such as "ahead by 2.8 ± 0.3 dB"."""
    found = compare(ours.psnrs, other.psnrs)
    if found.margin is None:
        return f"{found.difference:+.1f} dB, {found.by}"
    clear = found.word in ("ahead", "behind")
    how, by = ("by", abs(found.difference)) if clear else ("at", found.difference)
    return f"{found.word} {how} {by:.1f} ± {found.margin:.1f} dB"


def faster(ours: Line, other: Line) -> str:
    """How ours renders an image beside another row."""
    times = (other.median(RENDERING) or math.nan) / (ours.median(RENDERING) or math.nan)
    return f"{times:.1f} x as fast" if times >= 1.0 else f"in {1.0 / times:.1f} x the time"
