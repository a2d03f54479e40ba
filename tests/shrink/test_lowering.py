"""Claims about an original that loses more than the search allows."""

from __future__ import annotations

import pytest
import torch
from valued_ball import ground

from leco_plugin.learning.calibration import THRESHOLDS
from leco_plugin.occupancy import Occupancy
from leco_plugin.shrink.evidence import Evidence, loss
from leco_plugin.shrink.lowering import facts_of, lowered
from leco_plugin.shrink.references import Part
from leco_plugin.shrink.rungs import Bounds, Ground
from leco_plugin.shrink.search import MARGIN


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


@pytest.mark.parametrize("part", [0.3, 0.7])
def test_it_is_shrunk_at_the_largest_threshold_that_loses_no_more_than_a_smaller_gate_may(
    part: float,
) -> None:
    here = on_its_boundary()
    searched = here.references[1].search.evidence
    allowed = part * lost_at(here.original, searched, here.original.threshold)
    lower = lowered(here, Bounds(allowed / MARGIN))
    assert lower is not None
    meeting = [
        threshold
        for threshold in THRESHOLDS
        if threshold < here.original.threshold
        and lost_at(here.original, searched, threshold) <= allowed
    ]
    assert lower.threshold == pytest.approx(max(meeting))
    facts = facts_of(here.original, lower)
    assert facts["kept_volume"] > 1.0 and facts["from"] > facts["to"] == lower.threshold


def test_one_that_meets_it_is_shrunk_as_it_is() -> None:
    here = ground(True, False)
    lost = lost_at(here.original, here.references[1].search.evidence, here.original.threshold)
    assert lowered(here, Bounds(1.01 * lost / MARGIN)) is None


def test_where_nothing_measures_the_original_it_stays_as_it_is() -> None:
    assert lowered(ground(True), Bounds(1e-9)) is None


def test_where_no_threshold_meets_it_there_is_none() -> None:
    assert lowered(ground(True, False), Bounds(1e-9)) is None
