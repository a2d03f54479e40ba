"""Claims about what a gate may declare, and about an original that loses more than is allowed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from ball_occupancy import ball

from leco_plugin.capacity import shrink
from leco_plugin.capacity.evidence import Evidence, loss, unlikely_at
from leco_plugin.capacity.references import (
    HOLDS,
    Bounds,
    Ground,
    Part,
    Reference,
    declared,
    find_references,
    measure_original,
    pair_sides,
    verify,
)
from leco_plugin.capacity.search import MARGIN, kept_of_box, lower_threshold
from leco_plugin.capacity.sources import Source, draw_held_out
from leco_plugin.learning.calibration import THRESHOLDS
from leco_plugin.learning.freezing import HARDLY_ANYTHING
from leco_plugin.occupancy import Occupancy


def everywhere(occupancy: Occupancy, seed: int) -> Evidence:
    """Rays of two places of the ball's box, the second worth a hundredth of the first."""
    generator = torch.Generator().manual_seed(seed)
    positions = occupancy.space.unmap(2.0 * torch.rand(4000, 3, generator=generator) - 1.0)
    kept = occupancy.occupied(positions)
    worth = kept + 0.01 * ~kept
    return Evidence(positions, torch.arange(4000) // 2, kept, worth, worth, 2000)


def ground(*guided: bool) -> Ground:
    """References that value the same places, whether or not the original guides them."""
    known = ball()
    known = Occupancy(known.gate, known.space, known.threshold).eval()
    searched, unseen = (everywhere(known, seed) for seed in (1, 2))
    sides = Part(searched), Part(unseen)
    references = [
        Reference("known", None, 1e-4 * each, 0.0, 0.0, *sides, guided=each) for each in guided
    ]
    return Ground(known, searched, references)


def on_its_boundary() -> Ground:
    """Half of all worth is where the ball's gate is not sure of itself."""
    here = ground(True, False)
    unit = torch.rand(200_000, 3, generator=torch.Generator().manual_seed(3))
    positions = here.original.space.unmap(2.0 * unit - 1.0)
    values = here.original.query(positions)
    unsure = positions[(values > 1e-3) & (values < here.original.threshold)]
    sure = positions[values >= here.original.threshold]
    count = min(len(unsure), len(sure))
    together = torch.cat([unsure[:count], sure[:count]])
    each = torch.ones(2 * count)
    evidence = Evidence(together, torch.arange(2 * count), each.bool(), each, each, 2 * count)
    guided, absolute = here.references
    return here._replace(references=[guided, absolute._replace(search=Part(evidence))])


def lost_at(occupancy: Occupancy, evidence: Evidence, threshold: float) -> float:
    return loss(evidence, occupancy.query(evidence.positions) < threshold).share


def test_photographs_with_fewer_pixels_than_are_wanted_give_what_they_have(
    known: tuple[Source, Occupancy], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those of the search take what is left beside the held-out pixels: none is left to verify."""
    monkeypatch.setattr("leco_plugin.capacity.references.RAYS", 1 << 15)
    source, original = known
    sides = pair_sides(source, original, draw_held_out(source, original, 30))
    (reference,) = find_references(source, original, sides)
    searched, verified = reference.search.evidence, reference.verify.evidence
    assert 3000 < searched.rays <= 7 * 32 * 32 - 30 and verified.rays == 30
    assert int(searched.ray_indices.max()) < searched.rays and float(verified.worth.sum()) > 0.0


@pytest.mark.parametrize("part", [0.3, 0.7])
def test_the_threshold_is_the_largest_within_the_bound(part: float) -> None:
    here = on_its_boundary()
    searched = here.references[1].search.evidence
    allowed = part * lost_at(here.original, searched, here.original.threshold)
    lower = lower_threshold(here, Bounds(allowed / MARGIN))
    assert lower is not None
    meeting = [
        threshold
        for threshold in THRESHOLDS
        if threshold < here.original.threshold
        and lost_at(here.original, searched, threshold) <= allowed
    ]
    assert lower.threshold == pytest.approx(max(meeting))
    assert kept_of_box(lower) > kept_of_box(here.original) > 0.0


def test_the_threshold_is_lowered_until_its_image_price_is_within_the_bound_too(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Which here is a tenth of the threshold in dB."""
    price = "leco_plugin.capacity.references.image_price"
    monkeypatch.setattr(price, lambda mixture, rendered, gate: 0.1 * gate.threshold)
    here = ground(True, False)
    guided, absolute = here.references
    searched = Part(absolute.search.evidence, [object()])
    here = here._replace(references=[guided, absolute._replace(mixture=object(), search=searched)])
    lower = lower_threshold(here, Bounds(0.9, 0.02))
    assert lower is not None
    within = [threshold for threshold in THRESHOLDS if 0.1 * threshold <= 0.02]
    assert lower.threshold == pytest.approx(max(within))
    assert lower_threshold(here, Bounds(0.9, 0.0501)) is None


def test_an_original_stays_as_it_is_where_it_holds_nothing_measures_it_or_no_threshold_does() -> (
    None
):
    here = ground(True, False)
    lost = lost_at(here.original, here.references[1].search.evidence, here.original.threshold)
    assert lower_threshold(here, Bounds(1.01 * lost / MARGIN)) is None
    assert lower_threshold(ground(True), Bounds(1e-9)) is None
    assert lower_threshold(here, Bounds(1e-9)) is None


@pytest.mark.parametrize("skipped", [0.06, 0.04])
def test_smaller_gates_follow_the_lowered_original_if_it_skips_enough(
    skipped: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    here, drawn, asked = on_its_boundary(), ("sides", "taught"), list[float]()
    guided, absolute = here.references
    searched, count = guided.search.evidence, len(guided.search.evidence.kept)

    def prepare(source: object, original: Occupancy, *given: object) -> Ground:
        assert given == drawn
        asked.append(original.threshold)
        share = 0.5 if original is here.original else skipped
        kept = torch.arange(count) >= share * count
        now = guided._replace(search=Part(searched._replace(kept=kept)))
        return here._replace(original=original, references=[now, absolute])

    monkeypatch.setattr(shrink, "draw_rays", lambda *_: drawn)
    monkeypatch.setattr(shrink, "prepare", prepare)
    unsure = absolute.search.evidence
    bounds = Bounds(0.5 * lost_at(here.original, unsure, here.original.threshold) / MARGIN)
    known = lower_threshold(here, bounds)
    assert known is not None
    given = Source(None, None), here.original, Path("it"), bounds
    if skipped < HARDLY_ANYTHING:
        with pytest.raises(ValueError, match=r"it is within .* skips 4\.0% of all candidates"):
            shrink._meet_bounds(*given)
    else:
        found, itself, lowered = shrink._meet_bounds(*given)
        assert found.original.threshold == known.threshold
        ratio = kept_of_box(known) / kept_of_box(here.original)
        expected = {"from": here.original.threshold, "to": known.threshold, "kept_volume": ratio}
        assert lowered == pytest.approx(expected, abs=1e-4) and ratio > 1.01
        lost = lost_at(known, unsure, known.threshold)
        assert itself.lost_surface_mass == pytest.approx(lost) and lost > 1e-3
    assert asked == [here.original.threshold, known.threshold]


def test_an_original_that_guides_its_reference_loses_what_it_declares() -> None:
    here = ground(True)
    itself = measure_original(here, Bounds(2e-4))
    assert not here.measures_original and itself.verdict == HOLDS
    assert itself.lost_surface_mass == itself.bound == 1e-4


def test_an_original_is_measured_where_all_candidates_are_rendered() -> None:
    here = ground(True, False)
    searched, unseen = (
        loss(part.evidence, ~part.evidence.kept, unlikely_at(1))
        for part in (here.references[1].search, here.references[1].verify)
    )
    assert here.measures_original and searched.share > 1e-2
    itself = measure_original(here, Bounds(0.9))
    assert itself.verdict == HOLDS and itself.bound == pytest.approx(searched.bound)
    assert measure_original(here, Bounds(searched.share)).verdict != HOLDS
    fourth = replace(itself)
    for rung, look in ((itself, 1), (fourth, 4)):
        assert verify(here, here.original, Bounds(0.9), rung, look)
    declared = itself.verified["lost_surface_mass_bound"]
    assert declared == pytest.approx(max(searched.bound, unseen.bound))
    assert float(fourth.verified["lost_surface_mass_bound"] or 0.0) > float(declared or 1.0)


def test_what_a_gate_skips_and_drops_is_counted_on_rays_that_the_search_did_not_see() -> None:
    here = ground(True, False)
    raised, rung = here.original.with_threshold(0.95), measure_original(here, Bounds(0.9))
    first = here.references[0].verify.evidence
    skipped = here.original.query(first.positions) < 0.95
    verify(here, raised, Bounds(0.9), rung, 3)
    dropped = float((skipped & first.kept).sum()) / float(first.kept.sum())
    assert rung.look == 3 and rung.verified["empty_fraction"] == float(skipped.double().mean())
    assert rung.verified["kept_candidates_dropped"] == pytest.approx(dropped) and dropped > 0.0
    sides = [loss(one.verify.evidence, skipped) for one in here.references]
    lost = [one.lost_before + side.share for one, side in zip(here.references, sides)]
    assert rung.verified["lost_surface_mass"] == pytest.approx(max(lost))
    assert [one["lost_surface_mass"] for one in rung.verified_against] == pytest.approx(lost)


@pytest.mark.parametrize(
    ("bound", "price", "allowed"),
    [
        *((1e-3, 0.05, True), (1e-3, None, True), (1.01e-3, None, False)),
        *((1e-4, 0.051, False), (1.01e-3, 0.01, False), (0.0, -1.0, True)),
    ],
)
def test_bounds_hold_what_lies_on_them(bound: float, price: float | None, allowed: bool) -> None:
    assert Bounds().allow(bound, price) is allowed


def test_a_declared_gain_is_no_licence_to_lose_it_again() -> None:
    made: Any = SimpleNamespace(report={"a": 0.25, "b": -0.5, "c": None, "d": 1})
    assert [declared(made, name) for name in "abcde"] == [0.25, 0.0, 0.0, 1.0, 0.0]


def test_its_image_price_is_the_worst_that_any_reference_measures_on_either_side(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """What is rendered stands for what another gate costs there."""
    monkeypatch.setattr(
        "leco_plugin.capacity.references.image_price", lambda _, costs, __: costs[0]
    )
    seen = ground(True).references[0]
    rendering = seen._replace(mixture=object())
    known = [
        rendering._replace(
            price_before=before,
            search=Part(seen.search.evidence, [on_search]),
            verify=Part(seen.verify.evidence, [on_verify]),
        )
        for before, on_search, on_verify in ((0.01, 0.07, 0.02), (0.05, 0.0, 0.01))
    ]
    here = ground(True)._replace(references=[*known, rendering._replace(price_before=9.0), seen])
    other = here.original.with_threshold(0.4)
    assert [here.price(other, side) for side in ("search", "verify")] == pytest.approx([0.08, 0.06])
    assert here.price(here.original, "search") == 0.05  # the original guides, so none is asked
    rung = measure_original(here, Bounds(0.9, 0.05))
    assert rung.verdict == HOLDS and rung.image_price_db == 0.05
    for references in (
        known,
        [one._replace(search=one.verify, verify=one.search) for one in known],
    ):
        sides = here._replace(references=references)
        assert verify(sides, other, Bounds(0.9, 0.081), rung, 1)
        assert rung.verified["image_price_db"] == pytest.approx(0.08)
        assert not verify(sides, other, Bounds(0.9, 0.079), rung, 1)
    assert here._replace(references=[]).price(here.original, "search") is None
    assert here._replace(references=[seen]).price(other, "search") is None
