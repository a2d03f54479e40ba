"""The eight questions of the paper's reviewers, each answered in some three sentences."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import checkout  # noqa: F401
from answers import in_short, scenes_of
from chart_sections import by_scene, longer, notes
from growth_picture import cities, finding
from page_parts import heading_anchor, size, span
from sizes_tables import chosen_of

from leco_plugin.chart.learned import last_gain, still_rising
from leco_plugin.chart.panels import finding_of
from leco_plugin.chart.representations import (
    SMALL_OURS,
    Representation,
    representations_of,
)
from leco_plugin.chart.summary import Line, lines_of

Reports = Mapping[str, Any]
"""Results of `leco capacity`, by scene."""


def eight_answers(reports: Reports) -> list[str]:
    """A list for `docs/results.md`; of a question whose suite is not stored, that it is open."""
    found = [
        ("Is a small MLP the best place for an occupancy?", "representations", _places),
        ("How long does learning it take?", "representations", _seconds),
        ("Why must the empty-space expert be small?", "empty-expert", _size_of_the_empty),
        ("Why freeze, and go on with the same network?", "freeze", _freezing),
        ("Does it pay at equal time, and with enough?", "enough-time", _enough),
        ("What if there is no empty-space expert?", "empty-expert", _no_empty),
    ]
    said = []
    for question, suite, answer in found:
        charts = by_scene(suite)
        mark = " (*)" if any(name in notes() for name, _ in charts.values()) else ""
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


def _held(charts: Sequence[Mapping[str, Any]]) -> list[list[Representation]]:
    return [representations_of(lines_of(results)) for results in charts]


def _places(charts: Sequence[Mapping[str, Any]]) -> str:
    held = _held(charts)
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
            smallest, largest = sorted((one.median("size") for _, one in pairs))[:: len(pairs) - 1]
            parts.append(
                f"{name} of {size(smallest)} to {size(largest)} keep {times} times as much"
            )
    return (
        f"None is best everywhere. A small MLP of {span(one.median('size') for one in small)} kB "
        f"that the trained field has taught keeps {span(one.kept for one in small)}% of the space "
        f"in {scenes_of(charts)}; {', '.join(parts)}."
    )


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


def _psnrs(charts: Sequence[Mapping[str, Any]], name: str) -> list[float]:
    """Mean PSNR of a row in each chart."""
    return [_row(lines_of(results), name).psnr for results in charts]


def _row(lines: Sequence[Line], name: str) -> Line:
    return next(line for line in lines if line.name == name)


def _above(charts: Sequence[Mapping[str, Any]], one: str, other: str) -> str:
    """By how many dB the mean of a row is above that of another, from scene to scene."""
    pairs = zip(_psnrs(charts, one), _psnrs(charts, other))
    return f"{span((ours - theirs for ours, theirs in pairs), '+.1f')} dB"


def _size_of_the_empty(charts: Sequence[Mapping[str, Any]]) -> str:
    by_paper = _above(charts, "imbalance loss alone, identity", "imbalance loss alone, large")
    return (
        f"With the loss of the paper's abstract alone an identity ends {by_paper} above an expert "
        f"of the scene's size, as in its table. With ours the size makes no difference that three "
        f"seeds show. {in_short(charts)}"
    )


def _freezing(charts: Sequence[Mapping[str, Any]]) -> str:
    on, scratch = "learn, freeze, go on", "learn, freeze, from scratch"
    return (
        f"Going on ends {_above(charts, on, scratch)} above a start from scratch, and "
        f"{_above(charts, on, 'never frozen')} above a gate that is never frozen. "
        f"{in_short(charts)}"
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
            f"{found[0].lower()}{found[1:]}; in the last third it gained {gained:.1f} dB "
            f"([figures](suites.md#{heading_anchor(title)}))."
        )
    return " ".join(said)


def _no_empty(charts: Sequence[Mapping[str, Any]]) -> str:
    ours, none = "identity (ours)", "none: density is zero"
    worst = max(
        _row(lines_of(results), ours).psnr - min(_row(lines_of(results), none).psnrs)
        for results in charts
    )
    return (
        "Then density is zero where the gate says empty, and nothing corrects a gate that is "
        f"wrong. The identity ends {_above(charts, ours, none)} above that on {scenes_of(charts)}; "
        f"one run without it ended {worst:.1f} dB below."
    )


def _scenes(reports: Reports) -> str:
    kept = {name: chosen_of(report)[0]["kept_volume"] for name, report in reports.items()}
    full = max(kept, key=lambda name: kept[name])
    return (
        f"{finding(cities(reports))} It pays least where a scene fills its box: on `{full}` the "
        f"gate keeps {kept[full]:.0%}."
    )
