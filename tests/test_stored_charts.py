"""What pages show of stored charts: sections, answers, the README's tables; of results made up."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import answers
import chart_sections as sections
import growth_picture
import learning
import pytest
from chart_results import occupancy, results, run
from eight_questions import eight_answers
from results_page import sampling_section

from leco_plugin.capacity import choice
from leco_plugin.chart.learned import learned_of
from leco_plugin.chart.panels import finding_of
from leco_plugin.chart.summary import lines_of

ROOT = Path(__file__).resolve().parents[1]
STEPS = {"protocol": {"seconds": None, "steps": 400}}

Store = Callable[..., None]


@pytest.fixture(autouse=True)
def store(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Store:
    """Stores results of a suite on a scene, where before there are none."""
    monkeypatch.setattr(sections, "RESULTS", tmp_path)
    monkeypatch.setattr(sections, "CHARTS", tmp_path / "charts")
    (tmp_path / "charts.json").write_text("{}")
    (tmp_path / "charts").mkdir()

    def write(suite: str | None, scene: str, *runs: dict[str, Any], **changes: Any) -> None:
        made = results(*runs, suite=suite, scene={"name": scene}, **changes)
        name = f"{scene}-{suite}" if suite else scene
        (tmp_path / "charts" / f"{name}.json").write_text(json.dumps(made))

    return write


def answered() -> str:
    return "\n".join(answers.answers_section())


def representations(other_seconds: float, grid_kept: tuple[float, ...] = (0.3,)) -> list[Any]:
    """Runs of our gate, grids from its field, and of a larger gate, for each seed."""
    runs = []
    for seed, kept in enumerate(grid_kept):
        grid = {"resolution": 64, "bytes": 32768, "update_seconds": 2.0}
        held = occupancy(50_000, 0.125, [{**grid, "kept_reached_volume": kept}])
        runs.append(run("MLP (ours)", seed, occupancy=held, learn_seconds=9.0))
        larger = {"occupancy": occupancy(4_000_000, 0.1), "learn_seconds": other_seconds}
        runs.append(run("hash grid", seed, sampler="learned-occupancy-hash", **larger))
    return runs


def test_without_suites_there_are_no_answers() -> None:
    assert answers.answers_section() == []


def capacity_of(*rows: tuple[str, str, int, float]) -> dict[str, Any]:
    """What is stored of `leco capacity`, of family, size, bytes and volume kept."""
    names = ("family", "size", "bytes", "kept_volume")
    return {
        "representations": [dict(zip(names, row)) for row in rows],
        "scene": {"train_images": 30},
    }


REPORTS = {
    "city-2": capacity_of(("vm", "4", 2_000, 0.04), ("grid", "64", 1_000, 0.05)),
    "city-4": capacity_of(("vm", "4", 3_000, 0.05), ("grid", "64", 900, 0.05)),
    "fog": capacity_of(("vm", "4", 3_000, 0.9), ("grid", "64", 900, 0.95)),
}


def test_eight_questions_have_an_answer_each_or_are_not_measured(store: Store) -> None:
    unknown = eight_answers(REPORTS)
    assert [line.split(".")[0] for line in unknown] == [*"12345678"]
    assert [line.endswith("Not measured.") for line in unknown] == [True] * 6 + [False] * 2
    assert "on `fog` the gate keeps 90%" in unknown[6]
    timed = {"protocol": {"seconds": 90.0, "steps": None, "at_once": 1}}
    names = ("learn, freeze, go on", "learn, freeze, from scratch", "never frozen")
    runs = [
        run(name, seed, psnr=psnr + 0.1 * seed)
        for name, psnr in zip(names, (22.0, 20.5, 23.0))
        for seed in range(3)
    ]
    store("freeze", "fox", *runs, **timed)
    answer = eight_answers(REPORTS)[3]
    assert answer.startswith("4. **Why freeze, and go on with the same network?** Going on ends ")
    assert "+1.5 dB above a new start (ahead on 1 of 1 scene), and -1.0 dB above a" in answer
    assert "frozen (ahead on none of 1 scene, behind it on 1). *Learn" in answer
    assert answer.endswith("ahead of the best other on none of 1 scene, behind it on 1.")


def test_a_comparison_of_one_seed_is_counted_as_without_a_verdict(store: Store) -> None:
    for number, scene in enumerate(("city", "fox")):
        runs = [run(name, seed, psnr=20.0 + seed) for name in "AB" for seed in range(number + 1)]
        store("freeze", scene, *runs)
    assert "best other on none of 2 scenes, undecided on 1, without a verdict on 1." in answered()
    store("losses", "fox", run("A (ours)", occupancy=occupancy(5, 0.1)), run("B"), **STEPS)
    assert "On 1 of 1 scene the seeds show no other ahead of ours" in answered()
    held = {"occupancy": occupancy(5, 0.2)}
    store("losses", "fox", run("A (ours)", **held), run("B", **held), **STEPS)
    assert "On none of 1 scene the seeds show no other ahead of ours" in answered()


def test_small_gates_are_compared_where_there_are_any_and_with_one_grid_too(store: Store) -> None:
    def first() -> str:
        return eight_answers(REPORTS)[0]

    store("representations", "city", *representations(10.0), **STEPS)
    assert first().endswith("The small MLP was not measured.")
    runs = representations(10.0)
    at_equal_loss = runs[0]["occupancy"]["at_equal_loss"]
    taught = {"bytes": 4932, "seconds": 9.0, "kept_reached_volume": 0.05}
    at_equal_loss["taught"] = [{"name": "MLP", **taught}]
    full = {"bytes": 0, "seconds": 1.0, "kept_reached_volume": 1.0, "learned_first": True}
    at_equal_loss["others"] = [{"name": "taught grid 256³", **full}]
    store("representations", "fox", *runs, **STEPS)
    assert "** Small MLP (ours) keeps least on every scene. A small MLP of 4.9 kB that" in first()
    assert (
        "keeps 5.0% of the space at equal loss in 1 scene; grids of densities of 33 kB" in first()
    )
    assert first().endswith(
        "keep 6.0 times as much. Sizes of grids are of octrees, on `city`, `fox` a bit a cell. "
        "Left out, for keeping all in some run: taught grid 256³ on `fox`."
    )


def test_it_is_said_for_every_scene_whether_ours_is_on_the_fronts(store: Store) -> None:
    store("representations", "city", *representations(other_seconds=10.0))
    store("representations", "fox", *representations(other_seconds=8.0))
    text = answered()
    assert (
        "MLP (ours): on 2 of 2 scenes nothing as small keeps less space, on 1 nothing that is "
        "learned as soon." in text
    )
    link = "#suite-representations-on-city"
    kept = "| 12.5%, 50 kB | 30.0%, 33 kB | 10.0%, 4.0 MB |"
    assert f"| [city]({link}) {kept} MLP (ours): nothing as small or learned" in text
    assert "nothing as small keeps less space; learned as soon, less is kept by hash grid" in text


def test_a_grid_that_is_smaller_and_keeps_less_is_named(store: Store) -> None:
    store("representations", "city", *representations(10.0, grid_kept=(0.05,)), **STEPS)
    text = answered()
    assert (
        "on 0 of 1 scene nothing as small keeps less space," in text
        and "as small, less is kept by grid 64³ (one seed: no verdict) |" in text
    )


def test_one_that_keeps_less_in_the_median_only_is_said_to_be_undecided(store: Store) -> None:
    store("representations", "city", *representations(10.0, grid_kept=(0.05, 0.05, 0.3)), **STEPS)
    text = answered()
    assert "on 0 of 1 scene nothing as small keeps less space, on 1 nothing that is" in text
    assert "as small, less is kept by grid 64³ (undecided in space) (3 seeds) |" in text


def test_minutes_are_those_of_runs_two_at_a_time_and_shared_ones_count_once(store: Store) -> None:
    two = {"protocol": {"seconds": 60.0, "at_once": 2}}
    shared = run("A", wall_seconds=120.0)
    store("enough-time", "fox", shared, run("B", wall_seconds=300.0), **two)
    store("grid-resolution", "fox", {**shared, "reused": True}, run("C", wall_seconds=60.0), **two)
    store("freeze", "city", run("A", wall_seconds=60.0), run("B"), **two)
    text = answered()
    # 3.5 and 1.5 rounded to even; together 3.5 and 0.5 of its own, with the shared one twice 5
    assert "| fox | - | - | - | - | 4 | 2 | 4 |" in text
    assert "| city | - | - | - | - | - | - | - |" in text


def test_gates_compare_by_what_they_keep_and_runs_of_equal_time_by_their_ends(
    store: Store,
) -> None:
    frozen, not_frozen = occupancy(50_000, 0.1), {"freeze_seconds": None}
    store("losses", "fox", run("A", occupancy=frozen), run("B", **not_frozen), **STEPS)
    store("freeze", "fox", run("A", psnr=21.0), run("B"))
    grid = {"sampler": "occupancy-grid-64", "train_seconds": 10.0, "learn_seconds": 5.0}
    store("grid-resolution", "fox", run("A"), run("B", **grid))
    text = answered()
    assert "| 20.0 dB, 1 s | 20.0 dB, 1 s (50% of the time for its grid) |" in text
    assert "| 10%, 20.0 dB | not frozen, 20.0 dB |" in text
    said = "A 21.0 dB, B 20.0 dB (one seed: no verdict); still rising at the end: all"
    assert f"| 21.0 dB, 1 s | 20.0 dB, 1 s | {said} |" in text


def test_a_run_that_ended_below_its_best_is_named_and_nobody_is_said_to_rise(store: Store) -> None:
    fell = run("A", curve=[[5.0, 20.0], [10.0, 18.0]])
    store("enough-time", "fox", fell, run("B", curve=[[5.0, 20.0], [10.0, 20.0]]))
    text = answered()
    assert "(one seed: no verdict); A fell by 2.0 dB from its best |" in text
    assert "still rising at the end" not in text


def test_a_gate_that_is_not_frozen_with_every_seed_says_with_how_many(store: Store) -> None:
    runs = [run("A", 0, occupancy=occupancy(5, 0.1)), run("A", 1, freeze_seconds=None)]
    store("losses", "fox", *runs, protocol={"seconds": None, "steps": 400})
    assert "| 1 of 2 frozen, 20.0 dB |" in answered()


def test_a_gate_that_was_frozen_with_the_last_step_is_told_apart(store: Store) -> None:
    runs = [run("A", 0, occupancy=occupancy(5, 0.03)), run("A", 1, occupancy=occupancy(5, 0.03))]
    runs[1]["freeze_seconds"] = runs[1]["train_seconds"]
    store("losses", "fox", *runs, protocol={"seconds": None, "steps": 400})
    assert "| 3.0% (1 of 2 frozen at the end), 20.0 dB |" in answered()


def test_a_scene_where_ours_has_no_figures_leaves_the_table_of_others(
    store: Store,
) -> None:
    store("representations", "city", run("MLP (ours)", freeze_seconds=None), **STEPS)
    store("representations", "fox", *representations(other_seconds=10.0), **STEPS)
    text = answered()
    assert "| 12.5%, 50 kB |" in text and "on 1 of 2 scenes" in text


def test_a_contender_that_a_scene_lacks_has_no_figure_there(store: Store) -> None:
    store("freeze", "city", run("A"))
    store("freeze", "fox", run("A"), run("B"))
    assert "| 20.0 dB, 1 s | - | A: 20.0 dB; still rising at the end: all |" in answered()


def test_a_chart_with_a_note_is_marked(store: Store, tmp_path: Path) -> None:
    store("freeze", "city", run("A"))
    (tmp_path / "notes.json").write_text('{"city-freeze": "Made before."}')
    assert "[city](#suite-freeze-on-city) (*) |" in answered()


def test_a_suite_is_shown_with_its_question_picture_figures_command_and_machine(
    store: Store,
) -> None:
    command = "leco chart --data fox --suite losses"
    made = {"date": "2024-02-29", "command": command, "version": "0.1.0", "commit": "1b"}
    store("losses", "fox", run("A", psnr=21.0), run("B"), question="Why?", made=made)
    text = "\n".join(sections.suite_sections())
    assert "## Suite `losses` on fox" in text and "Why?" in text
    assert "images/charts/fox-losses-dark.png" in text and "| A | 1 | 21.00 |" in text
    assert "`leco chart --data fox --suite losses`, 2024-02-29, leco_plugin 0.1.0 at 1b." in text
    assert "cores: 2, threads: 2, device: cpu." in text


def test_charts_with_a_title_come_first_and_suites_in_their_order(
    store: Store, tmp_path: Path
) -> None:
    for scene, suite in (("a", "losses"), ("b", "representations"), ("c", "losses"), ("z", None)):
        store(suite, scene, run("A"))
    (tmp_path / "charts.json").write_text('{"z": "Z"}')
    assert list(sections.titles()) == ["z", "b-representations", "a-losses", "c-losses"]
    assert sections.titles()["z"] == "Z"


def test_runs_of_more_time_than_their_suite_gives_stand_beside_its_answers(
    store: Store, tmp_path: Path
) -> None:
    def of(psnr: float) -> list[dict[str, Any]]:
        names = "learned occupancy", "long steps, no skipping"
        rising = [[100.0, psnr - 3.0], [400.0, psnr - 0.5], [600.0, psnr]]
        return [
            run(name, seed, psnr=psnr + 0.01 * seed - number, curve=rising)
            for number, name in enumerate(names)
            for seed in range(3)
        ]

    short = {"protocol": {"seconds": 120.0, "steps": None, "at_once": 2}}
    store("enough-time", "fox", *of(20.0), **short)
    (tmp_path / "charts" / "fox-enough-time.json").rename(tmp_path / "charts" / "fox.json")
    store("enough-time", "fox", *of(25.0), protocol={**short["protocol"], "seconds": 600.0})
    assert sections.by_scene("enough-time")["fox"][0] == "fox"
    ((title, results),) = sections.longer("enough-time")
    assert title == "Suite `enough-time` on fox, 600 s"
    assert results["protocol"]["seconds"] == 600.0
    answer = eight_answers(REPORTS)[4]
    assert "Switch-NeRF's runs of 120 s still rise with a learned occupancy on 1 of 1 sc" in answer
    assert "After 600 s on `fox` learned occ" in answer and "25.0 dB, 1.00" in answer
    assert "in the last third it gained 0.5 dB" in answer
    assert "(suites.md#suite-enough-time-on-fox-600-s)" in answer
    assert f"## {title}" in "\n".join(sections.suite_sections())


def test_a_chart_that_belongs_to_no_suite_is_on_the_other_page(store: Store) -> None:
    store(None, "z", run("A"))
    assert "## z" in "\n".join(sections.chart_sections())
    assert sections.suite_sections() == []


def test_the_papers_rows_stand_once_and_beside_the_first_chart(store: Store) -> None:
    for scene in ("city", "fox"):
        store("grid-resolution", scene, run("A"), question="Why?")
    text = "\n".join(sections.suite_sections())
    assert text.count("| grid 256³ | 25.86, 0.764, 0.409 | 46.0 | 12.5 |") == 1
    assert text.index("25.86") < text.index("on fox")


def test_a_sampling_section_says_when_and_of_which_code_it_is() -> None:
    report = {"machine": {"processor": "a processor"}, "figures": []}
    title, line, _ = sampling_section(report)
    assert title == "## Sampling: a processor\n" and line.endswith("Ratios within one run.\n")
    report |= {"date": "2026-11-23", "code": {"version": "0.1.0", "commit": "0123456789ab"}}
    title, line, _ = sampling_section(report)
    assert title == "## Sampling: a processor, 2026-11-23\n"
    assert line.endswith("within one run. leco_plugin 0.1.0 at 0123456789ab.\n")


def test_every_picture_says_its_finding_in_ten_words() -> None:
    """Numbers count, signs do not."""
    results = ROOT / "benchmarks" / "results"
    titles = {
        path.stem: finding_of(json.loads(path.read_text()), short=True)
        for path in sorted((results / "charts").glob("*.json"))
    }
    reports = {
        path.stem: json.loads(path.read_text()) for path in (results / "capacity").glob("*.json")
    }
    for name, report in reports.items():
        titles[name], said = choice.answer(report["representations"])
        assert report["verdict"] == said, name
    titles["growth"] = growth_picture.headline(growth_picture.cities(reports))
    titles["learning"] = learning.headline(json.loads((results / "learning.json").read_text()))
    for name, title in titles.items():
        words = [word for word in title.split() if any(map(str.isalnum, word))]
        assert len(words) <= 10, f"{name}: {title}"


def test_a_rival_is_better_only_where_it_is_ahead_in_one_and_not_behind_in_the_other() -> None:
    def answer(kept: float, psnr: float) -> bool:
        shares = {"A (ours)": 0.1, "B": kept}
        runs = [
            run(name, seed, occupancy=occupancy(51_000, share + 1e-3 * seed), psnr=db + 0.1 * seed)
            for (name, share), db in zip(shares.items(), (20.0, psnr))
            for seed in range(3)
        ]
        return answers._none_is_better(learned_of(lines_of(results(*runs, **STEPS))))

    assert answer(0.1, 20.0), "who is level is not better"
    assert answer(0.3, 22.0) and answer(0.02, 18.0), "who pays for what it gains is not better"
    assert not answer(0.1, 22.0) and not answer(0.02, 20.0) and not answer(0.02, 22.0)
