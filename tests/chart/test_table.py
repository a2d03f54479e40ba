"""Claims about the table of a chart."""

from __future__ import annotations

from pathlib import Path

from chart_results import occupancy, results, run

from leco_plugin.chart.table import table, write_table

FAILURE = {"name": "B", "method": "b", "sampler": "own", "seed": 1, "reason": "a | b"}


def rows(text: str, first: str) -> list[list[str]]:
    """Cells of the table rows that begin with a name."""
    lines = [line for line in text.splitlines() if line.startswith(f"| {first} |")]
    return [[cell.strip() for cell in line.strip("|").split(" | ")] for line in lines]


def test_every_contender_has_a_row_with_its_figures() -> None:
    runs = [run("A", 0, 20.0), run("A", 1, 21.0), run("B", psnr=19.0)]
    text = table(results(*runs))
    (cells,) = rows(text, "A")
    assert cells[1:3] == ["2", "20.50 (20.00 to 21.00)"]
    assert rows(text, "B")[0][2] == "19.00"
    assert "-" in cells  # no LPIPS


def test_the_front_of_a_column_is_bold() -> None:
    cheap = run("A", psnr=19.0, render_seconds_per_image=0.5)
    good = run("B", psnr=21.0, render_seconds_per_image=2.0)
    beaten = run("C", psnr=20.0, render_seconds_per_image=3.0)
    text = table(results(cheap, good, beaten))
    assert "**0.5**" in rows(text, "A")[0]
    assert "**2**" in rows(text, "B")[0]
    assert "3" in rows(text, "C")[0] and "**3**" not in rows(text, "C")[0]


def test_learning_elsewhere_is_a_part_of_the_field_queries() -> None:
    queries = {"field": 3_000_000, "proposal": 0, "learning": 2_000_000}
    assert rows(table(results(run("A", train_queries=queries))), "A")[0][-1] == "5"


def test_failures_are_rows_and_cannot_break_the_table() -> None:
    text = table(results(run("A"), failures=[FAILURE]))
    assert "| B | 1 | failed: a \\| b |" in text


def test_a_chart_without_any_run_says_why(tmp_path: Path) -> None:
    path = write_table(results(failures=[FAILURE]), tmp_path / "table.md")
    assert "failed: a" in path.read_text()


def test_occupancies_have_a_table_of_their_own() -> None:
    text = table(results(run("A", occupancy=occupancy(51_000, 0.125)), run("B")))
    assert len(rows(text, "A")) == 2 and len(rows(text, "B")) == 1
    assert rows(text, "A")[1][2] == "51" and "12.5" in rows(text, "A")[1]


def test_the_command_and_the_question_are_there() -> None:
    text = table(results(run("A"), suite="losses", question="What do they do?"))
    assert "What do they do?" in text and "`leco chart --data city`, 2024-02-29" in text


def test_runs_of_other_charts_are_counted() -> None:
    assert "other charts" not in table(results(run("A"), run("B")))
    text = table(results(run("A"), run("B", reused=True), run("B", 1, reused=True)))
    assert "2 of the runs were made for other charts." in text


def test_representations_say_on_which_front_they_are_and_whether_ours_is() -> None:
    ours = run("MLP (ours)", occupancy=occupancy(51_000, 0.125), learn_seconds=9.0)
    other = run(
        "hash grid",
        sampler="learned-occupancy-hash",
        occupancy=occupancy(4_000_000, 0.1),
        learn_seconds=8.0,
    )
    text = table(results(ours, other))
    assert rows(text, "MLP (ours)")[-1] == ["MLP (ours)", "51", "9", "12.5", "size"]
    assert rows(text, "hash grid")[-1][-1] == "size, learning time"
    assert (
        "MLP (ours) is on the front of size only: it is beaten in learning time by hash grid."
        in text
    )


def test_grids_that_could_not_be_made_are_named() -> None:
    ours = run("MLP (ours)", occupancy=occupancy(51_000, 0.125))
    other = run("planes", sampler="learned-occupancy-vm", occupancy=occupancy(4_000_000, 0.1))
    assert "for want of" not in table(results(ours, other))
    ours["occupancy"]["at_equal_loss"]["left_out"] = [512, 1024]
    assert "Not in every run, for want of memory or time: grid 512³, 1024³." in table(
        results(ours, other)
    )
