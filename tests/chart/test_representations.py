"""Claims about ways to hold an occupancy, side by side."""

from __future__ import annotations

import pytest
from chart_results import grid, occupancy, results, run, slow_front
from hypothesis import given
from hypothesis import strategies as st

from leco_plugin.chart.panels import finding_of
from leco_plugin.chart.representations import (
    SMALL_OURS,
    Held,
    Representation,
    fronts_of,
    representations_of,
    verdict,
)
from leco_plugin.chart.summary import lines_of
from leco_plugin.chart.table import table

GRIDS = [grid(64, 0.3), grid(128, 0.2)]


def gates(*found: tuple[str, str, int, float, float]) -> list[Representation]:
    """Of name, sampler, bytes, seconds of learning and share kept."""
    runs = [
        run(name, sampler=sampler, learn_seconds=seconds, occupancy=occupancy(size, kept))
        for name, sampler, size, seconds, kept in found
    ]
    return representations_of(lines_of(results(*runs)))


def test_grids_stand_beside_the_gates_of_whose_field_they_were_made() -> None:
    ours = run("MLP (ours)", occupancy=occupancy(50_000, 0.1, GRIDS))
    other = run("hash grid", sampler="learned-occupancy-hash", occupancy=occupancy(4_000_000, 0.2))
    plain = run("never frozen", occupancy=None)
    held = representations_of(lines_of(results(ours, other, plain)))
    assert [(one.name, one.median("size")) for one in held] == [
        ("MLP (ours)", 50.0),
        ("grid 64³", 32.768),
        ("grid 128³", 262.144),
        ("hash grid", 4000.0),
    ]
    assert [one.has("learn_seconds") for one in held] == [True, False, False, True]
    assert [one.kept for one in held] == pytest.approx([10.0, 30.0, 20.0, 20.0])
    assert [one.ours for one in held] == [True, False, False, False]
    assert verdict(held) == ("MLP (ours) keeps least space, 10.0% in 50 kB (one seed: no verdict)")


@pytest.mark.parametrize("missing_in", [0, 1])
def test_a_grid_that_did_not_fit_the_memory_once_is_not_compared(missing_in: int) -> None:
    runs = [run("A", seed, occupancy=occupancy(50_000, 0.1, GRIDS)) for seed in (0, 1)]
    runs[missing_in]["occupancy"]["at_equal_loss"]["grids"] = GRIDS[:1]
    names = [one.name for one in representations_of(lines_of(results(*runs)))]
    assert names == ["A", "grid 64³"]


def held(name: str, *seeds: tuple[float, float]) -> Representation:
    """Of seconds of learning and percent kept, seed by seed."""
    return Representation(name, {i: Held(50.0, *figures) for i, figures in enumerate(seeds)})


def test_what_was_measured_in_the_whole_box_is_not_compared() -> None:
    before = occupancy(50_000, 0.1)
    before["at_equal_loss"] = {"kept_volume": 0.1, "kept_candidates": 0.1, "grids": []}
    other = run("B", sampler="learned-occupancy-hash", occupancy=before)
    assert representations_of(lines_of(results(run("A", occupancy=before), other))) == []


def test_gates_of_one_kind_are_no_comparison_of_representations() -> None:
    runs = [run(name, occupancy=occupancy(50_000, 0.1)) for name in ("identity", "none")]
    assert representations_of(lines_of(results(*runs))) == []


def test_what_leads_in_the_median_but_not_beyond_the_spread_of_seeds_is_level() -> None:
    ours = Representation("ours", {i: Held(50.0, 9.0, 10.0) for i in range(3)}, ours=True)
    for word, usual, most in (("level", 9.5, 10.4), ("undecided", 9.0, 11.0)):
        other = held("planes", (8.0, usual), (8.0, usual), (8.0, most))
        assert fronts_of(ours, [ours, other]) == []
        assert verdict([ours, other]) == (
            f"ours: as small, less is kept by planes ({word}); learned as soon, less is kept by "
            f"planes ({word} in space) (3 seeds)"
        )
    larger = Representation("larger", {i: Held(60.0, 8.0, 9.5) for i in range(3)})
    said = "ours: nothing as small keeps less space; learned as soon, less is kept by larger"
    said += " (3 seeds)"
    assert verdict([ours, larger]) == said
    slower = held("slower", (8.5, 12.0), (12.0, 12.0), (12.0, 12.0))
    assert verdict([ours, slower]) == "ours keeps least space, 10.0% in 50 kB (3 seeds)"
    near = held("near", (9.0, 12.0), (9.0, 11.0), (9.0, 9.0))
    level = held("like", (9.0, 10.5), (9.0, 10.1), (9.0, 9.7))
    assert verdict([ours, near, level]) == (
        "ours keeps least space, 10.0% in 50 kB, level with like, undecided against near (3 seeds)"
    )


def test_what_nothing_beats_in_size_or_time_is_said_so() -> None:
    ours = Representation("ours", {i: Held(50.0, 9.0, 10.0) for i in range(3)}, ours=True)
    slower = Representation("slower", {i: Held(60.0, 11.0 + i, 9.0) for i in range(3)})
    said = "ours: nothing as small or learned as soon keeps less space (3 seeds)"
    assert verdict([ours, slower]) == said


def taught(name: str, size: int, kept: float) -> dict[str, object]:
    return {"name": name, "bytes": size, "seconds": 20.0, "kept_reached_volume": kept}


def test_grids_of_the_same_lesson_and_sparse_points_stand_beside() -> None:
    facts = occupancy(50_000, 0.2, GRIDS)
    facts["at_equal_loss"]["grids"][0] = grid(64, 0.3) | {"octree_bytes": 2_000}
    facts["at_equal_loss"]["others"] = [
        taught("taught grid 64³", 1_000, 0.1) | {"learned_first": True},
        taught("sparse points", 60_000, 0.5) | {"learned_first": False, "seconds": 1.0},
        taught("taught grid 512³", 0, 1.0) | {"learned_first": True},
    ]
    ours = run("MLP (ours)", learn_seconds=3.0, occupancy=facts)
    held = {one.name: one for one in representations_of(lines_of(results(ours)))}
    assert held["taught grid 64³"].median("learn_seconds") == 23.0
    assert held["sparse points"].median("learn_seconds") == 1.0
    assert [held[f"grid {cells}³"].median("size") for cells in (64, 128)] == [2.0, 262.144]
    assert "taught grid 512³" not in held
    left = "Left out, for keeping all space in some run: taught grid 512³."
    assert left in table(results(ours))
    assert not any(one.ours for name, one in held.items() if name != "MLP (ours)")
    assert verdict([*held.values()]) == (
        "MLP (ours): nothing learned as soon keeps less space; as small, less is kept by taught "
        "grid 64³ (one seed: no verdict)"
    )


def test_small_gates_that_the_field_has_taught_stand_beside_those_of_their_kind() -> None:
    facts = occupancy(50_000, 0.2)
    facts["at_equal_loss"]["taught"] = [taught("MLP", 5000, 0.1), taught("hash grid", 9000, 0.12)]
    ours = run("MLP (ours)", learn_seconds=9.0, occupancy=facts)
    rival = run("hash grid", sampler="learned-occupancy-hash", occupancy=occupancy(10**6, 0.15))
    held = representations_of(lines_of(results(ours, rival)))
    assert [one.name for one in held] == [
        "MLP (ours)",
        SMALL_OURS,
        "small hash grid",
        "hash grid",
    ]
    large, small, hashed, rival_gate = held
    assert small.by_seed == {0: Held(5.0, 29.0, 10.0, 20.0)} and small.ours and not hashed.ours
    assert small.is_small_of(large) and hashed.is_small_of(rival_gate)
    assert not small.is_small_of(rival_gate) and not large.is_small_of(large)
    assert verdict(held) == (
        "small MLP (ours) keeps least space, 10.0% in 5 kB. MLP (ours): as small, less is kept "
        "by small MLP (ours); learned as soon, less is kept by hash grid (one seed: no verdict)"
    )


def test_what_is_ahead_of_the_gate_that_a_run_writes_is_said_whatever_a_small_one_keeps() -> None:
    facts = occupancy(50_000, 0.3)
    facts["at_equal_loss"]["taught"] = [taught("MLP", 5000, 0.2)]
    other = run("hash grid", sampler="learned-occupancy-hash", occupancy=occupancy(9_000, 0.1))
    ours = run("MLP (ours)", occupancy=facts)
    said = verdict(representations_of(lines_of(results(ours, other))))
    assert said.startswith(
        "small MLP (ours): nothing as small keeps less space; learned as soon, less is kept by "
        "hash grid. MLP (ours): as small, less is kept by hash grid"
    )


def test_a_gate_that_was_not_always_frozen_is_named() -> None:
    ours, hashed, planes = (f"learned-occupancy{kind}" for kind in ("", "-hash", "-vm"))
    runs = [
        run(f"gate{kind}", sampler=kind, occupancy=occupancy(9, 0.1)) for kind in (ours, hashed)
    ]
    made = results(*runs, run("planes", sampler=planes))
    assert finding_of(made).endswith("; 1 not always frozen")
    assert "Left out, for not frozen with every seed: planes." in table(made)


def test_a_small_gate_that_is_missing_with_one_seed_is_not_compared() -> None:
    runs = []
    for seed in (0, 1):
        facts = occupancy(50_000, 0.2)
        facts["at_equal_loss"]["taught"] = [taught("MLP", 5000, 0.1)][seed:]
        runs.append(run("MLP (ours)", seed, occupancy=facts))
        other = occupancy(10**6, 0.15)
        runs.append(run("hash grid", seed, sampler="learned-occupancy-hash", occupancy=other))
    names = [one.name for one in representations_of(lines_of(results(*runs)))]
    assert names == ["MLP (ours)", "hash grid"]


def test_grids_have_no_learning_time_and_are_on_no_front_of_it() -> None:
    ours = run("MLP (ours)", learn_seconds=9.0, occupancy=occupancy(50_000, 0.3, GRIDS))
    held = representations_of(lines_of(results(ours)))
    assert [one.has("learn_seconds") for one in held] == [True, False, False]
    assert [fronts_of(one, held) for one in held] == [["learning time"], ["size"], ["size"]]


def test_equals_do_not_beat_one_another() -> None:
    held = gates(*[(name, name, 50_000, 9.0, 0.1) for name in "AB"])
    assert [fronts_of(one, held) for one in held] == [["size", "learning time"]] * 2


@given(st.lists(st.tuples(*[st.integers(1, 5)] * 3), min_size=1, max_size=8))
def test_fronts_are_those_of_the_definition(rows: list[tuple[int, int, int]]) -> None:
    held = [Representation(str(i), {0: Held(*map(float, row))}) for i, row in enumerate(rows)]
    for one, (size, seconds, kept) in zip(held, rows):
        by_size = (size, -kept) in slow_front([(a, -k) for a, _, k in rows])
        by_time = (seconds, -kept) in slow_front([(b, -k) for _, b, k in rows])
        expected = ["size"] * by_size + ["learning time"] * by_time
        assert fronts_of(one, held) == expected


GATES = {
    "ours": ("MLP (ours)", "learned-occupancy", 50_000, 9.0, 0.1),
    "wide": ("MLP (ours)", "learned-occupancy", 50_000, 9.0, 0.3),
    "faster": ("hash grid", "learned-occupancy-hash", 4_000_000, 3.0, 0.05),
    "less": ("hash grid", "learned-occupancy-hash", 60_000, 10.0, 0.2),
    "smaller": ("K-planes", "learned-occupancy-k-planes", 40_000, 10.0, 0.1),
    "least": ("planes", "learned-occupancy-vm", 40_000, 12.0, 0.4),
}


@pytest.mark.parametrize(
    ("names", "said"),
    [
        (
            "faster ours",
            "MLP (ours): nothing as small keeps less space; learned as soon, less is kept by hash "
            "grid",
        ),
        (
            "ours faster smaller",
            "MLP (ours): as small, less is kept by K-planes; learned as soon, less is kept by hash "
            "grid",
        ),
        ("faster smaller", "our own gate was not frozen with every seed"),
        ("wide less", "MLP (ours): nothing as small or learned as soon keeps less space"),
        ("wide less least", "MLP (ours): nothing as small or learned as soon keeps less space"),
    ],
)
def test_the_verdict_says_where_ours_stands_and_what_is_ahead(names: str, said: str) -> None:
    found = verdict(gates(*(GATES[name] for name in names.split())))
    assert found.removesuffix(" (one seed: no verdict)") == said
