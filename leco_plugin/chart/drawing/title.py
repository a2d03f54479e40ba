"""What a chart says over its picture, its page and its table."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from leco_plugin.chart.findings.fronts import verdict
from leco_plugin.chart.findings.learned import learned_headline, learned_of
from leco_plugin.chart.findings.representations import never_held_of, representations_of
from leco_plugin.chart.findings.summary import headline, lines_of, sentence


def title_of(results: Mapping[str, Any]) -> str:
    """One sentence, without a full stop, of results that hold at least one run."""
    lines = lines_of(results)
    held = representations_of(lines)
    if held:
        never = len(never_held_of(lines))
        return sentence(verdict(held)) + (f"; {never} not always frozen" if never else "")
    if asks_what_was_learned(results):
        return sentence(learned_headline(learned_of(lines)))
    return sentence(headline(results))


def asks_what_was_learned(results: Mapping[str, Any]) -> bool:
    """Whether it is a comparison of what gates learn in equal steps, and not of where runs end."""
    by_steps = results["suite"] is not None and results["protocol"]["seconds"] is None
    return by_steps and bool(learned_of(lines_of(results)))
