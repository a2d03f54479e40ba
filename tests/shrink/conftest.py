"""What all tests of smaller gates share."""

from __future__ import annotations

import pytest

from leco_plugin.shrink import references


@pytest.fixture(autouse=True)
def fewer_rays(monkeypatch: pytest.MonkeyPatch) -> None:
    """As many as tiny photographs can give without being asked for again and again."""
    monkeypatch.setattr(references, "RAYS", 1500)
