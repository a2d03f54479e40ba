"""Representations that are made of a run's field, and compared with the gate that learned it."""

from __future__ import annotations

import time
from typing import Any

from leco_plugin.capacity.gates import gates
from leco_plugin.capacity.measuring import lesson_by, taught_score
from leco_plugin.capacity.sources import Source
from leco_plugin.chart.contenders.contender import Contender
from leco_plugin.evaluation.equal_loss import at_equal_loss
from leco_plugin.models.freezing.held_out_rendering import evaluating
from leco_plugin.models.leco import LecoModel

_GATES = {gate.key: gate for gate in gates()}
SMALL = {
    "MLP": _GATES["frequency-6-32-2"],
    "hash grid": _GATES["hash-4-10"],
    "TensoRF planes": _GATES["vm-32-4"],
    "K-planes": _GATES["k-planes-32-4-1"],
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
