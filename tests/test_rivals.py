"""The sweep of the rivals' rates and sizes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import pytest
import rivals
from chart_results import run

from leco_plugin.chart.contender import config_of
from leco_plugin.studio.cooldown import CooldownSchedulerConfig


def leaves(config: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Every setting of a config, by its path."""
    if is_dataclass(config) and not isinstance(config, type):
        config = {one.name: getattr(config, one.name) for one in fields(config)}
    if isinstance(config, dict):
        for name, value in config.items():
            yield from leaves(value, f"{path}.{name}" if path else str(name))
    else:
        yield path, config


@pytest.mark.parametrize(
    "given, other", [(given, one) for given, others in rivals.swept() for one in others]
)
def test_a_row_of_the_sweep_changes_what_it_names_and_nothing_else(
    given: Any, other: Any, tmp_path: Path
) -> None:
    before, after = (dict(leaves(config_of(one, tmp_path, tmp_path))) for one in (given, other))

    changed = {path for path in before if before[path] != after[path]}

    of_model = {path for path in other.changes if other.changes[path] != given.changes.get(path)}
    named = {f"pipeline.model.{path}" for path in of_model} | set(other.settings)
    assert before.keys() == after.keys()
    assert changed == named
    assert other.key != given.key


def test_every_rate_falls_as_in_the_row_that_charts_show(tmp_path: Path) -> None:
    for given, others in rivals.swept():
        for one in (given, *others):
            config = config_of(one, tmp_path, tmp_path)
            for group in config.optimizers.values():
                assert group["scheduler"] in (None, CooldownSchedulerConfig())


def test_a_better_row_is_ahead_and_a_row_that_was_not_run_is_left_out() -> None:
    given, others = next(iter(rivals.swept()))
    better, worse = others[:2]
    psnrs = {given.name: (20.0, 20.2), better.name: (22.0, 22.2), worse.name: (17.0, 17.2)}
    runs = [run(name, seed, psnr) for name, both in psnrs.items() for seed, psnr in enumerate(both)]
    made = {"command": "benchmarks/rivals.py city", "date": "2026-11-29", "version": "0.1.0"}

    about = {"scene": {"name": "city"}, "protocol": {"seconds": 120.0}, "machine": {"cores": 2}}
    failures = [{"name": others[2].name, "seed": 1, "reason": "no memory"}]
    lines = rivals.sweep_lines({"runs": runs, "made": made, "failures": failures, **about})

    rows = [line for line in lines if line.startswith("| ")][1:]
    assert len(rows) == 3
    assert "20.1 dB" in rows[0]
    assert "22.1 dB" in rows[1] and "ahead: +2.00" in rows[1]
    assert "17.1 dB" in rows[2] and "behind: -3.00" in rows[2]
    assert f"Failed: {others[2].name}, seed 1." in lines
