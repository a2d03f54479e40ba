"""Claims about gates of growing size, and the search: the first that holds, by unseen rays."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from ball_occupancy import CENTRE, HALF, RADIUS, ball

from leco_plugin.capacity import search as searching
from leco_plugin.capacity.choice import NAMES
from leco_plugin.capacity.evidence import Evidence, Loss
from leco_plugin.capacity.references import (
    Bounds,
    Ground,
    Part,
    Reference,
    Rung,
    declared,
    verify,
)
from leco_plugin.capacity.search import (
    Found,
    find_threshold,
    gates,
    grids,
    ladder,
    name_of,
    search,
    values_of,
)
from leco_plugin.capacity.shrink import check_losses
from leco_plugin.capacity.sources import Source
from leco_plugin.evaluation.inspection import in_parts, whole_box
from leco_plugin.models.encodings import EncodingConfig
from leco_plugin.models.gate import Gate, GateConfig, check_sizes
from leco_plugin.occupancy import Occupancy
from leco_plugin.space import Space

NOBODY, FILE = Source(None, None), Path("occupancy.safetensors")
TOO_SMALL = GateConfig(EncodingConfig(octaves=1), 1, 1, 1)
ENOUGH = GateConfig(EncodingConfig(octaves=2), 16, 2, 1)


def original(**report: object) -> Occupancy:
    known = ball()
    return Occupancy(known.gate, known.space, known.threshold, report=report).eval()


def known_worth(occupancy: Occupancy, seed: int) -> Evidence:
    """Rays of a place in the ball, the deeper the more it is worth, and one anywhere in its box."""
    generator = torch.Generator().manual_seed(seed)
    anywhere, along = 2.0 * torch.rand(2, 10_000, 3, generator=generator) - 1
    depth = torch.rand(10_000, 1, generator=generator) ** (1 / 3)
    inside = RADIUS * depth * along / along.norm(dim=-1, keepdim=True)
    positions = torch.tensor(CENTRE) + torch.stack([inside, HALF * anywhere], dim=1).view(-1, 3)
    kept = occupancy.occupied(positions)
    inward = (1.0 - (positions - torch.tensor(CENTRE)).norm(dim=-1)).clamp(min=0.0)
    worth = inward * kept
    return Evidence(positions, torch.arange(20_000) // 2, kept, worth, worth, 10_000)


def ground(occupancy: Occupancy, verify: Evidence | None = None) -> Ground:
    taught, searched, unseen = (known_worth(occupancy, seed) for seed in range(3))
    lost, price = (declared(occupancy, name) for name in ("lost_surface_mass", "image_price_db"))
    sides = Part(searched), Part(verify or unseen)
    return Ground(occupancy, taught, [Reference("known", None, lost, 0.0, max(price, 0.0), *sides)])


def walk(occupancy: Occupancy, gates: list[GateConfig], **options: object) -> Found:
    return search(ground(occupancy), Bounds(**options), gates)


def test_it_stops_at_the_first_gate_that_holds() -> None:
    seen: list[Rung] = []
    shares: list[float] = []
    found = search(
        ground(original()),
        Bounds(3e-3),
        [TOO_SMALL, ENOUGH, replace(ENOUGH, width=32)],
        seen.append,
        shares.append,
    )
    verdicts = [rung.verdict for rung in found.rungs]
    assert len(verdicts) == 2 and verdicts[0] != "chosen" and verdicts[1] == "chosen"
    assert seen == found.rungs and shares[-1] == pytest.approx(2 / 3)
    assert found.occupancy is not None and found.occupancy.gate.config == ENOUGH


def test_the_chosen_gate_keeps_about_as_much_and_loses_what_it_says() -> None:
    known = original()
    found = walk(known, [ENOUGH], lost_surface_mass=3e-3)
    assert found.occupancy is not None
    rung = found.rungs[-1]
    assert 0.95 <= rung.kept_volume <= 1.055
    fresh = known_worth(known, 77)
    lost = fresh.worth[~found.occupancy.occupied(fresh.positions)].sum() / fresh.worth.sum()
    assert float(lost) <= rung.verified["lost_surface_mass_bound"] <= 3e-3
    for parameter in found.occupancy.gate.parameters():
        assert torch.equal(parameter, parameter.bfloat16().float())


def test_what_fails_on_unseen_rays_is_not_chosen() -> None:
    known = original()
    unseen = known_worth(known, 2)
    # everything that is worth something lies where no gate of the original's volume keeps it
    far = (unseen.positions - torch.tensor(CENTRE)).norm(dim=-1) > 1.3
    found = search(ground(known, unseen._replace(worth=far.float())), Bounds(3e-3), [ENOUGH])
    assert found.occupancy is None
    assert [rung.verdict for rung in found.rungs] == ["fails on unseen rays"]


def test_each_look_at_unseen_rays_widens_the_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(searching, "LONGER", 1)
    known = original()
    unseen = known_worth(known, 2)
    far = (unseen.positions - torch.tensor(CENTRE)).norm(dim=-1) > 1.3
    nobody = ground(known, unseen._replace(worth=far.float()))
    rungs = search(nobody, Bounds(4e-3), [TOO_SMALL, ENOUGH]).rungs
    # a gate that fails there was taught twice, and looked at twice
    assert [rung.look for rung in rungs] == [None, 2]
    (alone,) = walk(known, [ENOUGH], lost_surface_mass=4e-3).rungs
    assert alone.look == 1
    later = replace(alone)
    found = Occupancy(known.gate, known.space, known.threshold).eval()
    for rung, look in ((alone, 1), (later, 7)):
        verify(ground(known), found, Bounds(4e-3), rung, look)
    bounds = [float(rung.verified["lost_surface_mass_bound"] or 0.0) for rung in (alone, later)]
    assert 0.0 < bounds[0] < bounds[1]


def test_a_loss_that_the_search_has_seen_is_declared_too() -> None:
    known = original()
    here = ground(known)
    (reference,) = here.references
    nothing = reference.verify.evidence
    inside = (nothing.positions - torch.tensor(CENTRE)).norm(dim=-1) < 0.5  # no gate loses these
    harmless = reference._replace(verify=Part(nothing._replace(worth=inside.float())))
    (found,) = search(here._replace(references=[harmless]), Bounds(4e-3), [ENOUGH]).rungs
    assert found.verified["lost_surface_mass"] == 0.0
    assert float(found.verified["lost_surface_mass_bound"] or 0.0) > found.lost_surface_mass > 0.0


def test_nothing_is_lost_beyond_what_the_original_leaves() -> None:
    """Each loss is held to its own bound, on which nothing is left."""
    for name, bound, said in (
        (
            "lost_surface_mass",
            1e-3,
            "mass of 1.00e-03, which leaves nothing of 0.001: raise --lost",
        ),
        ("lost_decisions", 1e-3, "1.00e-03 of the decisions, which leaves nothing of 0.001: raise"),
        ("image_price_db", 0.05, "of 0.050 dB, which leaves nothing of 0.05: raise --image-price"),
    ):
        with pytest.raises(ValueError, match=said):
            check_losses(NOBODY, original(**{name: bound}), FILE, Bounds())
        check_losses(NOBODY, original(**{name: 0.99 * bound}), FILE, Bounds())
    with pytest.raises(ValueError, match="surface mass of nan, which leaves nothing"):
        check_losses(NOBODY, original(lost_surface_mass=float("nan")), FILE, Bounds())
    check_losses(NOBODY, original(image_price_db=-0.1), FILE, Bounds())


def test_what_the_original_has_lost_is_declared_too() -> None:
    first, second = (
        walk(original(lost_surface_mass=lost), [ENOUGH], lost_surface_mass=4e-3).rungs[-1]
        for lost in (0.0, 2e-4)
    )
    for name in ("lost_surface_mass", "lost_surface_mass_bound"):
        more = float(second.verified[name] or 0.0) - float(first.verified[name] or 0.0)
        assert more == pytest.approx(2e-4, rel=1e-3)
    assert second.lost_surface_mass == pytest.approx(first.lost_surface_mass + 2e-4)


def test_the_worst_reference_decides_and_is_declared() -> None:
    """The second one values a place that no gate of the original's volume keeps."""
    known = original()
    here = ground(known)
    kind = here.references[0]
    unseen = kind.verify.evidence
    far = (unseen.positions - torch.tensor(CENTRE)).norm(dim=-1) > 1.3
    strict = kind._replace(
        name="strict", verify=Part(unseen._replace(worth=unseen.worth + 1e-4 * far.float()))
    )
    both = here._replace(references=[kind, strict])
    (lenient,), (found,) = (search(one, Bounds(4e-3), [ENOUGH]).rungs for one in (here, both))
    assert [one["reference"] for one in found.verified_against] == ["known", "strict"]
    bounds = [float(one["bound"]) for one in found.verified_against]
    assert bounds[1] > bounds[0] == pytest.approx(lenient.verified["lost_surface_mass_bound"])
    assert found.verified["lost_surface_mass_bound"] == bounds[1]
    all_of_it = strict._replace(verify=Part(unseen._replace(worth=far.float())))
    refused = search(here._replace(references=[kind, all_of_it]), Bounds(4e-3), [ENOUGH])
    assert [rung.verdict for rung in refused.rungs] == ["fails on unseen rays"]


def test_a_threshold_that_keeps_a_share_keeps_it() -> None:
    scores = torch.randperm(1000).float()
    for share in (0.001, 0.1, 0.5, 1.0):
        assert float((scores >= find_threshold(scores, share)).float().mean()) == pytest.approx(
            share
        )


@pytest.mark.parametrize("kind", ["box", "contraction"])
def test_places_are_spread_evenly_and_decided_by_their_seed(kind: Any) -> None:
    known = Occupancy(ball().gate, Space(kind, CENTRE, HALF), 0.5)
    one, same, other = (searching.spread_positions(known, 4000, seed) for seed in (1, 1, 2))
    assert torch.equal(one, same) and not torch.equal(one, other)
    counts = [torch.histc(along, 8, -1.0, 1.0) for along in known.space.map(one).T]
    torch.testing.assert_close(torch.stack(counts), torch.full((3, 8), 500.0), atol=125.0, rtol=0.0)


def test_places_anywhere_are_taught_too() -> None:
    known = original()
    lesson = searching.lesson_of(known, known_worth(known, 0))
    assert len(lesson.mapped) == 20_000 + (1 << 14)
    inside = in_parts(known.query, known.space.unmap(lesson.mapped)) >= known.threshold
    assert float((inside == (lesson.keep > 0)).float().mean()) > 0.999
    known_worths = known_worth(known, 0)
    times = 1.0 + 8.0 * (known_worths.weights / 0.05).clamp(max=1.0)
    torch.testing.assert_close(lesson.keep[:20_000], known_worths.kept * times)
    assert set(lesson.keep[20_000:].tolist()) == {0.0, 1.0}
    torch.testing.assert_close(lesson.skip, (lesson.keep == 0.0).float())
    assert float(lesson.keep.max()) > 1.5 and whole_box(known).low.tolist() == [-1.0, 0.0, -1.5]


@pytest.mark.parametrize(
    ("share", "bound", "before", "price", "kept", "verdict"),
    [
        (5e-4, 1e-3, 0.0, 0.05, 1.0, "chosen"),
        (5.01e-4, 9e-4, 0.0, None, 1.0, "loses too much"),
        (5.9e-4, 9e-4, 2e-4, None, 1.0, "chosen"),  # half of what was lost before is added
        (6.1e-4, 9e-4, 2e-4, None, 1.0, "loses too much"),
        (1e-4, 1.01e-3, 0.0, None, 1.0, "loses too much"),
        (1e-4, 2e-4, 0.0, 0.051, 1.0, "costs too much of the image"),
        (1e-4, 2e-4, 0.0, None, 0.95, "chosen"),
        (1e-4, 2e-4, 0.0, None, 0.94, "keeps too much"),
    ],
)
def test_a_gate_is_within_half_of_the_bound_at_about_the_volume_of_the_original(
    share: float,
    bound: float,
    before: float,
    price: float | None,
    kept: float,
    verdict: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It has one score everywhere, and keeps all of the volume of which the original keeps some."""
    found, looks = Loss(share, bound, 0.0), []
    monkeypatch.setattr(searching, "verify", lambda *given: looks.append(given[-1]) or True)
    gate = Occupancy(ball().gate, ball().space, 0.1).eval()
    monkeypatch.setattr(gate, "query", lambda places: torch.full((len(places),), 0.25))
    known: Any = SimpleNamespace(
        references=[SimpleNamespace(lost_before=before)],
        price=lambda *_: price,
        scores=lambda *_: [],
        losses=lambda *_: [found],
    )
    rung, placed = searching._measure(known, gate, Bounds(1e-3), torch.zeros(50, 3), kept, 3)
    assert (rung.verdict, rung.lost_surface_mass) == (verdict, share)
    assert placed.threshold == 0.25 and rung.kept_volume == pytest.approx(1.0 / kept, abs=1e-4)
    assert rung.bytes == 2 * rung.params and looks == [3] * (verdict == "chosen")


def test_a_gate_that_nearly_holds_is_taught_for_longer(monkeypatch: pytest.MonkeyPatch) -> None:
    """And one that is far from it is not, which is most of the time of a search."""
    taught: list[tuple[int, int]] = []
    real = searching.teach

    def teach(config: GateConfig, lesson: object, steps: int, *rest: object, **named: object):
        taught.append((config.width, steps))
        return real(config, lesson, 20 if config.width == ENOUGH.width else steps, *rest, **named)

    monkeypatch.setattr(searching, "teach", teach)
    loss_of = {TOO_SMALL.width: 0.5, ENOUGH.width: 1e-3}
    measured = searching._measure

    def known_loss(known: Ground, gate: Occupancy, *rest: object) -> tuple[Rung, Occupancy]:
        rung, placed = measured(known, gate, *rest)
        assert placed.gate is gate.gate and gate.threshold == 0.5  # which it is given by nobody
        lost = loss_of[gate.gate.config.width]
        return replace(rung, lost_surface_mass=lost, verdict="loses too much"), placed

    monkeypatch.setattr(searching, "_measure", known_loss)
    shares: list[float] = []
    search(ground(original()), Bounds(1e-3), [TOO_SMALL, ENOUGH], on_progress=shares.append)
    steps = searching.STEPS
    once, longer = (ENOUGH.width, steps), (ENOUGH.width, searching.LONGER * steps)
    assert taught == [(TOO_SMALL.width, steps), once, longer]
    assert shares == sorted(shares) and shares[-1] == 1.0


def test_it_goes_from_small_to_large_and_stays_below_the_original() -> None:
    gates = ladder(values_of(GateConfig()))
    sizes = [values_of(gate) for gate in gates]
    assert sizes == sorted(sizes) and sizes[0] < 300 and sizes[-1] < values_of(GateConfig())
    assert {gate.encoding.kind for gate in gates} == {"frequency", "hash", "vm", "k-planes"}
    assert len({name_of(gate) for gate in gates}) == len(gates)


def test_gates_of_few_octaves_on_hash_grids_and_on_planes_have_a_norm() -> None:
    for gate in ladder(10**9):
        many = gate.encoding.kind == "frequency" and gate.encoding.octaves >= 5
        assert gate.normed == (not many)


def test_gates_on_hash_grids_are_those_of_the_capacity_page_and_below() -> None:
    tables = [gate for gate in ladder(10**9) if gate.encoding.kind == "hash"]
    measured = [candidate.gate for candidate in gates() if candidate.family == "hash"]
    assert [gate.encoding.log2_table for gate in tables] == [6, 7, 8]
    assert tables[-1] == measured[0]


def test_each_can_be_built_and_saved() -> None:
    for gate in ladder(10**9):
        check_sizes(gate)
        assert values_of(gate) == sum(p.numel() for p in Gate(gate).parameters())


def test_every_family_grows() -> None:
    candidates = gates() + grids((64, 32))
    assert {candidate.family for candidate in candidates} == set(NAMES)
    assert len({candidate.key for candidate in candidates}) == len(candidates)
    for family in NAMES:
        sizes = [candidate.bytes for candidate in candidates if candidate.family == family]
        assert sizes == sorted(sizes) and sizes[-1] > 2 * sizes[0]
    assert grids((32,))[0].bytes == 32**3 / 8
    for candidate in gates():
        assert candidate.gate is not None
        check_sizes(candidate.gate)
