"""Claims about the table of a chart."""

from __future__ import annotations

from chart_results import occupancy, results, run

from leco_plugin.chart.table import number, spread, table

FAILURE = {"name": "B", "method": "b", "sampler": "own", "seed": 1, "reason": "a | b"}


def rows(text: str, first: str) -> list[list[str]]:
    """Cells of the table rows that begin with a name."""
    lines = [line for line in text.splitlines() if line.startswith(f"| {first} |")]
    return [[cell.strip() for cell in line.strip("|").split(" | ")] for line in lines]


def test_every_contender_has_a_row_with_its_figures() -> None:
    runs = [run("A", 0, 20.0), run("A", 1, 21.0), run("B", psnr=19.0)]
    text = table(results(*runs))
    cells, asked = rows(text, "A")
    assert asked[1] == "31"
    assert cells[1:3] == ["2", "20.50 (20.00 to 21.00)"]
    assert rows(text, "B")[0][2] == "19.00"


def test_each_figure_stands_in_its_column_and_unit() -> None:
    queries = {"field": 2_000_000, "learning": 3_000_000, "proposal": 4_000_000, "gate": 5_000_000}
    figures = {"flip": 0.25, "lpips": 0.4, "image_psnr": 20.5, "ssim": 0.75, "steps": 123}
    figures |= {"train_seconds": 45.0, "learn_seconds": 6.7, "step_seconds": 0.0789}
    figures |= {"render_seconds_per_image": 1.25, "peak_memory_bytes": 3_500_000_000}
    figures |= {"field_queries_per_ray": 67.0, "proposal_queries_per_ray": 8.0}
    figures |= {"gate_queries_per_ray": 9.0, "train_queries": queries}
    learned = occupancy(50_000, 0.125) | {"params": 21, "learn_seconds": 5.5}
    learned |= {"kept_surface_recall": 0.97, "free_space_skipped": 0.61}
    first = {"empty_fraction": 0.9, "image_price_db": 0.02, "lost_surface_mass": 2e-4}
    text = table(results(run("A", occupancy=learned, at_freezing=first, **figures)))
    names = ("method", "occupancy of", "positions asked of")
    found = [
        dict(zip(rows(text, name)[0][1:], cells[1:], strict=True))
        for name, cells in zip(names, rows(text, "A"), strict=True)
    ]
    quality = {"PSNR, dB": "20.00", "mean PSNR of images": "20.50", "SSIM": "0.750"}
    quality |= {"FLIP": "0.250", "LPIPS": "0.400", "s to 20.0 dB": "10", "seeds": "1"}
    spent = {"steps": "123", "trained, s": "45", "of which learning, s": "6.7", "ms a step": "78.9"}
    costs = {"rendering an image, s": "**1.25**", "peak memory, GB": "**3.5**"}
    assert found[0] == quality | spent | costs | {"field queries a ray": "**67**"}
    assert found[1] == {
        **{"frozen": "1 of 1", "healed": "-", "parameters": "21", "kB": "50"},
        **{"learned in, s": "5.5", "candidates skipped, %": "90", "price, dB": "0.02"},
        **{"lost surface mass": "0.0002", "skipped at the end, %": "80"},
        **{"price at the end, dB": "0.01", "lost at the end": "0.0001"},
        **{"volume kept at 1e-3, %": "12.5", "true surface kept, %": "97"},
        "free space skipped, %": "61",
    }
    assert found[2] == {
        **{"field, a ray": "67", "proposals, a ray": "8", "frozen gate, a ray": "9"},
        **{"field in training, M": "2", "field that learns first, M": "3"},
        **{"proposals in training, M": "4", "frozen gate in training, M": "5"},
    }


def test_a_number_has_three_digits() -> None:
    found = [number(value) for value in (None, 1234.6, 100.4, 99.46, 12.345, 0.01234, 7.0, -250.4)]
    assert found == ["-", "1235", "100", "99.5", "12.3", "0.0123", "7", "-250"]
    assert number(0.12345, 100.0) == "12.3"


def test_figures_that_no_run_has_are_a_line_and_those_that_one_lacks_are_a_dash() -> None:
    text = table(results(run("A", flip=0.25, image_psnr=20.5), run("B", psnr=19.0)))
    header = rows(text, "method")[0]
    assert header[2:6] == ["PSNR, dB", "mean PSNR of images", "SSIM", "FLIP"]
    assert rows(text, "A")[0][3:6] == ["20.50", "0.500", "0.250"]
    assert rows(text, "B")[0][3:6] == ["-", "0.500", "-"]
    assert "\n\nNot measured: LPIPS.\n" in text
    of_before = table(results(run("A")))
    assert "Not measured: mean PSNR of images, FLIP, LPIPS." in of_before


def test_a_figure_that_a_seed_lacks_is_a_dash() -> None:
    assert spread([1.0, 4.0, 1.0], ".1f") == "1.0 (1.0 to 4.0)"
    assert spread([1.0, None], ".1f") == spread([], ".1f") == "-"


def test_what_is_passed_by_the_first_evaluation_was_passed_then_at_the_latest() -> None:
    early = run("A", psnr=24.0, curve=[[20.0, 22.0], [30.0, 24.0]])
    late = run("A", 1, psnr=24.0, curve=[[21.0, 18.0], [31.0, 23.0]])
    other = [run("B", seed, sampler="own", curve=[[20.0, 18.0], [40.0, 20.0]]) for seed in (0, 1)]
    for runs, to_level, passed, sooner in (
        ([early], "≤ 20", "≤ 20", "≥ 2.00"),
        ([late], "25", "25", "1.60"),
        ([early, late], "≤ 22.5", "≤ 22 (≤ 20 to 25)", "≥ 1.80 (1.60 to ≥ 2.00)"),
    ):
        text = table(results(*runs, *other, protocol={"seconds": None, "steps": 400}))
        assert rows(text, "method")[0][4] == "s to 20.0 dB" and rows(text, "A")[0][4] == to_level
        assert rows(text, "A against B")[0][2:4] == [passed, sooner]


def test_a_bound_below_the_median_leaves_it_as_it_is() -> None:
    bounds = [True, False, False]
    assert spread([1.0, 2.0, 3.0], ".0f", is_bound=bounds, sign="≤") == "2 (≤ 1 to 3)"
    assert spread([3.0, 2.0, 1.0], ".0f", is_bound=bounds, sign="≤") == "≤ 2 (≤ 1 to ≤ 3)"
    assert spread([3.0, 2.0, 1.0], ".0f", is_bound=bounds, sign="≥") == "2 (1 to ≥ 3)"
    assert spread([3.0, None, 1.0], ".0f", is_bound=bounds, sign="≤") == "-"


def test_the_front_of_a_column_is_bold() -> None:
    cheap = run("A", psnr=19.0, render_seconds_per_image=0.5)
    good = run("B", psnr=21.0, render_seconds_per_image=2.0)
    beaten = run("C", psnr=20.0, render_seconds_per_image=3.0)
    text = table(results(cheap, good, beaten))
    assert "**0.5**" in rows(text, "A")[0]
    assert "**2**" in rows(text, "B")[0]
    assert "3" in rows(text, "C")[0] and "**3**" not in rows(text, "C")[0]


def test_every_kind_of_question_is_counted_and_those_that_nobody_asked_are_left_out() -> None:
    queries = {"field": 3_000_000, "proposal": 0, "learning": 2_000_000, "gate": 7_000_000}
    text = table(results(run("A", train_queries=queries)))
    asked = ["field, a ray", "field in training, M", "field that learns first, M"]
    assert rows(text, "positions asked of")[0][1:] == [*asked, "frozen gate in training, M"]
    assert rows(text, "A")[-1][1:] == ["31", "3", "2", "7"]


def test_failures_are_rows_and_cannot_break_the_table() -> None:
    text = table(results(run("A"), failures=[FAILURE]))
    assert "| B | 1 | failed: a \\| b |" in text


def test_occupancies_have_a_table_of_their_own() -> None:
    text = table(results(run("A", occupancy=occupancy(51_000, 0.125)), run("B", sampler="own")))
    assert len(rows(text, "A")) == 3 and len(rows(text, "B")) == 2
    assert rows(text, "A")[1][4] == "51" and "12.5" in rows(text, "A")[1]


def test_a_gate_that_was_not_frozen_with_every_seed_has_a_row_that_says_so() -> None:
    skips = [occupancy(51_000, 0.1) | {"empty_fraction": share} for share in (0.6, 0.2)]
    runs = [run("A", seed, occupancy=one, recoveries=1) for seed, one in enumerate(skips)]
    never = run("A", 2, freeze_seconds=None, recoveries=3)
    text = table(results(*runs, never, run("B", freeze_seconds=None, recoveries=0)))
    assert rows(text, "A")[1][1:3] == ["2 of 3", "5"] and rows(text, "A")[1][6] == "40"
    assert rows(text, "B")[1][1:3] == ["0 of 1", "0"]


def test_what_a_gate_cost_when_it_was_frozen_stands_beside_what_it_skips_at_the_end() -> None:
    at_first = {"empty_fraction": 0.9, "image_price_db": 0.02, "lost_surface_mass": 2e-4}
    made = run("A", occupancy=occupancy(51_000, 0.1), at_freezing=at_first)
    cells = rows(table(results(made)), "A")[1]
    assert cells[6:10] == ["90", "0.02", "0.0002", "80"]
    assert cells[10:12] == ["0.01", "0.0001"]  # what the file declares


def test_runs_of_several_states_of_the_code_are_named() -> None:
    runs = [run("A", code="1b"), run("A", 1, code="1b"), run("B", code="2c")]
    assert "Not all of them are of the same code, nor made in turns (1b: A; 2c: B)." in table(
        results(*runs)
    )
    assert "same code" not in table(results(*runs[:2]))


def test_it_is_said_how_long_all_runs_took_and_which_grids_are_still_warming_up() -> None:
    runs = [run("A", wall_seconds=300.0), run("B", wall_seconds=840.0, warming_up=True)]
    text = table(results(*runs, protocol={"seconds": 10.0, "steps": None, "at_once": 2}))
    assert "All runs together took 10 min." in text
    assert "of the runs were made" not in text and "took" not in table(results(*runs, run("C")))
    assert "All runs together took 19 min." in table(results(*runs))
    reused = [one | {"reused": number > 0} for number, one in enumerate([*runs, run("C")])]
    assert " 2 of the runs were made for other charts." in table(results(*reused))
    assert "Ended in the warm-up of their grid, which asks all cells: B." in text


def test_grids_that_could_not_be_made_are_named() -> None:
    ours = run("MLP (ours)", occupancy=occupancy(51_000, 0.125))
    other = run("planes", sampler="learned-occupancy-vm", occupancy=occupancy(4_000_000, 0.1))
    assert "for want of" not in table(results(ours, other))
    ours["occupancy"]["at_equal_loss"]["left_out"] = [512, 1024]
    said = "Left out, for want of memory or time in some run: grid 512³, 1024³."
    assert said in table(results(ours, other))


def test_a_test_on_a_stretch_of_cameras_is_said() -> None:
    said = "tested on a whole stretch of 3 cameras"
    assert said not in table(results(run("A")))
    held_out = {"kind": "stretch", "test": ["a", "b", "c"], "beside": ["d"]}
    assert said in table(results(run("A"), held_out=held_out))
