"""The benchmarks of large scenes: arithmetic, verdicts, what pages say of them, and dry runs."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import bounds
import pytest
from growth_picture import cities, draw, growth_table
from large_scene_tables import bounds_table, bounds_verdict, memory_table
from page_parts import RESULTS
from PIL import Image

from leco_plugin.chart.theme import DARK, SOURCE, fingerprint

ALONE, WITH_PLANES = "near and far alone", "near and far, planes from the data"


def report(grid: float, gate: float = 0.02) -> dict[str, Any]:
    """Results of `leco capacity`: a gate, a fine grid that keeps least, and a coarser one."""
    rows = [
        {"family": "frequency", "size": "6-32-2", "bytes": 4932, "kept_volume": gate},
        {"family": "grid", "size": "64", "bytes": 32768, "octree_bytes": 9000, "kept_volume": grid},
        {"family": "grid", "size": "512", "bytes": 1 << 24, "octree_bytes": 1 << 18}
        | {"kept_volume": 0.96 * grid},
    ]
    return {"representations": rows, "scene": {"train_images": 34}}


REPORTS = {"fox": report(0.5), "city-8": report(0.06), "city-2": report(0.03), "city": report(0.9)}


def test_growth_is_told_of_cities_from_small_to_large_with_gate_and_grid_chosen_alike() -> None:
    grown = cities(REPORTS)
    assert [(one.blocks, one.grid["size"], one.times) for one in grown] == [
        (2, "64", pytest.approx(1.5)),
        (8, "64", pytest.approx(3.0)),
    ]
    assert grown[0].area < grown[1].area
    finer = cities({"city-2": report(0.03), "city-4": report(0.06, gate=0.06)})
    assert finer[1].times == pytest.approx(1.0)


def test_the_growth_table_has_bytes_of_bits_and_of_octrees() -> None:
    table = growth_table(REPORTS)
    assert (
        "| 8 | 99,200 | 34 | frequency 6-32-2 | 4.9 | 2.00% | 64^3 | 32.8 | 9.0 kB | 6.00% | 3.0 |"
        in table
    )
    assert table.splitlines()[-1] == (
        "From 2 to 8 blocks a side the gate takes 4.9 kB and keeps 2.0% of the volume. A grid with "
        "the same lesson, chosen by the same rule, takes 9.0 kB as an octree and keeps 1.5 to 3.0 "
        "times as much. Neither follows the area."
    )
    larger = report(0.06)
    larger["representations"][0]["bytes"] = 5000
    said = growth_table({**REPORTS, "city-8": larger}).splitlines()[-1]
    assert said.endswith("times as much. The bytes of the gate grow with the area.")


def test_growth_is_drawn_with_what_it_was_drawn_from(tmp_path: Path) -> None:
    path = draw(tmp_path / "growth.png", REPORTS, DARK)
    with Image.open(path) as image:
        assert image.info[SOURCE] == fingerprint(REPORTS)
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
        "| memory | **over the allowance** | - | - | - |",
    ]


def rows_of(
    automatic: float,
    by_hand: dict[tuple[float, float], float],
    planes: bool = False,
    apart: float = 0.5,
) -> list[dict[str, Any]]:
    """Runs of two seeds, so many decibels below and above these means."""
    means = [(None, True, automatic)]
    means += [(list(pair), planes, psnr) for pair, psnr in by_hand.items()]
    return [
        {"range": range_, "planes": planes, "seed": seed, "psnr": psnr + spread}
        for range_, planes, psnr in means
        for seed, spread in enumerate((-apart, apart))
    ]


def verdicts(rows: list[dict[str, Any]]) -> dict[str, list[str]]:
    """Best, automatic, reached and the comparison, of planes or none."""
    lines = [line.strip("| ").split(" | ") for line in bounds_verdict(rows)[2:]]
    return {name: cells for name, *cells in lines}


@pytest.mark.parametrize(
    ("automatic", "apart", "reached"),
    [
        (20.0, 0.01, "yes"),
        (19.8, 0.01, "**no**"),
        (19.97, 0.01, "yes"),
        (19.91, 0.01, "undecided"),
        (20.34, 0.5, "undecided"),
        (19.0, 0.5, "undecided"),
    ],
)
def test_automatic_bounds_may_lose_a_tenth_of_a_decibel_where_the_interval_decides(
    automatic: float, apart: float, reached: str
) -> None:
    found = verdicts(rows_of(automatic, {(0.1, 2.0): 20.0, (0.1, 9.0): 17.0}, apart=apart))
    assert list(found) == [ALONE]
    best, mean, said, against = found[ALONE]
    assert (best, mean, said) == ("20.00 dB", f"{automatic:.2f} dB", reached)
    margin = 6.085 * apart  # of two seeds each: t of two degrees of freedom is 4.303
    assert f"{automatic - 20.0:+.2f} ± {margin:.2f} dB, 2 seeds" in against


def test_the_verdict_is_against_the_runs_of_the_best_pair() -> None:
    rows = rows_of(20.0, {(0.1, 2.0): 20.0, (0.1, 9.0): 20.0})
    lucky = next(row for row in rows if row["range"] == [0.1, 9.0] and row["seed"] == 1)
    lucky["psnr"] += 0.4
    best, _, _, against = verdicts(rows)[ALONE]
    assert best == "20.20 dB" and against.startswith("undecided: -0.20 ± ")


def test_pairs_with_planes_and_without_are_told_apart() -> None:
    pairs = {(0.1, 2.0): 19.0}
    rows = rows_of(20.0, pairs, apart=0.1)
    rows += rows_of(20.0, {(0.1, 2.0): 21.0}, planes=True, apart=0.1)[2:]
    table = bounds_table({"runs": rows})
    assert "| automatic | yes | 20.00 dB (19.90, 20.10) |" in table
    assert "| 0.1 to 2 | no | 19.00 dB (18.90, 19.10) |" in table
    assert f"| {ALONE} | 19.00 dB | 20.00 dB | yes | ahead: +1.00 ± 0.61 dB, 2 seeds |" in table
    lost = f"| {WITH_PLANES} | 21.00 dB | 20.00 dB | **no** | behind: -1.00 ± 0.61 dB, 2 seeds |"
    assert lost in table


def test_a_pair_with_which_a_run_failed_is_not_the_best() -> None:
    rows = rows_of(20.0, {(0.1, 2.0): 25.0, (0.1, 9.0): 20.0})
    lost = next(row for row in rows if row["range"] == [0.1, 2.0])
    lost |= {"psnr": None, "failed": "step 75: the gate calls all space empty"}
    assert verdicts(rows)[ALONE][0] == "20.00 dB"
    assert "| 0.1 to 2 | no | failed with 1 of 2 seeds |" in bounds_table({"runs": rows})


def test_one_seed_decides_nothing_and_the_first_run_has_nothing_beside_it() -> None:
    assert verdicts(rows_of(20.0, {})[:1]) == {}
    assert verdicts(rows_of(20.0, {(0.1, 2.0): 17.0})[::2])[ALONE][2] == "no verdict"


def test_the_stored_runs_say_what_the_page_says_and_nothing_more() -> None:
    stored = json.loads((RESULTS / "bounds.json").read_text())
    assert "verdict" not in stored
    assert verdicts(stored["runs"])[ALONE] == [
        *("18.11 dB", "18.44 dB", "undecided"),
        "undecided: +0.34 ± 1.06 dB, 3 seeds",
    ]


def test_automatic_bounds_come_first_with_each_seed() -> None:
    wanted = bounds.wanted_runs(
        bounds.Options(Path("scene"), pairs=((1.0, 2.0), (1.0, 3.0)), seeds=(4, 5))
    )
    assert len(wanted) == 10 and wanted[0] == (None, True, 4) and wanted[5] == (None, True, 5)


def test_bounds_of_another_scene_are_not_written_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        bounds,
        "run",
        lambda _, pair, planes, seed: (
            {"psnr": 20.0 + seed} | {"range": pair and list(pair), "planes": planes, "seed": seed}
        ),
    )
    options = bounds.Options(tmp_path / "a", pairs=((1.0, 2.0),), out=tmp_path / "bounds.json")
    bounds.main(options)
    stored = options.out.read_text()
    assert len(json.loads(stored)["runs"]) == 6
    for other in ({"data": tmp_path / "b"}, {"dry_run": True}):
        with pytest.raises(SystemExit, match="name another --out"):
            bounds.main(replace(options, **other))
    assert options.out.read_text() == stored


def test_the_stored_result_keeps_more_than_the_allowance_on_disk() -> None:
    stored = json.loads((RESULTS / "image-memory.json").read_text())
    rows = {row["way"]: row for row in stored["runs"]}
    assert not rows["memory"]["within_allowance"]  # or nothing would have been enforced
    row = rows["disk"]
    assert row["within_allowance"]
    assert row["decoded_bytes"] == 3 * 2000 * 1500 * 239 > stored["allowance_bytes"]
    assert row["added_bytes"] < 0.5 * row["decoded_bytes"]


@pytest.mark.slow
@pytest.mark.long
def test_memory_does_not_grow_with_the_photographs_on_disk(
    run_script: Callable[..., str], tmp_path: Path
) -> None:
    """72 pictures decode to 648 MB in bytes, 2.6 GB in floats."""
    out = tmp_path / "out.json"
    size = ["--images", 72, "--width", 2000, "--height", 1500]
    run_script("image_memory.py", "--steps", 2, "--ways", "disk", "memory", *size, "--out", out)
    disk, memory = json.loads(out.read_text())["runs"]
    photographs = disk["added_bytes"] - disk["added_on_a_tenth_bytes"]
    assert photographs < 0.5 * disk["decoded_bytes"]
    assert not memory["within_allowance"]
