"""What the README and the first section of results say of stored charts, made up ones mostly."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import chart_sections as sections
import pytest
import readme_parts as parts
from chart_results import results, run

ROOT = Path(__file__).resolve().parents[1]


def test_the_gain_is_that_over_each_other_row_of_the_same_host() -> None:
    def of(method: str, sampler: str, psnr: float, queries: tuple[float, float, float]) -> Any:
        names = ("field", "proposal", "gate")
        asked = {f"{one}_queries_per_ray": many for one, many in zip(names, queries)}
        render = {"render_seconds_per_image": 0.1 * sum(queries)}
        name = f"{method} + {sampler}"
        return run(name, psnr=psnr, method=method, sampler=sampler, **asked, **render)

    runs = [
        of("leco-occupancy", "learned-occupancy", 28.0, (15.0, 0.0, 5.0)),
        of("leco-occupancy", "dense", 29.0, (40.0, 0.0, 0.0)),
        of("leco-ngp", "own", 24.0, (50.0, 0.0, 0.0)),
        of("leco-nerfacto", "own", 25.0, (32.0, 48.0, 0.0)),
    ]
    chart = {
        "runs": runs,
        "protocol": {"seconds": 120.0, "at_once": 2},
        "scene": {"name": "fox"},
        "machine": {"cores": 4, "threads": 2, "device": "cpu"},
    }
    head, _, ours, *_, words = parts.gain_table(chart).splitlines()
    assert head == (
        "| `fox`, 120 s on 2 CPU cores, one seed | PSNR | to render an image | queries a ray |"
    )
    assert ours == (
        "| **leco-occupancy + learned-occupancy** | 28.0 dB (28.0 to 28.0) | 2.0 s | 15 + 5 small |"
    )
    told = "**In the same time,** with a learned occupancy, "
    alone = (
        "leco-occupancy is beside *dense* at -1.0 dB, one seed: no verdict (renders 2.0 times as "
        "fast)."
    )
    assert parts.in_the_same_time(chart) == f"{told}{alone}"
    assert words.startswith("A query asks a network about one point;")
    guided = [
        of("leco-nerfacto", "learned-occupancy", 30.0 + 0.1 * seed, (32.0, 0.0, 8.0))
        | {"seed": seed}
        for seed in range(3)
    ]
    own = [
        of("leco-nerfacto", sampler, psnr + 0.1 * seed, (32.0, 48.0, 0.0)) | {"seed": seed}
        for sampler, psnr in (("own", 25.0), ("long-steps", 30.1), ("dense", 31.0))
        for seed in range(3)
    ]
    assert parts.in_the_same_time(chart | {"runs": [*runs[:3], *guided, *own]}) == (
        f"{told}leco-nerfacto is behind *dense* by 1.0 ± "
        "0.2 dB (renders 2.0 times as fast) and level with *long-steps* at -0.1 ± 0.2 dB (renders "
        "2.0 times as fast) and ahead of *own* by 5.0 ± 0.2 dB (renders 2.0 times as fast). "
        f"{alone}"
    )


SIZES = {"learned": 53_000, "16³": 330_000, "32³": 340_000}


@pytest.mark.parametrize(("rivals", "clear"), [((20.0, 22.0), True), ((20.0, 24.5), False)])
def test_more_time_is_told_scene_by_scene(
    rivals: tuple[float, float], clear: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    runs = [
        run(name, seed, psnr=psnr, sampler=sampler)
        for name, sampler, psnrs in (
            ("Instant-NGP + own", "own", rivals),
            ("Instant-NGP + taught grid 16³", "learned-occupancy-grid", (25.0, 26.0)),
            ("Instant-NGP + taught grid 32³", "learned-occupancy-grid", (25.0, 26.4)),
            ("Instant-NGP + learned", "learned-occupancy", (24.0, 25.0)),
        )
        for seed, psnr in enumerate(psnrs)
    ]
    for one in runs:
        if one["sampler"] != "own":
            one["occupancy"] = {"bytes": SIZES[one["name"].split()[-1]]}
    monkeypatch.setattr(parts, "titles", lambda: {"a": "No", "city-ngp-300": "Some chart"})
    monkeypatch.setattr(parts, "stored", lambda name: results(*runs))
    text = parts.after_five_minutes()
    begin, row = text.split(":\n\n")
    assert begin == "**After 300 s** (2 seeds) Instant-NGP with a learned occupancy has"
    assert row.startswith("- On `city` 24.5 dB ([figures](measurements.md#some-chart)), undecided")
    others, grids = row.split(". Undecided against *taught grid 32³*")
    assert "*own*" in others and others.endswith("; each seed is ahead of each of theirs") == clear
    assert " and undecided against *taught grid 16³*" in grids
    assert parts.in_five_minutes() == (
        "**After 300 s** (2 seeds) Instant-NGP has 24.5 dB on `city`, undecided against *own* "
        f"({sum(rivals) / 2:.1f}). A grid that learns as the gate does ends at 25.7 with the best "
        "size that was tried (the gate is undecided against it), at 25.5 with the worst; its file "
        "takes 0.33 to 0.34 MB, the gate's 0.053. "
    )
    monkeypatch.setattr(parts, "titles", lambda: {"a": "No"})
    assert parts.after_five_minutes() == parts.in_five_minutes() == ""


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
    monkeypatch.setattr(parts, "in_the_same_time", lambda chart, most=None: "gain")
    monkeypatch.setattr(parts, "on_a_city", lambda: "city")
    monkeypatch.setattr(parts, "in_five_minutes", lambda: "")
    monkeypatch.setattr(parts, "without_gifts", lambda chart: "alone")
    monkeypatch.setattr(parts, "after_half_an_hour", lambda: "late")
    monkeypatch.setattr(parts, "of_the_papers_host", lambda: "")
    (before, after), (begin, end) = parts.DEMO, parts.GAIN
    text = f"A\n{before}\nstale\n{after}\nB\n{begin}\n{end}\nC\n"
    parts_of_gain = "lead\n\ntable\n\n- gain city\n- alone\n- late"
    expected = f"A\n{before}\ndemo\n{after}\nB\n{begin}\n{parts_of_gain}\n{end}\nC\n"
    assert parts.readme(text) == expected


@pytest.mark.parametrize("noted", [False, True])
def test_half_an_hour_says_its_verdict_and_whether_the_code_has_changed_since(
    monkeypatch: pytest.MonkeyPatch, noted: bool
) -> None:
    rows = {"LeCO + learned-occupancy": 25.0, "LeCO, equal experts": 22.0}

    def chart(*seeds: int) -> dict[str, Any]:
        return results(
            *(
                run(name, seed, psnr=psnr + 0.1 * seed, sampler=name.split(" + ")[-1])
                for name, psnr in rows.items()
                for seed in seeds
            )
        )

    first, second = parts.HALF_HOUR_CHARTS.values()
    charts = {first: chart(0), second: chart(0, 1, 2)}
    monkeypatch.setattr(parts, "stored", charts.__getitem__)
    monkeypatch.setattr(parts, "titles", lambda: dict.fromkeys(charts, "Title"))
    monkeypatch.setattr(sections, "notes", lambda: {second: "Made before."} if noted else {})
    short, whole = parts.after_half_an_hour(), parts.half_an_hour()
    later = ", made before a later change of the code" if noted else ""
    assert short.endswith(f"on a city 25.1 and 22.1 (one seed and 3 seeds each{later}).")
    one, three = whole.split("on a city ")
    assert "(*)" not in one
    assert "(+3.00 dB, one seed: no verdict); after 7 s the first had as much ([figures]" in one
    assert "(ahead: +3.00 ± 0.23 dB, 3 seeds);" in three and noted == (") (*)." in three)


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
