"""Writes `docs/results.md`, `docs/measurements.md`, `docs/suites.md`, the tables of
`docs/stability.md` and `docs/upstream/leco_nerf.md` and the README's table and chart from stored
results, or with `--check` says which of them are of other results. Charts are drawn where their
results have changed; with `--redraw`, all of them.

python benchmarks/results_page.py
"""

from __future__ import annotations

import json
import sys
from typing import Any

import checkout  # noqa: F401
from answers import answers_section
from bars import bars_section
from chart_sections import chart_sections, star, stored, suite_sections, titles
from comparisons import comparison_section, comparisons
from eight_questions import eight_answers, scenes_and_seeds
from growth_picture import cities, growth_table
from hue import hue_section
from large_scene_tables import LARGE_SCENES
from learning import sentence as learning_sentence
from page_parts import (
    RESULTS,
    ROOT,
    heading_anchor,
    machine_line,
    made_line,
    picture,
    section,
    table,
)
from page_pictures import GROWTH, LEARNING, draw_pictures, is_stale, pictures
from profile_page import profile_sections
from promises import kept_promises, promises_section
from readme_parts import (
    GAIN_CHART,
    GIFTS_CHART,
    demo_table,
    gain,
    gifts_sentence,
    readme,
)
from sharpening import kept_by_grids, sharpening_sections
from sizes_sections import scene_results, sizes_sections
from sizes_tables import where_it_pays
from stability_page import PAGE as STABILITY_PAGE
from stability_page import headline, sentence
from stability_page import page as stability_page
from upstream_page import PAGE as UPSTREAM_PAGE
from upstream_page import page as upstream_page
from walk import with_walk

PAGE = ROOT / "docs" / "results.md"
MEASUREMENTS_PAGE = ROOT / "docs" / "measurements.md"
SUITES_PAGE = ROOT / "docs" / "suites.md"
README = ROOT / "README.md"

WALKED = {
    ROOT / "docs" / "tutorial.md": ("poses", "train", "export"),
    ROOT / "docs" / "large-scenes.md": ("learned",),
}
"""Pages that quote what a walk printed, and its parts."""

HEAD = """# Results

What was found, in one page. Behind it are [Measurements](measurements.md), every chart and table
with [how to read them](measurements.md#how-to-read-a-table), [Suites](suites.md), the charts of the
reviewers' questions, and [Who gets what](gifts.md) in a comparison. All is made from
`benchmarks/results/*.json` by `python benchmarks/results_page.py`; a test fails when they differ.
Those pages say of which commit each figure is. Where (*) stands, a later change of the code is
known to matter; the page of its figures says which. Figures from before 30 November 2026 are of up
to four scene experts, where today's code has one: [level or better where both were
measured](decisions.md#scene-experts-exchange-their-points-while-they-learn). Learning rates are now
[full for three quarters of a run](decisions.md#rates-stay-full-then-fall-to-zero),
which gains 0.15 to 0.84 dB where an occupancy is learned; charts say by which rule theirs fell.

## What is gained in the same time
"""
GAIN_NOTE = """The picture shows the same runs over time ([figures](measurements.md#{anchor})):
learning what is empty takes part of the time, and wins it back. On a CPU hosts are smaller than
nerfstudio's: a hash table of 2^16 entries, a grid of 64³, 128 + 64 proposal samples and 32 of the
field.

{gifts}

The demo's city is known exactly, which photographs never are:
"""
QUESTIONS = """## The reviewers' questions, answered

The first six are of {scenes_and_seeds}. [Suites](suites.md#the-answers-with-their-figures) has them
scene by scene. In question 5 the host is Switch-NeRF, in the others it is the paper's model.
"""
MORE = """## Further

- **Is a grid enough?**{star} {capacity} [Gates and grids at equal
  loss](measurements.md#how-much-a-scene-needs-gates-and-grids-at-equal-loss). {grids}
  ([figures](measurements.md#sharpened-occupancies)).
- **Is what is promised of new views kept?** {promises}, where one in ten may
  ([figures](measurements.md#what-new-views-lose-and-what-is-promised)).
- **Does it fail, and when?** {stability} The learned runs have 200 steps
  more, 2.1 times the rays, sparse points, and begin opaque; proposal networks fail by samples
  beside the surface, hardly by PSNR. [Stability](stability.md) shows each case.
- **Where does the time of a step go?** [A profile](measurements.md#where-the-time-of-a-step-goes).
- **On a GPU?** Nobody has measured it; [Use a GPU](gpu.md) says how to.
"""
MEASUREMENTS_HEAD = """# Measurements

Generated as [Results](results.md) is, which says in one page what was found. Times are seconds of
training, evaluation left out. Nothing here is from the paper but what is called so.

To make a chart again, add `--out FOLDER` to its command. Its scenes:

- `city`: `leco city --aerial-only --out city`, as `leco demo` leaves in `runs/demo/city`.
- `city-4`: `leco city --blocks 4 --aerial-only --out city-4`.
- `caliterra`: 75 drone photographs of a building site (CC0). `git clone
  https://github.com/OpenDroneMap/odm_data_caliterra`, then `leco poses odm_data_caliterra/images
  --out caliterra`. Ours had its poses from COLMAP at 1600 pixels, and photographs of 480 x 360 with
  every eighth for tests: figures will be near ours, not the same.
- `fox`: the 50 photographs of that name that come with NVIDIA's instant-ngp.

*Never frozen* is the same model, whose gate goes on learning: it renders without skipping. *Equal
experts, no gate* has four scene experts, none for empty space, as Switch-NeRF, and never skips.

## How to read a table

- **PSNR** is of 8,192 pixels spread over all test images, all together, less those that a mask or
  a fisheye's rim hides; **mean PSNR of images** is the mean of each image's own on the same pixels,
  as `ns-eval` averages. SSIM, FLIP, LPIPS and the seconds to render are of one whole test image or
  two, where what is hidden counts as right. FLIP and LPIPS are better when they are less. Qualities
  are means over seeds, with the least and the most; costs, ratios, and figures of occupancies are
  medians.
- **Ahead**, **level**, **undecided**, **behind**: by the difference of means and its 95% interval
  over seeds (Welch's t). Level is where the interval holds zero and nothing beyond 0.5 dB to a side
  of the difference (of other figures, a quarter of their mean); where it holds zero and more, the
  seeds decide nothing. With one seed there is no verdict. Each comparison stands alone: of twenty
  between equals, one is expected to differ.
- **Fell**: a run ended more than 0.3 dB below the best point of its own curve.
- **s to X dB**: after how many seconds of training each method reached what every run reached at
  last, to stay above it. **≤** stands where that is the first evaluation: it may have been before.
  **Trained**: seconds until the last step had ended, which may be more
  than was given.
- **Bold**: on the front of its column, so that nothing has more PSNR for less of it. **-**: not
  measured. Figures of quality that no run of a chart has are named below its table.
- A *candidate* is a place on a ray at which a model that skips nothing would ask its network.
  **Candidates skipped**, **price** and **lost surface mass** are of held-out pixels at the moment
  of freezing, over the seeds in which a gate was frozen. **At the end** they are of the gate that
  the run leaves, often a smaller one; so are **parameters** and **kB**. **Healed** counts
  recoveries from collapse. **Volume kept at 1e-3** is of what rays reach of the scene, with the
  threshold that loses one thousandth of the surface: so gates and grids are compared at the same
  price.
- **True surface kept** and **free space skipped** compare with the exact city.

How much sooner one method is than another depends on the machine: learning takes a number of steps,
and on cores half as fast twice the share of the same time
([figures](decisions.md#at-equal-time-on-half-the-speed-learning-takes-its-share-first)).
"""
SUITES_HEAD = """# Suites

Generated as [Results](results.md) is. [Measurements](measurements.md) says which scenes these are,
and [how to read a table](measurements.md#how-to-read-a-table).
"""


def sampling_table(report: dict[str, Any]) -> str:
    """The bars of the sampling benchmark, reached or not."""
    return "\n".join(table("figure | measured | bar | reached", map(_bar, report["figures"])))


def _bar(figure: dict[str, Any]) -> list[str]:
    """A figure, its value, its bar, and whether it is reached."""
    bar = f"{'<=' if figure['at_most'] else '>='} {figure['bar']:g}"
    reached = "yes" if figure["reached"] else "**no**"
    return [figure["name"], f"{figure['value']:.3g}", bar, reached]


def sampling_section(report: dict[str, Any]) -> list[str]:
    """The sampling benchmark on one machine; first results say neither their day nor their code."""
    title, note = f"Sampling: {report['machine']['processor']}", " Ratios within one run."
    if "code" in report:
        title, note = f"{title}, {report['date']}", f"{note} {code_of(report)}."
    command = "python benchmarks/sampling.py"
    return section(title, command, report, sampling_table(report), note)


def code_of(report: dict[str, Any]) -> str:
    """Version and commit of the code that was measured."""
    version, commit = report["code"]["version"], report["code"]["commit"] or "no commit"
    return f"leco_plugin {version} at {commit}"


def gpu_table(results: dict[str, Any]) -> str:
    """The bars of the GPU suite, with the milliseconds behind them, floors among them."""
    cells = []
    for figure in (f for part in results["parts"].values() for f in part.get("figures", [])):
        times = ", ".join(f"{name} {time:.3g}" for name, time in figure["milliseconds"].items())
        cells.append([*_bar(figure), times])
    rows = table("figure | measured | bar | reached | milliseconds", cells)
    for name, part in results["parts"].items():
        if missing := [kernel for kernel, runs in part.get("running", {}).items() if not runs]:
            rows += ["", f"Part {name}: torch answered in place of the fused {'; '.join(missing)}."]
        if reason := part.get("left_out"):
            rows += ["", f"Part {name} was left out: {reason}"]
    return "\n".join(rows + trained_lines(results["parts"]))


def trained_lines(parts: dict[str, Any]) -> list[str]:
    """Steps, memory and PSNR of the guided run of the GPU suite and of the dense one beside it."""
    learned, dense = parts.get("learned", {}), parts.get("dense", {})
    if "psnr" not in learned or "psnr" not in dense:
        return []
    rows = []
    seconds, steps = learned["seconds"], learned["steps"]
    after = steps["all"] - steps["learning"]
    for name, took, count, step, psnr in (
        ("learning", seconds["learning"], steps["learning"], learned["learning_step"], "-"),
        ("guided", seconds["guided"], after, learned["guided_step"], f"{learned['psnr']:.2f}"),
        ("dense", dense["seconds"], dense["steps"], dense["step"], f"{dense['psnr']:.2f}"),
    ):
        costs = f"{1e3 * step['seconds']:.1f}", f"{step['peak_bytes'] / 2**30:.2f}"
        rows.append([name, f"{took:.0f}", str(count), *costs, psnr])
    return ["", *table("run | seconds | steps | ms a step | peak memory, GiB | PSNR, dB", rows)]


def check_gpu(results: dict[str, Any]) -> None:
    """Refuses figures that no card has given.

    Raises:
        ValueError: of a dry run, or without a card and its driver.
    """
    machine = results["machine"]
    if results["dry"] or machine["device"] == "cpu" or machine["driver"] is None:
        raise ValueError(f"results of a GPU that nobody ran on are not shown: {machine}")


def large_scene_sections() -> list[str]:
    """Of growth, bounds and photographs, those that are stored."""
    parts = growth_section()
    for name, shown in LARGE_SCENES.items():
        if not (path := RESULTS / f"{name}.json").exists():
            continue
        report = json.loads(path.read_text())
        made = f" Rows {made_line(report['rows' if 'rows' in report else 'runs'])}."
        command, note = shown.command(report), shown.note(report) + made
        head, *rest = section(shown.title, command, report, shown.table(report), note)
        parts += [head, *rest]
    return parts


def growth_section() -> list[str]:
    """How gates and grids grow with a city; nothing before two cities are measured."""
    measured = scene_results("capacity")
    grown = [measured[one.name] for one in cities(measured)]
    if len(grown) < 2:
        return []
    steps = grown[0]["learn_steps"]
    command = (
        "leco city --blocks K --aerial-only --out city-K; leco capacity --data city-K --out DIR "
        f"--learn-steps {steps}"
    )
    note = (
        f" Each representation loses {grown[0]['lost_surface_mass']:.1%} of the weight near "
        "surfaces along held-out rays; kept is a share of the volume that training "
        f"rays reach. One field teaches all of a city, learned in {steps} steps. Gate and grid are "
        "chosen by one rule: ten times the bytes, of a grid as an octree, must leave two thirds of "
        "the volume."
    )
    title = "How occupancy grows with a city"
    head, *rest = section(title, command, grown[0], growth_table(measured), note)
    return [head, f"{picture(GROWTH.stem)}\n", *rest]


def page() -> str:
    """The whole of `docs/results.md`."""
    demo = json.loads((RESULTS / "demo.json").read_text())
    anchor = heading_anchor(titles()[GAIN_CHART])
    gifts = gifts_sentence(stored(GIFTS_CHART), heading_anchor(titles()[GIFTS_CHART]))
    note = GAIN_NOTE.format(anchor=anchor, gifts=gifts)
    parts = [HEAD, f"{gain()}\n", f"{picture(GAIN_CHART)}\n", note]
    parts += [
        f"{demo_table(demo)}\n",
        *bars_section(RESULTS),
        QUESTIONS.format(scenes_and_seeds=scenes_and_seeds()),
        *eight_answers(scene_results("capacity")),
        "",
    ]
    stability = json.loads((RESULTS / "stability.json").read_text())
    found = {
        "star": star("capacity"),
        "capacity": where_it_pays(scene_results("capacity")),
        "grids": kept_by_grids(json.loads((RESULTS / "sharpening.json").read_text())),
        "promises": kept_promises(json.loads((RESULTS / "promises.json").read_text())),
        "stability": sentence(headline(stability)),
    }
    return "\n".join([*parts, MORE.format(**found)])


def measurements_page() -> str:
    """The whole of `docs/measurements.md`."""
    parts = [MEASUREMENTS_HEAD, *comparison_section(comparisons((GAIN_CHART, GIFTS_CHART)))]
    parts += chart_sections()
    demo = json.loads((RESULTS / "demo.json").read_text())
    made = demo["made"]
    note = f" {made['date']}, leco_plugin {made['version']} at {made['commit']}."
    title = "The demo: procedural city, one seed"
    parts += section(title, made["command"], demo, demo_table(demo), note)
    if (learning := RESULTS / "learning.json").exists():
        parts += learning_section(json.loads(learning.read_text()))
    if (sharpened := RESULTS / "sharpening.json").exists():
        parts += sharpening_sections(json.loads(sharpened.read_text()))
    if (hues := RESULTS / "hue.json").exists():
        parts += hue_section(json.loads(hues.read_text()))
    parts += promises_section(json.loads((RESULTS / "promises.json").read_text()))
    if (profiled := RESULTS / "profile.json").exists():
        parts += profile_sections(json.loads(profiled.read_text()))
    parts += sizes_sections()
    parts += large_scene_sections()
    for sampling in sorted(RESULTS.glob("sampling*.json")):
        parts += sampling_section(json.loads(sampling.read_text()))
    for path in sorted(RESULTS.glob("gpu-*.json")):
        report = json.loads(path.read_text())
        check_gpu(report)
        title = f"On a GPU: {report['machine']['device']}, {report['date']}"
        note = f" {code_of(report)}, sources {report['code']['sources']}."
        parts += section(title, "python benchmarks/gpu.py", report, gpu_table(report), note)
    return "\n".join(parts)


def suites_page() -> str:
    """The whole of `docs/suites.md`."""
    return "\n".join([SUITES_HEAD, *answers_section(), *suite_sections()])


def learning_section(report: dict[str, Any]) -> list[str]:
    """What each expert gets while an occupancy is learned, and how its slices change."""
    recorded = "--pipeline.model.schedule.steps-per-record 8"
    return [
        "## While an occupancy is learned\n",
        f"{picture(LEARNING.stem)}\n",
        f"{learning_sentence(report)}. Both are of the later half of learning. Points are spread "
        "over the scene's box; a mean density is of those that an expert gets, per half extent. "
        "Which of four scene experts takes what changes to the end; what is empty does not.\n",
        "![Slices of the occupancy from above and from the side, step by step]"
        "(images/learning.gif)\n",
        f"`ns-train leco-occupancy --data {report['scene']} {recorded}` and `python "
        f"benchmarks/learning.py outputs/{report['scene']}/leco-occupancy`, {report['date']}; "
        f"{machine_line(report)}. The slices: `leco inspect outputs/{report['scene']}/"
        "leco-occupancy --history learned.gif`, of the same kind of run.\n",
    ]


def main() -> int:
    """Writes all, or with --check says whether they are as they should be."""
    wanted = {PAGE: page(), SUITES_PAGE: suites_page(), README: readme(README.read_text())}
    wanted[MEASUREMENTS_PAGE] = measurements_page()
    wanted[STABILITY_PAGE] = stability_page(STABILITY_PAGE.read_text(), RESULTS)
    wanted[UPSTREAM_PAGE] = upstream_page(UPSTREAM_PAGE.read_text())
    for page_of_walk, names in WALKED.items():
        wanted[page_of_walk] = with_walk(page_of_walk.read_text(), names)
    if "--check" in sys.argv[1:]:
        stale = [path.name for path, text in wanted.items() if path.read_text() != text]
        stale += [path.name for path, results in pictures().items() if is_stale(path, results)]
        if stale:
            print(f"{', '.join(stale)}: run python benchmarks/results_page.py", file=sys.stderr)
        return 1 if stale else 0
    for path, text in wanted.items():
        path.write_text(text)
    draw_pictures("--redraw" in sys.argv[1:])
    return 0


if __name__ == "__main__":
    sys.exit(main())
