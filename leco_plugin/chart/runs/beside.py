"""Representations that are made of a run's field, and compared with the gate that learned it."""

from __future__ import annotations

import time
from typing import Any

from leco_plugin.capacity.field import lesson_by
from leco_plugin.capacity.measuring import Candidate, taught_score
from leco_plugin.chart.contenders.contender import Contender
from leco_plugin.evaluation.equal_loss import at_equal_loss
from leco_plugin.models.encodings import EncodingConfig
from leco_plugin.models.freezing.held_out_rendering import evaluating
from leco_plugin.models.gate import GateConfig
from leco_plugin.models.leco import LecoModel
from leco_plugin.shrink.sources import Source

SMALL = {
    "MLP": Candidate("frequency", "6-32-2", GateConfig(EncodingConfig(octaves=6), 32, 2, 1)),
    "hash grid": Candidate(
        "hash",
        "4-10",
        GateConfig(EncodingConfig("hash", levels=4, log2_table=10, finest=128), 16, 1, 1),
    ),
    "TensoRF planes": Candidate(
        "vm",
        "32-4",
        GateConfig(EncodingConfig("vm", components=4, plane_cells=32), 16, 1, 1),
    ),
    "K-planes": Candidate(
        "k-planes",
        "32-4-1",
        GateConfig(
            EncodingConfig("k-planes", levels=1, features=4, coarsest=32, plane_cells=32),
            *(16, 1, 1),
        ),
    ),
}
"""Of each kind a size that keeps little for its bytes in `leco capacity`: 5 to 27 kB."""


def compared(model: LecoModel, datamanager: Any, contender: Contender) -> dict[str, Any]:
    """As `at_equal_loss`, with `taught` where the contender asks for gates that its field teaches:
    of each of `SMALL` the `name`, its `bytes`, the `seconds` of teaching it, and what it keeps.

    Raises:
        ValueError: held-out rays see no surface.
    """
    if not contender.taught:
        return at_equal_loss(model, datamanager, contender.grids)
    started = time.monotonic()
    with evaluating(model):
        lesson = lesson_by(Source(datamanager, model))
    of_lesson = time.monotonic() - started
    scores, rows = {}, []
    for name, candidate in SMALL.items():
        assert candidate.gate is not None
        started = time.monotonic()
        scores[name] = taught_score(candidate.gate, lesson, model.precision)
        seconds = round(of_lesson + time.monotonic() - started, 2)
        rows.append({"name": name, "bytes": candidate.bytes, "seconds": seconds})

    found = at_equal_loss(model, datamanager, contender.grids, others=scores)
    kept = found.pop("others")
    return found | {"taught": [row | kept[row["name"]] for row in rows]}
