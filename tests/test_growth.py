"""The benchmark of growth: its arithmetic, and that it passes from city to picture and goes on."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "benchmarks"))

from growth import (  # noqa: E402
    Options,
    first_schedule,
    gate_of,
    look_steps,
    settings_of,
    stored_rows,
)
from growth_figures import bytes_for, exponents, grid_for, slope  # noqa: E402
from large_scene_tables import growth_table  # noqa: E402

from leco_plugin.models.gate import GateConfig  # noqa: E402


def test_an_exponent_is_that_of_a_power_and_missing_values_are_left_out() -> None:
    assert slope([1.0, 2.0, 8.0], [3.0, 6.0 * 2.0**0.5, None]) == pytest.approx(1.5)
    assert slope([1.0, 2.0, 8.0], [5.0] * 3) == pytest.approx(0.0)
    assert slope([1.0, 2.0], [3.0, None]) is None
    assert slope([], []) is None


def test_the_grid_that_keeps_a_volume_lies_between_those_measured() -> None:
    rows = [{"bytes": 10**k, "kept_reached_volume": 0.8 / 2**k} for k in range(4)]
    assert bytes_for(0.2, rows) == pytest.approx(100.0)
    assert bytes_for(0.2 * 2**0.5, rows) == pytest.approx(10**1.5)
    assert bytes_for(0.9, rows) == 1.0
    assert bytes_for(0.01, rows) is None and grid_for(0.01, rows) is None
    assert grid_for(0.3, rows) == rows[2]
    stumbling = [*rows[:2], {"bytes": 30, "kept_reached_volume": 0.99}, *rows[2:]]
    assert bytes_for(0.2 * 2**0.5, stumbling) == pytest.approx(10**1.5)
    level = [{"bytes": 8, "kept_reached_volume": 0.5}, {"bytes": 64, "kept_reached_volume": 0.5}]
    assert bytes_for(0.5, level) == 8.0


def test_a_gate_has_an_octave_more_when_the_side_doubles() -> None:
    octaves = [gate_of(GateConfig(), blocks, 1).encoding.octaves for blocks in (2, 4, 8, 16)]
    first = GateConfig().encoding.octaves
    assert octaves == [first, first, first + 1, first + 2]


def test_growth_is_told_with_area_and_with_volume() -> None:
    rows = [
        {"area": n**2, "volume": n**4, "gate_bytes": 7, "grid_bytes": n**4, "seconds": None}
        for n in (1, 2, 4)
    ]
    first = [row | {"grid_seconds": 1.0, "seed": 0} for row in rows]
    second = [row | {"seed": 1, "grid_bytes": row["area"]} for row in first]
    grids = exponents([*first, *second], "area")["grid_bytes"]
    assert grids["all"] == pytest.approx(1.5) and grids["each"] == pytest.approx([2.0, 1.0])
    found = exponents(first, "volume")
    assert found["grid_bytes"]["all"] == pytest.approx(1.0)
    assert found["gate_bytes"]["all"] == pytest.approx(0.0)
    assert found["seconds"] == {"all": None, "each": []}


def test_a_city_begins_with_the_schedule_of_the_next_smaller_one() -> None:
    options = Options(schedules=(10, 20, 40))
    rows = [{"blocks": 2, "schedule": 10}, {"blocks": 4, "schedule": 20}]
    rows = [row | {"seed": 0} for row in rows] + [{"blocks": 4, "schedule": 40, "seed": 1}]
    assert [first_schedule(rows, blocks, 0, options) for blocks in (1, 3, 8)] == [0, 0, 1]
    assert [first_schedule(rows, blocks, 1, options) for blocks in (4, 8)] == [0, 2]


def test_rows_of_another_field_are_not_gone_on_with(tmp_path: Path) -> None:
    out = tmp_path / "growth.json"
    settings = settings_of(Options())
    assert settings["sizes"]["field"]["encoding"]["log2_table"] > 0
    assert settings == settings_of(Options(blocks=(2,), seeds=(5,), out=out))
    assert stored_rows(out, settings) == []
    out.write_text(json.dumps({"settings": settings, "rows": [{"blocks": 2}]}))
    assert stored_rows(out, settings) == [{"blocks": 2}]
    with pytest.raises(SystemExit, match="other settings or sizes"):
        stored_rows(out, settings | {"sizes": {}})


def test_looks_lie_in_the_second_half_and_the_last_at_the_end() -> None:
    assert look_steps(100, 4) == {63, 75, 88, 100}
    assert look_steps(5, 2) == {4, 5}


@pytest.mark.slow
@pytest.mark.long
def test_a_dry_run_passes_and_is_not_done_twice(tmp_path: Path) -> None:
    out = tmp_path / "growth.json"
    command = [sys.executable, "-W", "ignore", str(ROOT / "benchmarks" / "growth.py"), "--dry-run"]
    command += ["--out", str(out), "--cities", str(tmp_path / "cities")]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    report = json.loads(out.read_text())
    assert [row["blocks"] for row in report["rows"]] == [1, 2]
    for row in report["rows"]:
        assert 1 <= len(row["grids"]) <= 2  # none behind one that keeps as little as the gate
        assert row["gate_bytes"] > 0
        assert 0.0 < row["kept_reached_volume"] <= 1.0 and row["psnr_held_out"] > 3.0
        assert row["schedule"] == 8 and not row["learned"]
    assert "Not learned in any schedule: 1 (0), 2 (0)" in growth_table(report)
    again = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert again.stdout.count("stored already") == 2
