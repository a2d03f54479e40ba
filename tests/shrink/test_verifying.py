"""Claims about what a gate may declare, the original among them."""

from __future__ import annotations

from dataclasses import replace

import pytest
from valued_ball import ground

from leco_plugin.shrink.evidence import loss, unlikely_at
from leco_plugin.shrink.rungs import Bounds
from leco_plugin.shrink.verifying import HOLDS, is_measured, of_original, verify


def test_an_original_that_guides_its_reference_loses_what_it_declares() -> None:
    here = ground(True)
    itself = of_original(here, Bounds(2e-4))
    assert not is_measured(here) and itself.verdict == HOLDS
    assert itself.lost_surface_mass == itself.bound == 1e-4


def test_an_original_is_measured_where_all_candidates_are_rendered() -> None:
    here = ground(True, False)
    searched, unseen = (
        loss(part.evidence, ~part.evidence.kept, unlikely_at(1))
        for part in (here.references[1].search, here.references[1].verify)
    )
    assert is_measured(here) and searched.share > 1e-2
    itself = of_original(here, Bounds(0.9))
    assert itself.verdict == HOLDS and itself.bound == pytest.approx(searched.bound)
    assert of_original(here, Bounds(searched.share)).verdict != HOLDS
    fourth = replace(itself)
    for rung, look in ((itself, 1), (fourth, 4)):
        assert verify(here, here.original, Bounds(0.9), rung, look)
    declared = itself.verified["lost_surface_mass_bound"]
    assert declared == pytest.approx(max(searched.bound, unseen.bound))
    assert float(fourth.verified["lost_surface_mass_bound"] or 0.0) > float(declared or 1.0)
