"""Interleaved timing of benchmarks: in turns, after a round that does not count."""

from __future__ import annotations

import pytest
import timing


def test_functions_run_in_turns_and_the_first_round_is_no_figure(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    called: list[str] = []
    clock = 0.0

    def work(name: str, first: float, later: float) -> None:
        nonlocal clock
        clock += later if name in called else first
        called.append(name)

    monkeypatch.setattr(timing.time, "perf_counter", lambda: clock)
    functions = {
        "slow to start": lambda: work("slow to start", 100.0, 2.0),
        "steady": lambda: work("steady", 1.0, 1.0),
    }
    found = timing.time_interleaved(functions, rounds=3)
    assert called == ["slow to start", "steady"] * 4
    assert found == {"slow to start": [2.0] * 3, "steady": [1.0] * 3}
    assert timing.milliseconds(found) == {"slow to start": 2000.0, "steady": 1000.0}


def test_a_ratio_is_taken_round_by_round() -> None:
    """A busy machine slows both of a round alike."""
    found = {"one": [2.0, 20.0, 3.0], "other": [1.0, 10.0, 3.0]}
    assert timing.ratio(found, "one", "other") == 2.0  # medians of each would have the ratio 1
    with pytest.raises(ValueError, match="shorter"):
        timing.ratio({"one": [1.0, 2.0], "other": [1.0]}, "one", "other")
