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

TAUGHT = Candidate("frequency", "6-32-2", GateConfig(EncodingConfig(octaves=6), 32, 2, 1))
"""A gate as `leco shrink` and `leco capacity` teach it, of the size that most scenes need."""


def compared(model: LecoModel, datamanager: Any, contender: Contender) -> dict[str, Any]:
    """As `at_equal_loss`, with `taught` where the contender asks for a gate that its field teaches:
    its `bytes`, the `seconds` of teaching, and what it keeps.

    Raises:
        ValueError: held-out rays see no surface.
    """
    if not contender.taught:
        return at_equal_loss(model, datamanager, contender.grids)
    started = time.monotonic()
    assert TAUGHT.gate is not None
    with evaluating(model):
        lesson = lesson_by(Source(datamanager, model))
    score = taught_score(TAUGHT.gate, lesson, model.precision)
    seconds = time.monotonic() - started

    found = at_equal_loss(model, datamanager, contender.grids, others={"taught": score})
    kept = found.pop("others")["taught"]
    return found | {"taught": {"bytes": TAUGHT.bytes, "seconds": round(seconds, 2), **kept}}
