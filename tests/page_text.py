"""What pages of plotly hold, which they carry compressed."""

from __future__ import annotations

import base64
import gzip
from pathlib import Path


def figure_text(page: Path) -> str:
    """The figure in a page, as JSON."""
    packed = page.read_text().split('id="shown">')[1].split("<")[0]
    return gzip.decompress(base64.b64decode(packed)).decode()
