"""Claims about what a scene is said to need."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from leco_plugin.capacity.choice import (
    TOLD_APART,
    WORTH_TEN_TIMES,
    answer,
    best_gate,
    choose,
    circumstances,
    common_volume,
    draw,
    grid_that_suffices,
    kilobytes,
    smallest_grid,
    stored_bytes,
)
from leco_plugin.capacity.measuring import VOLUMES


def row(family: str, size: str, bytes: int, kept: float) -> dict[str, Any]:
    lost = [0.02 / (1 + i) for i in range(len(VOLUMES))]
    found = {"family": family, "size": size, "bytes": bytes, "kept_volume": kept}
    return found | {"lost_at_volumes": lost}


LARGE_GATE = row("hash", "8-16", 2_000_000, 0.060)
SMALL_GATE = row("frequency", "5-16-2", 3_000, 0.062)
COARSE, FINE = row("grid", "32", 4_096, 0.15), row("grid", "256", 2_097_152, 0.0625)


def test_more_bytes_are_chosen_only_where_they_pay() -> None:
    """Ten times as many must leave two thirds of the volume."""
    pays, does_not = (
        row("hash", "4-10", 30_000, 0.062 * WORTH_TEN_TIMES * factor) for factor in (0.99, 1.01)
    )
    assert choose([SMALL_GATE, pays]) is pays
    assert choose([SMALL_GATE, does_not]) is SMALL_GATE
    assert choose([SMALL_GATE, row("vm", "9", 3_000_000, 0.06)]) is SMALL_GATE


def test_what_the_scene_needs_is_said_beside_the_grid_that_keeps_as_little() -> None:
    rows = [LARGE_GATE, SMALL_GATE, COARSE, FINE]
    assert choose(rows) is SMALL_GATE
    assert smallest_grid(rows, SMALL_GATE) is FINE and grid_that_suffices(rows) is None
    said = answer(rows)[1]
    assert said.startswith("This scene needs 3.0 kB: a gate on frequencies keeps 6.2%")
    assert "256^3 cells, 699.1 times" in said


def test_a_grid_that_suffices_is_named() -> None:
    enough = row("grid", "16", 512, 0.061)
    rows = [SMALL_GATE, LARGE_GATE, enough, FINE]
    assert choose(rows) is grid_that_suffices(rows) is enough
    assert answer(rows)[1].startswith("A grid suffices: 16^3 cells")


def test_a_grid_has_the_bytes_of_its_octree_where_they_are_known() -> None:
    small = COARSE | {"size": "64", "octree_bytes": 800, "kept_volume": 0.075}
    rows = [SMALL_GATE, LARGE_GATE, small]
    assert choose([SMALL_GATE, small | {"octree_bytes": 3_000}]) is SMALL_GATE
    assert choose(rows) is small and best_gate(rows) is SMALL_GATE
    assert answer(rows)[1] == (
        "A grid suffices: 64^3 cells, 0.8 kB as an octree, keeps 7.5% of the volume; the gate "
        "that pays most, 3.0 kB, 6.2%."
    )
    everything = COARSE | {"octree_bytes": 0, "kept_volume": 1.0}
    assert choose([everything, SMALL_GATE]) is SMALL_GATE and stored_bytes(everything) == 1


def test_a_usual_grid_that_keeps_as_little_as_a_smaller_gate_suffices() -> None:
    usual = row("grid", "128", 262_144, 0.064)
    rows = [SMALL_GATE, COARSE, usual, FINE]
    assert choose(rows) is SMALL_GATE and grid_that_suffices(rows) is usual
    title, said = answer(rows)
    assert said.startswith("A grid suffices: 128^3 cells, 262.1 kB.") and "With 3.0 kB" in said
    assert title == "A gate of 3.0 kB suffices, or 128³ cells"


def test_a_grid_that_keeps_hardly_more_is_not_called_worse() -> None:
    """One field and one seed do not tell them apart."""
    hardly, more = (row("grid", "32", 4_096, factor * 0.062) for factor in (1.19, 1.21))
    assert grid_that_suffices([SMALL_GATE, hardly], TOLD_APART) is hardly
    assert "4.1 kB, keeps 7.4%: with one field" in answer([SMALL_GATE, hardly])[1]
    assert grid_that_suffices([SMALL_GATE, more], TOLD_APART) is None
    assert grid_that_suffices([SMALL_GATE, FINE], TOLD_APART) is None  # no usual one
    as_much, more = (row("grid", "128", 262_144, factor * 0.062) for factor in (1.049, 1.051))
    assert smallest_grid([as_much, more], SMALL_GATE) is as_much
    assert smallest_grid([more], SMALL_GATE) is None
    larger = as_much | {"size": "129", "bytes": 268_336}
    assert smallest_grid([larger, as_much], SMALL_GATE) is as_much
    assert grid_that_suffices([SMALL_GATE, larger]) is None


def test_grids_that_never_keep_as_little_are_named() -> None:
    assert "No grid up to 32^3" in answer([SMALL_GATE, COARSE])[1]
    assert "grid" not in answer([SMALL_GATE])[1]


def test_losses_are_compared_at_about_the_volume_of_the_chosen_one() -> None:
    assert VOLUMES[common_volume([SMALL_GATE, COARSE])] == 0.06
    assert VOLUMES[common_volume([SMALL_GATE | {"kept_volume": 0.021}])] == 0.02
    assert common_volume([SMALL_GATE | {"kept_volume": 0.0}]) == 0
    sizes = {FINE["bytes"]: "2.1 MB", 10**6: "1.0 MB", 999_000: "999.0 kB", 1_234: "1.2 kB"}
    assert {size: kilobytes(FINE | {"bytes": size}) for size in sizes} == sizes


def test_a_scene_where_everything_keeps_all_is_drawn(tmp_path: Path) -> None:
    full = [one | {"kept_volume": 1.0} for one in (SMALL_GATE, COARSE | {"octree_bytes": 0})]
    results = {
        "representations": full,
        "machine": {"cores": 2, "threads": 1, "device": "cpu"},
        "scene": {"name": "fog", "train_images": 9},
        **{"learn_steps": 200, "rays": 8192, "lost_surface_mass": 1e-3},
    }
    assert draw(results, tmp_path / "capacity.png").stat().st_size > 1000
    assert "; one CPU core. " in circumstances(results)
    assert "not drawn" not in circumstances(results)
    partly = results | {"representations": [SMALL_GATE, full[1]]}
    assert "grids as octrees (not drawn, as they keep all: 32)" in circumstances(partly)


def test_what_skips_nothing_is_not_said_to_suffice() -> None:
    full = [one | {"kept_volume": 1.0} for one in (SMALL_GATE, LARGE_GATE, COARSE)]
    title, said = answer(full)
    assert title == "At this loss nothing can be skipped"
    assert said.startswith(title) and "--learn-steps" in said
    assert "suffices" in answer([*full, FINE])[0]
