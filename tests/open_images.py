"""The mark of tests in which nerfstudio leaves images open whose size it has read."""

from __future__ import annotations

import pytest

OPEN_IMAGES = pytest.mark.filterwarnings(
    "ignore:unclosed file:ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning"
)
