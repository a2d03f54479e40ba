"""What the README and the first section of results say of stored charts, made up ones mostly."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import chart_sections as sections
import comparisons
import pytest
import readme_parts as parts
from chart_results import results, run

ROOT = Path(__file__).resolve().parents[1]


def _row(method: str, sampler: str, psnrs: Sequence[float], **figures: Any) -> list[dict[str, Any]]:
    """A row of a chart, a run for each PSNR."""
    values = {"method": method, "sampler": sampler, "gate_queries_per_ray": 0.0} | figures
    name = f"{method} + {sampler}"
    return [run(name, seed, psnr=psnr, **values) for seed, psnr in enumerate(psnrs)]


def test_each_row_says_how_a_learned_occupancy_stands_beside_it() -> None:
    queries = {"field_queries_per_ray": 15.0, "gate_queries_per_ray": 5.0}
    learned = "learned-occupancy"
    chart = results(
        *_row("leco-nerfacto", learned, (30.0, 30.1, 30.2), **queries),
        *_row("leco-nerfacto", "own", (25.0, 25.1, 25.2), render_seconds_per_image=2.0),
        *_row("leco-nerfacto", "long-steps", (30.1, 30.2, 30.3)),
        *_row("leco-nerfacto", "dense", (31.0, 31.1, 31.2)),
        *_row("leco-ngp", learned, (24.0,)),
        *_row("leco-ngp", "own", (26.0,)),
        *_row("leco-switch-nerf", "own", (26.0,)),
    )
    head, _, ours, *others, _, words = parts.gain_table(chart).splitlines()
    what = "PSNR | to render an image | queries a ray | learned occupancy is"
    assert head == f"| `city`, 10 s on 2 CPU cores, 1 to 3 seeds | {what} |"
    row = (
        "| **leco-nerfacto + learned-occupancy** | 30.1 dB (30.0 to 30.2) | 1.0 s | 15 + 5 small |"
    )
    assert ours == f"{row}  |"
    own = "| leco-nerfacto + own | 25.1 dB (25.0 to 25.2) | 2.0 s | 31 |"
    assert others[0] == f"{own} ahead by 5.0 ± 0.2 dB |"
    assert [other.split(" | ")[-1] for other in others[1:]] == [
        *("level at -0.1 ± 0.2 dB |", "behind by 1.0 ± 0.2 dB |", " |"),
        *("-2.0 dB, one seed: no verdict |", " |"),
    ]
    assert words.startswith("A query asks a network about one point;")


@pytest.fixture
def four_charts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stored charts of three methods, one of them shown apart, one of another suite."""
    learned, grid = "learned-occupancy", "learned-occupancy-grid"
    runs = [
        *_row("Instant-NGP", "own", (20.0, 20.1)),
        *_row("Instant-NGP", "long-steps", (22.0, 22.1), render_seconds_per_image=3.0),
        *_row("Instant-NGP", learned, (24.0, 24.1)),
        *_row("Nerfacto", learned, (24.0, 25.0), render_seconds_per_image=2.0),
        *_row("Nerfacto", "own", (23.0, 25.5)),
    ]
    taught = [
        one | {"name": f"Instant-NGP + taught grid {cells}³"}
        for cells in (16, 32)
        for one in _row("Instant-NGP", grid, (24.0 + cells / 16.0, 24.1 + cells / 16.0))
    ]
    switch = [*_row("Switch-NeRF", learned, (20.0,)), *_row("Switch-NeRF", "own", (21.0,))]
    charts = {
        "apart": results(*runs),
        "stretch": results(*runs, *taught, held_out={"test": [1, 2]}),
        "longer": results(*switch, suite="enough-time"),
        "other": results(*switch, suite="freeze"),
    }
    monkeypatch.setattr(comparisons, "titles", lambda: {name: f"A {name}" for name in charts})
    monkeypatch.setattr(comparisons, "stored", charts.__getitem__)
    monkeypatch.setattr(sections, "notes", lambda: {"longer": "Made before."})


def test_every_stored_chart_is_compared_with_its_best_row(four_charts: None) -> None:
    found = comparisons.comparisons(("apart",))
    assert comparisons.in_words(found, "page.md") == (
        "**In 3 other comparisons** with the best rival (more scenes, an unseen stretch, up to "
        "half an hour) a learned occupancy is ahead in 1 of 3, undecided in 1, without a verdict "
        "in 1, behind in none. By method: Instant-NGP ahead in 1 of 1; Nerfacto ahead in 0 of 1, "
        "undecided in 1; Switch-NeRF ahead in 0 of 1, without a verdict in 1 "
        "([all of them](page.md#every-comparison-with-the-best-rival))."
    )
    title, _, rows = comparisons.comparison_section(found)
    assert title == "## Every comparison with the best rival\n"
    guided, nerfacto, switch = rows.splitlines()[2:]
    assert guided == (
        "| [Instant-NGP, `city`, unseen stretch, 10 s, 2 seeds](#a-stretch) | 24.1 dB | "
        "22.1 dB, long-steps | ahead by 2.0 ± 0.3 dB, each seed ahead | 3.0 x as fast | "
        "32³ 26.1 dB: behind by 2.0 ± 0.3 dB; 16³ 25.1 dB: behind by 1.0 ± 0.3 dB |"
    )
    assert "| 24.2 dB, own | undecided at 0.2 ± " in nerfacto
    assert nerfacto.endswith(" dB | in 2.0 x the time |  |")
    assert switch.startswith(
        "| [Switch-NeRF, `city`, 10 s, one seed](suites.md#a-longer) (*) | 20.0 dB | 21.0 dB, own "
        "| -1.0 dB, one seed: no verdict |"
    )
    assert len(comparisons.comparisons(())) == 5


def test_the_gain_says_how_many_runs_failed() -> None:
    failed = [{"name": "LeCO + own", "seed": 1, "reason": "no memory"}]
    ours = [run("LeCO + learned-occupancy", seed, gate_queries_per_ray=1.0) for seed in (0, 1)]
    own = run("LeCO + own", sampler="own", gate_queries_per_ray=0.0)
    text = parts.gain_table(results(*ours, own, failures=failed))
    assert "| `city`, 10 s on 2 CPU cores, 1 to 2 seeds; 1 run failed | PSNR |" in text


def test_the_readme_says_that_its_chart_was_made_before_a_mend(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(parts, "noted", lambda folder: {parts.GAIN_CHART: "Made before."})
    text = (ROOT / "README.md").read_text()
    assert f"\n\nMade before.\n{parts.GAIN[1]}" in parts.readme(text)


def test_what_is_around_the_tables_is_left_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parts, "stored", lambda name: {})
    monkeypatch.setattr(parts, "demo_sentence", lambda report: "demo")
    monkeypatch.setattr(parts, "with_walk", lambda text, names: text)
    monkeypatch.setattr(parts, "lead", lambda chart: "lead")
    monkeypatch.setattr(parts, "gain_table", lambda chart: "table")
    monkeypatch.setattr(parts, "in_words", lambda found, page: page)
    monkeypatch.setattr(parts, "without_gifts", lambda chart: "alone")
    (before, after), (begin, end) = parts.DEMO, parts.GAIN
    text = f"A\n{before}\nstale\n{after}\nB\n{begin}\n{end}\nC\n"
    parts_of_gain = "lead\n\ntable\n\n- docs/measurements.md\n- alone"
    expected = f"A\n{before}\ndemo\n{after}\nB\n{begin}\n{parts_of_gain}\n{end}\nC\n"
    assert parts.readme(text) == expected
    assert parts.gain() == "table\n\nmeasurements.md"


def test_runs_that_failed_without_gifts_are_counted_apart_from_those_that_ended() -> None:
    def said(*without: float) -> str:
        psnrs = {"whole": (30.0, 29.0), "without": without, "own grid": (26.0, 25.0)}
        runs = [
            run(name, seed, psnr=psnr)
            for name, some in psnrs.items()
            for seed, psnr in enumerate(some)
        ]
        return parts.without_gifts(results(*runs))

    assert "alone at 28.0, 27.0; with its own grid at 26.0, 25.0 ([more]" in said(27.0, 28.0)
    assert "alone at 28.0 (1 of 2 runs failed); with" in said(10.0, 28.0)
    assert "bounds alone 2 of 2 runs failed; with its own grid" in said(10.0, 11.0)
