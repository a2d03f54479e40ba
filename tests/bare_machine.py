"""The variables of a process on a machine that has just been set up."""

from __future__ import annotations

import os
from pathlib import Path


def variables(folder: Path) -> dict[str, str]:
    """Without network, without downloaded weights, on one core; in a folder of its own."""
    closed = "http://127.0.0.1:9"
    return os.environ | {
        "http_proxy": closed,
        "https_proxy": closed,
        "no_proxy": "",
        "TORCH_HOME": str(folder / "torch"),
        "OMP_NUM_THREADS": "1",
        "PYTHONUNBUFFERED": "1",
        "PYTHONWARNINGS": "default",
    }
