"""On which fronts occupancies are: of what each keeps, against its size and its learning time."""

from __future__ import annotations

from collections.abc import Sequence

from leco_plugin.chart.findings.representations import Representation

COSTS = {"size": "size", "learning time": "learn_seconds"}
"""Those on whose fronts representations are, and the figure of each in `Held`."""
CHEAPEST = {"size": "smallest", "learning time": "soonest learned"}
"""What is said of who is on a front because nothing costs less."""


def fronts_of(one: Representation, all_of_them: Sequence[Representation]) -> list[str]:
    """The names of the `COSTS` on whose fronts a representation is, which are those of medians."""
    return [
        name
        for name, figure in COSTS.items()
        if one.has(figure)
        and not any(other.leads(one, figure) for other in all_of_them if other.has(figure))
    ]


def verdict(representations: Sequence[Representation]) -> str:
    """Where each of ours stands, and what is ahead of the gate that a run learns and writes on each
    front that it is not on."""
    ours = [one for one in representations if one.ours]
    if not ours:
        return "our own gate was not frozen with every seed"
    learned, *small = ours
    said = [_place_of(one, representations) or f"{one.name} is on neither front" for one in small]
    fronts = fronts_of(learned, representations)
    behind = [
        f"behind {_ahead(learned, representations, figure)} in {name}"
        for name, figure in COSTS.items()
        if name not in fronts
    ]
    place = _place_of(learned, representations)
    if behind:
        place = f"{place or f'{learned.name} is'}{', ' if place else ' '}{', '.join(behind)}"
    return "; ".join([*said, place])


def _place_of(one: Representation, all_of_them: Sequence[Representation]) -> str:
    """Where one of ours stands, if it is on a front: whoever costs least is, whatever it keeps."""
    if one is min(all_of_them, key=lambda other: other.kept):
        return f"{one.name} keeps least space, {one.kept:.1f}% in {one.median('size'):.0f} kB"
    fronts = fronts_of(one, all_of_them)
    by_cost = [name for name in fronts if _costs_least(one, all_of_them, COSTS[name])]
    by_space = [name for name in fronts if name not in by_cost]
    said = [f"the {CHEAPEST[name]}" for name in by_cost]
    if by_space:
        said.append("on both fronts" if len(by_space) > 1 else f"on the front of {by_space[0]}")
    return f"{one.name} is {' and '.join(said)}" if said else ""


def _costs_least(one: Representation, others: Sequence[Representation], figure: str) -> bool:
    """Whether nothing that is beside it costs as little."""
    return all(
        other is one or other.median(figure) > one.median(figure)
        for other in others
        if other.has(figure)
    )


def _ahead(one: Representation, others: Sequence[Representation], figure: str) -> str:
    """What leads a representation and keeps least, and whether it does so with every seed."""
    leaders = [other for other in others if other.has(figure) and other.leads(one, figure)]
    best = min(leaders, key=lambda other: other.kept)
    always = best.leads_always(one, figure)
    return best.name + ("" if always else " (not with every seed)")
