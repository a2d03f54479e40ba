"""What was recorded before the house was rebuilt still holds."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from leco_plugin.occupancy import Occupancy

FILE = Path(__file__).parent / "data" / "occupancy.safetensors"
"""Written on 25 November 2026, from six steps on a drone survey."""


def test_an_occupancy_of_then_opens_and_answers_as_it_did() -> None:
    occupancy = Occupancy.load(FILE)
    assert occupancy.threshold == pytest.approx(0.0805306, rel=1e-5)
    assert occupancy.space.kind == "box" and occupancy.precision == "float32"
    assert occupancy.report["empty_fraction"] == pytest.approx(0.00233310, rel=1e-5)
    drawn = torch.rand(6, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    space = occupancy.space
    positions = drawn * float(space.half_extent) + space.center
    expected = torch.tensor([0.0, 0.0, 0.113959, 0.0930476, 0.0, 0.0])
    torch.testing.assert_close(occupancy.query(positions), expected, atol=1e-5, rtol=1e-4)
