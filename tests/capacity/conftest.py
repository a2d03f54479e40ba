"""Small sizes, which all tests of this room share."""

from __future__ import annotations

import pytest

from leco_plugin.capacity import gates, references, search


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few steps and positions, and no more rays than tiny photographs can give."""
    monkeypatch.setattr(references, "RAYS", 1500)
    monkeypatch.setattr(search, "STEPS", 200)
    monkeypatch.setattr(search, "VOLUME_POINTS", 1 << 14)
    monkeypatch.setattr(search, "TAUGHT_POINTS", 1 << 14)
    monkeypatch.setattr(gates, "BATCH", 4096)
