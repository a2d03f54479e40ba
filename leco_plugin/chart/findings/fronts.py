"""On which fronts occupancies are: of what each keeps, against its size and its learning time."""

from __future__ import annotations

from collections.abc import Sequence

from leco_plugin.chart.findings.representations import Representation

COSTS = {"size": "size", "learning time": "learn_seconds"}
"""Those on whose fronts representations are, and the figure of each in `Held`."""


def fronts_of(one: Representation, all_of_them: Sequence[Representation]) -> list[str]:
    """The names of the `COSTS` on whose fronts a representation is, which are those of medians."""
    return [
        name
        for name, figure in COSTS.items()
        if one.has(figure)
        and not any(other.leads(one, figure) for other in all_of_them if other.has(figure))
    ]


def verdict(representations: Sequence[Representation]) -> str:
    """Which of ours keeps least space or is on which front; and on a front where none is, what is
    ahead, always or mostly."""
    ours = [one for one in representations if one.ours]
    if not ours:
        return "our own gate has no figures here"
    fronts = {one.name: fronts_of(one, representations) for one in ours}
    least = min(representations, key=lambda one: one.kept)
    said = [_place_of(one, fronts[one.name], one is least) for one in reversed(ours)]
    for name, figure in COSTS.items():
        if not any(name in found for found in fronts.values()):
            said.append(f"in {name} {_ahead(ours[-1], representations, figure)}")
    return "; ".join(said)


def _place_of(one: Representation, fronts: Sequence[str], is_least: bool) -> str:
    """Where one of ours stands."""
    if is_least:
        return f"{one.name} keeps least space, {one.kept:.1f}% in {one.median('size'):.0f} kB"
    if not fronts:
        return f"{one.name} is on neither front"
    return f"{one.name} is on {'both fronts' if len(fronts) > 1 else f'the front of {fronts[0]}'}"


def _ahead(one: Representation, others: Sequence[Representation], figure: str) -> str:
    """What leads a representation and keeps least, and whether it does so with every seed."""
    leaders = [other for other in others if other.has(figure) and other.leads(one, figure)]
    best = min(leaders, key=lambda other: other.kept)
    always = best.leads_always(one, figure)
    return f"{best.name} is ahead" + ("" if always else ", not with every seed")
