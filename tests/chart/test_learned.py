"""Claims about what is said of occupancies that were learned, and over charts of them."""

from __future__ import annotations

from pathlib import Path

import pytest
from chart_results import occupancy, results, run
from PIL import Image

from leco_plugin.chart.drawing.picture import draw
from leco_plugin.chart.drawing.title import title_of
from leco_plugin.chart.findings.learned import learned_headline, learned_of
from leco_plugin.chart.findings.summary import lines_of

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
    assert (len(one.facts), one.seeds, one.always_frozen) == (2, 3, False)
    assert one.median("empty_fraction") == pytest.approx(0.6)
    assert one.median("at_equal_loss.kept_reached_volume") == 0.1
    assert one.median("kept_surface_recall") is None and one.healed is None


def test_an_occupancy_that_is_left_of_a_gate_that_was_opened_again_is_none() -> None:
    left = run("A", freeze_seconds=None, occupancy=occupancy(51_000, 0.1))
    assert learned_of(lines_of(results(left))) == []


def test_the_title_of_a_suite_by_steps_says_who_skips_more_and_not_whose_psnr_is_higher() -> None:
    runs = [*skipping("A", 0.7, 0.8), *skipping("B", 0.6, 0.5), *skipping("C", None, 0.9)]
    made = results(*runs, **BY_STEPS)
    said = "A skips 75% of the candidates: B less, 55%, C partly frozen"
    assert title_of(made) == said
    alike = [*skipping("A", 0.7, 0.8), *skipping("B", 0.71, 0.6), *skipping("C", 0.1, 0.1)]
    assert title_of(results(*alike, **BY_STEPS)) == (
        "A skips 75% of the candidates: B alike, C less, 10%"
    )
    assert "ahead" in title_of(results(run("A", psnr=22.0), run("B"), suite="freeze"))
    assert learned_headline(learned_of(lines_of(results(*skipping("C", None, 0.9))))) == (
        "no gate was frozen with every seed"
    )


def test_less_than_a_hundredth_is_not_told_apart_whatever_its_sign() -> None:
    runs = [*skipping("A", 0.8, 0.8, 0.8), *skipping("B", 0.799, 0.7905, 0.7)]
    assert title_of(results(*runs, **BY_STEPS)) == "A skips 80% of the candidates: B alike"
    runs[4]["occupancy"]["empty_fraction"] = 0.78
    assert title_of(results(*runs, **BY_STEPS)) == "A skips 80% of the candidates: B less, 78%"


def test_the_picture_of_such_a_suite_is_drawn(tmp_path: Path) -> None:
    runs = [*skipping("A", 0.7, 0.8), *skipping("B", 0.6, None), *skipping("C", None, None)]
    with Image.open(draw(results(*runs, **BY_STEPS), tmp_path / "chart.png")) as image:
        assert len(image.convert("RGB").getcolors(1 << 20)) > 50
