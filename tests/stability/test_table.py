"""Claims about the words of a table."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import pytest

from leco_plugin.stability.plan import FULL, QUICK
from leco_plugin.stability.table import (
    QUICKLY,
    blind,
    headline,
    is_unproven,
    table,
    titles,
    verdicts_of,
)

SAMPLERS = [
    {"name": "learned", "title": "learned occupancy", "reference": "dense"},
    {"name": "grid-128", "title": "grid 128³", "reference": "dense"},
    {"name": "dense", "title": "dense", "reference": None},
]
MADE = {"date": "2024-02-29", "command": "leco stability --out DIR", "version": "0", "commit": None}


def cell(verdict: str, gap: float | None = -0.05, **values: Any) -> dict[str, Any]:
    figures = {
        "psnr": 24.0,
        "gap": gap,
        "seeds": 1,
        "missing": 0,
        "worst": 0.0,
        "reason": f"why {verdict}",
    }
    return figures | {"verdict": verdict, "kept_fraction": 0.2, "lost_mass": 0.004} | values


def results(*rows: tuple[str, bool, dict[str, dict[str, Any]]]) -> dict[str, Any]:
    cases = [
        {"name": name, "title": name, "why": f"{name}?", "must_fail": must_fail, "cells": cells}
        | {"scene": {"name": name}}
        for name, must_fail, cells in rows
    ]
    return {"samplers": SAMPLERS, "cases": cases, "made": MADE}


def both(ours: str, theirs: str) -> dict[str, dict[str, Any]]:
    return {"learned": cell(ours), "grid-128": cell(theirs), "dense": cell("pass", None)}


TWO = results(
    ("yard", False, both("pass", "fail")),
    ("fog", False, both("degraded", "no reference")),
    ("equal experts", True, {"learned": cell("fail")}),
)


def test_the_headline_counts_what_was_passed_where_there_is_a_reference() -> None:
    said = headline(TWO)
    assert said == "learned occupancy passes 1 of 2 cases; grid 128³ 0 of 1"
    assert verdicts_of(TWO, "learned") == ["pass", "degraded"]
    assert headline(results()) == "nothing has been run yet"


def test_a_case_in_which_nobody_is_held_to_anything_is_counted_apart() -> None:
    both_ways = [("pass", 3), ("no reference", 3), ("no reference", 0)]
    rows = [(word, False, {"learned": cell(word, seeds=n)}) for word, n in both_ways]
    assert headline(results(*rows)) == (
        "learned occupancy passes 1 of 1 case; for 1 more it has no dense run that trains"
    )


def test_a_dense_run_that_does_not_train_is_missed_by_the_sampler_that_is_held_to_it() -> None:
    shown = results(("fog", False, {"learned": cell("no reference"), "grid-128": cell("pass")}))
    assert headline(shown) == (
        "grid 128³ passes 1 of 1 case; for 1 more learned occupancy has no dense run that trains"
    )


def test_cells_of_the_same_runs_are_counted_once() -> None:
    runs = {"runs": [{"name": "ngp-grid-128-seed-0"}]}
    grids = [{"learned": cell("pass"), "grid-128": cell("fail", **runs)} for _ in range(3)]
    shown = results(*zip(("yard", "ten-seeds", "fog"), [False] * 3, grids))
    shown["cases"][1]["scene"]["name"] = "yard"  # in the fog the same run is another
    assert headline(shown) == "learned occupancy passes 3 of 3 cases; grid 128³ 0 of 2"


@pytest.mark.parametrize(
    ("ours", "why"),
    [
        (cell("pass"), "the case equal must fail, and its verdict is pass"),
        (cell("degraded"), "the case equal must fail, and its verdict is degraded"),
        (
            cell("fail", None, psnr=None, reason="1 of 1 run ended: out of memory"),
            "the case equal must fail by its figures; 1 of 1 run ended: out of memory",
        ),
    ],
)
def test_a_suite_in_which_what_must_fail_does_not_is_blind(ours: dict[str, Any], why: str) -> None:
    shown = results(("yard", False, both("pass", "pass")), ("equal", True, {"learned": ours}))
    assert blind(shown) == [why] and is_unproven(shown)
    assert headline(shown).endswith("; unproven: the case that must fail has not failed")
    assert blind(TWO) == [] and not is_unproven(TWO)


def test_a_suite_whose_failing_case_says_nothing_is_unproven_though_not_blind() -> None:
    for silent in (cell("no reference"), cell("no reference", None, psnr=None, seeds=0)):
        shown = results(("yard", False, both("pass", "pass")), ("equal", True, {"learned": silent}))
        assert blind(shown) == [] and is_unproven(shown)
    assert not is_unproven(results(("yard", False, both("pass", "pass"))))


def test_every_failure_says_why() -> None:
    text = table(TWO)
    assert "| yard | pass: -0.05 dB (kept 20%, lost 0.4%) | **fail**: -0.05 dB" in text
    assert "| yard | grid 128³ | why fail |" in text
    assert "| fog | learned occupancy | why degraded |" in text
    assert "| fog | fog? |" in text


def test_a_cell_that_was_not_run_or_does_not_exist_is_shown_as_such() -> None:
    unknown = cell("no reference", None, psnr=None, seeds=0, reason="not run")
    broken = cell("fail", None, psnr=None, reason="1 of 1 run ended: no memory")
    text = table(results(("yard", False, {"learned": unknown}), ("fog", False, {"dense": broken})))
    assert "| yard | -: not run |  |  |" in text
    assert "| fog |  |  | **fail**: no result |" in text


def test_a_table_without_verdicts_says_what_there_is() -> None:
    nothing = cell("no reference", None, psnr=None, seeds=0, reason="not run")
    assert headline(results(("yard", False, {"dense": nothing}))) == "nothing has been run yet"
    assert headline(results(("yard", False, {"dense": cell("pass", None)}))).startswith(
        "no verdict yet"
    )


def test_a_quick_table_says_that_its_verdicts_mean_nothing() -> None:
    quick = TWO | {"sizes": asdict(QUICK)}
    assert headline(quick) == f"{QUICKLY}: {headline(TWO)}"
    assert headline(TWO | {"sizes": asdict(FULL)}) == headline(TWO)


def test_a_cell_says_what_its_seeds_were() -> None:
    healed = [
        {"name": f"seed-{seed}", "occupancy": {"recoveries": times}}
        for seed, times in enumerate((None, 3, 1))
    ]
    one = cell("pass", seeds=3, worst=-0.4, missing=2, runs=healed)
    shown = results(("yard", False, {"learned": one}))
    assert headline(shown).endswith("; 2 seeds of cells are missing")
    assert all(said in table(shown) for said in ("3 of 5 seeds", "worst -0.40", "healed 3 x"))


def test_the_lines_over_the_picture_begin_with_a_capital() -> None:
    title, below = titles(TWO)
    assert title[0].isupper() and f"{title}; {below}".lower() == headline(TWO).lower()
    assert titles(results()) == ("Nothing has been run yet", "")
