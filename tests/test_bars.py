"""Claims about the table of bars on the results page, with results that are made up."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import bars
import pytest
from chart_results import occupancy, results, run

ROOT = Path(__file__).resolve().parent.parent


def store(folder: Path, name: str, made: dict[str, Any]) -> None:
    path = folder / f"{name}.json"
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps(made))


def chart(recalls: list[float], **others: Any) -> dict[str, Any]:
    """Three contenders, a seed for each recall; ours passes the others' last 18 dB after 8 s."""
    runs = []
    for seed, recall in enumerate(recalls):
        facts = occupancy(51_000, 0.1) | {"kept_surface_recall": recall}
        facts |= {"free_space_skipped": 0.91, "image_price_db": -0.0001}
        runs.append(run("LeCO + learned occupancy", seed, 20.0, occupancy=facts))
    for name in ("LeCO, never frozen", "LeCO, equal experts, no gate"):
        figures = {"sampler": "dense", "render_seconds_per_image": 4.0, **others}
        runs += [run(name, seed, 18.0, **figures) for seed in range(len(recalls))]
    return results(*runs)


def table(folder: Path) -> list[list[str]]:
    """Cells of the rows: bar, measured, reached, stored in."""
    lines = bars.bars_section(folder)[-1].splitlines()[2:]
    return [line.strip("| \n").split(" | ") for line in lines]


def row(folder: Path, asked: str) -> list[str]:
    """Measured, reached and stored in, of the one bar that begins so."""
    (found,) = (cells for cells in table(folder) if cells[0].startswith(asked))
    return found[1:]


@pytest.mark.parametrize(
    ("recalls", "measured", "reached"),
    [
        ([0.996, 0.995, 0.999], "99.60% (99.50 to 99.90, 3 seeds)", "yes"),
        ([0.996, 0.98, 0.999], "99.60% (98.00 to 99.90, 3 seeds)", "in the median"),
        ([0.999, 0.98, 0.9949], "99.49% (98.00 to 99.90, 3 seeds)", "**no**"),
        ([0.9951], "99.51% (one seed)", "yes"),
    ],
)
def test_a_bar_is_reached_by_every_seed_or_in_the_median_or_not(
    tmp_path: Path, recalls: list[float], measured: str, reached: str
) -> None:
    store(tmp_path, "charts/city-3", chart(recalls))
    found = row(tmp_path, "City: visible surface kept, at least 99.5%")
    assert found == [measured, reached, "`charts/city-3`"]


def test_a_bar_from_above_is_reached_by_less(tmp_path: Path) -> None:
    made = chart([0.9])
    store(tmp_path, "charts/city-3", made)
    for asked, measured in (
        ("City: lost surface mass, at most 0.1%", "0.010% (one seed)"),
        ("City: image price, at most 0.05 dB", "0.000 dB (one seed)"),
        ("City: the gate's file, at most 200 kB", "51.0 kB (one seed)"),
    ):
        assert row(tmp_path, asked)[:2] == [measured, "yes"]
    made["runs"][0]["occupancy"]["lost_surface_mass"] = 2e-3
    store(tmp_path, "charts/city-3", made)
    assert row(tmp_path, "City: lost")[:2] == ["0.200% (one seed)", "**no**"]


def test_rivals_are_compared_by_their_means(tmp_path: Path) -> None:
    store(tmp_path, "charts/caliterra", chart([0.9, 0.9]))
    for asked, measured, reached in (
        ("sooner at", "1.25 x (1.25 to 1.25, 2 seeds)", "**no**"),
        ("PSNR at the end", "ahead: +2.00 ± 0.00 dB, 2 seeds", "yes"),
        ("renders faster", "4.0 x (4.0 to 4.0, 2 seeds)", "yes"),
    ):
        assert row(tmp_path, f"`caliterra`: {asked}")[:2] == [measured, reached]


@pytest.mark.parametrize(
    ("asked", "why"),
    [("visible surface kept", {"freeze_seconds": None}), ("sooner at", {"curve": [[10.0, 1.0]]})],
)
def test_a_seed_that_never_comes_so_far_reaches_no_bar(
    tmp_path: Path, asked: str, why: dict[str, Any]
) -> None:
    made = chart([0.999, 0.999])
    made["runs"][0] |= why
    store(tmp_path, "charts/city-3", made)
    assert row(tmp_path, f"City: {asked}")[:2] == ["never with 1 of 2 seeds", "**no**"]


def test_an_occupancy_has_the_price_of_the_file_that_its_run_leaves(tmp_path: Path) -> None:
    """At freezing another gate skipped less, for less."""
    made = chart([0.999, 0.999, 0.999])
    prices = (0.06, 0.068, 0.0)
    for one, price in zip(made["runs"], prices):
        one["occupancy"] |= {"image_price_db": price, "lost_surface_mass": 2e-3}
        at_first = {"image_price_db": 0.007, "lost_surface_mass": 1e-4, "empty_fraction": 0.6}
        one["at_freezing"] = at_first
    store(tmp_path, "charts/city-3", made)
    for asked, measured, reached in (
        ("image price", "0.060 dB (0.000 to 0.068, 3 seeds)", "**no**"),
        ("lost surface mass", "0.200% (0.200 to 0.200, 3 seeds)", "**no**"),
        ("candidates skipped", "80.0% (80.0 to 80.0, 3 seeds)", "yes"),
    ):
        assert row(tmp_path, f"City: {asked}")[:2] == [measured, reached]


@pytest.mark.parametrize("asked", ["image price", "sooner at", "PSNR at the end", "renders faster"])
def test_a_run_that_failed_reaches_no_bar(tmp_path: Path, asked: str) -> None:
    made = chart([0.999, 0.999])
    failed = {"name": "LeCO + learned occupancy", "seed": 2, "reason": "no memory"}
    made["failures"] = [failed, {**failed, "name": "Instant-NGP + own grid"}]
    store(tmp_path, "charts/city-3", made)
    assert row(tmp_path, f"City: {asked}")[:2] == ["never with 1 of 3 seeds", "**no**"]


def test_what_is_not_stored_says_so_and_reaches_nothing(tmp_path: Path) -> None:
    for asked, measured, *others in table(tmp_path):
        assert measured.startswith(("not stored", "not measured")), asked
        assert others == ["-", "-"]


def test_the_demo_of_an_earlier_release_has_no_minutes(tmp_path: Path) -> None:
    demo = {"runs": [{"freeze_seconds": 40.0, "train_seconds": 130.0}]}
    store(tmp_path, "demo", demo)
    assert row(tmp_path, "Demo: all of it")[0] == "not stored"
    share = row(tmp_path, "Demo: learning's share of training")
    assert share == ["30.8% (one seed)", "**no**", "`demo`"]
    store(tmp_path, "demo", demo | {"seconds_in_all": 366.0})
    assert row(tmp_path, "Demo: all")[:2] == ["6.1 minutes (one seed)", "**no**"]


@pytest.mark.parametrize(
    ("after", "frozen", "measured", "reached"),
    [
        (5, True, "0 of 1 kill lost something; 1 of 1 run ended frozen", "yes"),
        (3, True, "1 of 1 kill lost something; 1 of 1 run ended frozen", "**no**"),
        (5, False, "0 of 1 kill lost something; 0 of 1 run ended frozen", "**no**"),
    ],
)
def test_kills_reach_their_bar_where_nothing_is_lost_and_all_end_alike(
    tmp_path: Path, after: int, frozen: bool, measured: str, reached: str
) -> None:
    kill = {"first": 3, "before": 4, "after": after}
    killed = [{"step": 9, "frozen": frozen, "kills": [kill]}, {"step": 9, "kills": []}]
    store(tmp_path, "kills", {"steps": 10, "killed": killed})
    assert row(tmp_path, "Killed at any step") == [measured, reached, "`kills`"]


def test_a_chart_none_of_whose_gates_was_frozen_misses_the_bars_of_occupancies(
    tmp_path: Path,
) -> None:
    made = chart([0.999, 0.998])
    for one in made["runs"]:
        one["freeze_seconds"] = None
    store(tmp_path, "charts/city-3", made)
    found = row(tmp_path, "City: visible surface kept")
    assert found[:2] == ["never with 2 of 2 seeds", "**no**"]


def test_a_card_reaches_its_bar_when_a_run_on_it_came_to_its_end(tmp_path: Path) -> None:
    store(tmp_path, "gpu-a", {"parts": {"learned": {}}})
    assert row(tmp_path, "On CUDA") == ["no run came to its end", "**no**", "`gpu-a`"]
    store(tmp_path, "gpu-b", {"parts": {"learned": {"psnr": 25.0}}})
    assert row(tmp_path, "On CUDA") == ["25.00 dB", "yes", "`gpu-b`"]


def test_the_page_shows_the_bars_of_what_is_stored_before_the_questions() -> None:
    page = (ROOT / "docs" / "results.md").read_text()
    generated = bars.bars_section(ROOT / "benchmarks" / "results")[-1]
    assert generated in page and page.index(generated) < page.index("## The reviewers")


def test_every_file_that_claims_a_bar_is_there() -> None:
    assert all((ROOT / "tests" / file).exists() for file in bars.CLAIMED.values())


def test_a_bar_of_a_chart_that_was_made_before_a_mend_is_marked(tmp_path: Path) -> None:
    store(tmp_path, "charts/city-3", chart([0.996]))
    (tmp_path / "notes.json").write_text('{"city-3": "Made before."}')
    assert row(tmp_path, "City: visible surface kept")[-1] == "`charts/city-3` (*)"
