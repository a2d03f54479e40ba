"""What docs/results.md says of large scenes, from made reports."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from PIL import Image

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "benchmarks"))

from growth_picture import draw
from large_scene_tables import growth_table, memory_table

from leco_plugin.chart.theme import DARK, SOURCE, fingerprint


def growth_report(grid_bytes: float | None = 4e6, learned: bool = True) -> dict[str, Any]:
    row = {
        "blocks": 2,
        "seed": 0,
        "area_square_metres": 6400.0,
        "photographs": 34,
        "gate_bytes": 51_000,
        "grid_bytes": 9_400.0,
        "grids": [{"bytes": 4_096, "kept_reached_volume": 0.2}],
        "kept_reached_volume": 0.0812,
        "seconds": 11.3,
        "steps": 75,
        "schedule": 100,
        "grid_seconds": 1.26,
        "psnr_held_out": 19.13,
        "learned": True,
    }
    large = row | {
        "blocks": 16,
        "area_square_metres": 409_600.0,
        "grid_bytes": grid_bytes,
        "grid_seconds": None if grid_bytes is None else 60.0,
        "learned": learned,
        "seconds": 100.0 if learned else None,
    }
    figures = {"gate_bytes": 0.05, "grid_bytes": 1.04, "seconds": None, "grid_seconds": 0.9}
    both = {
        name: {"all": one, "each": [] if one is None else [one, one + 0.1]}
        for name, one in figures.items()
    }
    return {
        "exponents_with_area": both,
        "exponents_with_volume": both,
        "rows": [row, large],
    }


def test_growth_says_each_city_and_that_the_gates_size_is_a_rule() -> None:
    table = growth_table(growth_report())
    assert "| 2 (0) | 6,400 | 34 | 51 | 9.4 | 8.1 | 11 | 75 of 100 | 1.3 | 19.1 dB |" in table
    assert "| area | 0.05 (0.05, 0.15) | 1.04 (1.04, 1.14) | - | 0.90 (0.90, 1.00) |" in table
    assert "by construction its bytes grow as the area to the 0.05." in table
    assert "learns each city: yes." in table


def test_growth_without_a_grid_that_does_says_how_large_one_did_not() -> None:
    assert "| 16 (0) | 409,600 | 34 | 51 | over 4 | 8.1 |" in growth_table(growth_report(None))


def test_a_gate_that_has_not_learned_is_said_to_be_too_small() -> None:
    table = growth_table(growth_report(learned=False))
    assert "learns each city: **no**." in table
    assert "Not learned in any schedule: 16 (0) blocks a side." in table


def test_growth_is_drawn_with_what_it_was_drawn_from(tmp_path: Path) -> None:
    report = growth_report(None, learned=False)
    path = draw(tmp_path / "growth.png", report, DARK)
    with Image.open(path) as image:
        assert image.info[SOURCE] == fingerprint(report)
        assert image.convert("RGB").getpixel((2, 2)) == (0x0D, 0x11, 0x17)


def test_memory_is_told_in_megabytes() -> None:
    run = {
        "way": "disk",
        "added_bytes": 562_300_000,
        "added_on_a_tenth_bytes": 501_000_000,
        "decoded_bytes": 531_000_000,
        "decoded_float_bytes": 2_124_000_000,
        "within_allowance": True,
    }
    over = {"way": "memory", "within_allowance": False}
    lines = memory_table({"runs": [run, over]}).splitlines()
    assert lines[-2:] == [
        "| disk | 562 | 501 | 531 | 2,124 |",
        "| memory | **over the allowance** | | | |",
    ]
