"""Claims about what is said of occupancies that were learned, and over charts of them."""

from __future__ import annotations

from pathlib import Path

import pytest
from chart_results import occupancy, results, run
from PIL import Image

from leco_plugin.chart.learned import learned_headline, learned_of, words_of
from leco_plugin.chart.panels import finding_of
from leco_plugin.chart.picture import draw
from leco_plugin.chart.summary import lines_of
from leco_plugin.chart.table import table

BY_STEPS = {"suite": "losses", "protocol": {"seconds": None, "steps": 400}}


def skipping(name: str, *shares: float | None) -> list[dict]:
    """A run for each share of candidates skipped; one without never froze its gate."""
    return [
        run(name, seed, freeze_seconds=None)
        if share is None
        else run(name, seed, occupancy=occupancy(51_000, 0.1) | {"empty_fraction": share})
        for seed, share in enumerate(shares)
    ]


def test_figures_are_of_the_seeds_that_froze_a_gate() -> None:
    (one,) = learned_of(lines_of(results(*skipping("A", 0.5, None, 0.7))))
    assert (len(one.facts), one.seeds, one.is_measured) == (2, 3, False)
    assert one.figure("empty_fraction") == pytest.approx(0.6)
    assert one.figure("at_equal_loss.kept_reached_volume") == 0.1
    assert one.figure("kept_surface_recall") is None and one.healed is None


def test_an_occupancy_that_is_left_of_a_gate_that_was_opened_again_is_none() -> None:
    left = run("A", freeze_seconds=None, occupancy=occupancy(51_000, 0.1))
    assert learned_of(lines_of(results(left))) == []


def test_a_gate_that_a_host_learned_first_was_healed_as_often_as_its_file_says() -> None:
    """The run of such a host notes nothing of it."""
    runs = skipping("A", 0.5, 0.7)
    for made, count in zip(runs, (2, 1)):
        made["recoveries"] = None
        made["occupancy"]["recoveries"] = count
    (one,) = learned_of(lines_of(results(*runs)))
    assert one.healed == 3
    runs[0]["recoveries"] = 0  # of a model that learns itself, which goes before
    assert one.healed == 1
    runs[1]["occupancy"]["recoveries"] = None
    assert one.healed is None


def keeping(name: str, *figures: tuple[float, float]) -> list[dict]:
    """A run for each share of space kept and PSNR."""
    return [
        run(name, seed, psnr=psnr, occupancy=occupancy(51_000, kept))
        for seed, (kept, psnr) in enumerate(figures)
    ]


OURS = keeping("A (ours)", (0.05, 21.0), (0.06, 20.0), (0.05, 21.0))


def title(*others: list[dict]) -> str:
    return finding_of(results(*OURS, *(run for of in others for run in of), **BY_STEPS))


def test_the_finding_of_a_suite_by_steps_is_of_space_kept_at_equal_loss_and_of_psnr() -> None:
    worse = keeping("B", (0.5, 19.0), (0.4, 18.5), (0.6, 19.0))
    wasteful = keeping("C", *[(0.9, 22.0)] * 3)
    assert title(worse) == (
        "A (ours) keeps 5.0% of the space at 20.7 dB: the least, at the highest PSNR (3 seeds); "
        "the others keep 50%"
    )
    assert title(worse, wasteful) == (
        "A (ours) keeps 5.0% of the space at 20.7 dB: none is better in both (3 seeds); the others "
        "keep 50% to 90%"
    )
    assert title(worse, skipping("D", 0.8, None, 0.8)).endswith("; 1 not always frozen")
    of_time = [
        run(name, seed, psnr) for name, psnr in (("A", 22.0), ("B", 20.0)) for seed in (0, 1)
    ]
    assert "ahead" in finding_of(results(*of_time, suite="freeze"))
    assert learned_headline(learned_of(lines_of(results(*skipping("C", None, 0.9))))) == (
        "no gate was frozen with every seed"
    )


def test_what_is_better_in_both_leads_the_title() -> None:
    better = keeping("B", *[(0.03, 22.5)] * 3)
    said = "B keeps 3.0% of the space at 22.5 dB, A (ours) 5.0% of the space at 20.7 dB (3 seeds)"
    assert title(better) == said
    once_worse = keeping("B", (0.03, 22.5), (0.03, 22.5), (0.055, 22.5))
    assert "none is better in both (3 seeds); the others keep 3.0%" in title(once_worse)
    alone = keeping("A (ours)", (0.05, 21.0)) + keeping("B", (0.04, 22.0))
    assert finding_of(results(*alone, **BY_STEPS)).endswith(
        ": one seed: no verdict; the others keep 4.0%"
    )


def test_a_title_without_ours_says_so() -> None:
    other = keeping("B", *[(0.04, 22.0)] * 3)
    never = skipping("A (ours)", 0.8, None, 0.8)
    assert finding_of(results(*never, *other, **BY_STEPS)) == "Ours was not frozen with every seed"


def test_those_that_seeds_do_not_tell_apart_in_both_are_level() -> None:
    ours = keeping("A (ours)", (0.05, 20.6), (0.051, 20.7), (0.052, 20.8))
    near = keeping("near", (0.05, 20.6), (0.052, 20.8), (0.054, 20.9))
    vague = keeping("vague", (0.05, 20.0), (0.052, 20.8), (0.054, 22.0))
    more = keeping("more", (0.055, 25.0), (0.07, 25.0), (0.08, 25.0))
    wide = keeping("wide", (0.25, 20.5), (0.3, 20.5), (0.35, 20.5))
    others = [*near, *vague, *more, *wide, *skipping("never", 0.5)]
    learned = learned_of(lines_of(results(*ours, *others)))
    words = {one.name: words_of(learned[0], one) for one in learned[1:]}
    assert [name for name, its in words.items() if its == {"level"}] == ["near"]
    assert words["vague"] == {"level", "undecided"}


def test_a_gate_that_was_frozen_with_the_last_step_has_guided_nothing() -> None:
    late = run("A", freeze_seconds=9.91, occupancy=occupancy(51_000, 0.1))
    sooner = run("A", freeze_seconds=9.89, occupancy=occupancy(51_000, 0.1))
    assert learned_of(lines_of(results(sooner)))[0].guided_nothing == 0
    (one,) = learned_of(lines_of(results(late, run("A", 1, occupancy=occupancy(51_000, 0.1)))))
    assert (one.guided_nothing, one.is_measured) == (1, True)
    assert "| 2 of 2, 1 at the end |" in table(
        results(late, run("A", 1, occupancy=occupancy(51_000, 0.1)))
    )


def test_the_picture_of_such_a_suite_is_drawn(tmp_path: Path) -> None:
    runs = [*skipping("A", 0.7, 0.8), *skipping("B", 0.6, None), *skipping("C", None, None)]
    with Image.open(draw(results(*runs, **BY_STEPS), tmp_path / "chart.png")) as image:
        assert len(image.convert("RGB").getcolors(1 << 20)) > 50
