"""The variables of a process on a machine that has just been set up."""

from __future__ import annotations

import os
import shutil
from pathlib import Path


def variables(folder: Path) -> dict[str, str]:
    """Without network, without downloaded weights, on one core; in a folder of its own."""
    closed = "http://127.0.0.1:9"
    found = os.environ | {
        "http_proxy": closed,
        "https_proxy": closed,
        "no_proxy": "",
        "TORCH_HOME": str(folder / "torch"),
        "OMP_NUM_THREADS": "1",
        "PYTHONUNBUFFERED": "1",
        "PYTHONWARNINGS": "default",
    }
    if shutil.which("ffmpeg") is None:
        # ns-render looks for ffmpeg even where it writes images, which do not need it.
        stand_in = folder / "bin" / "ffmpeg"
        stand_in.parent.mkdir()
        stand_in.write_text("#!/bin/sh\nexit 1\n")
        stand_in.chmod(0o755)
        found["PATH"] = f"{stand_in.parent}{os.pathsep}{found['PATH']}"
    return found
