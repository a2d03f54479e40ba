"""The bars of the main job, set before it was built, beside what stored results say of them."""

from __future__ import annotations

import json
import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import checkout  # noqa: F401
from page_parts import noted
from stability_page import has_lost, runs_gone_on

from leco_plugin.chart.learned import Learned
from leco_plugin.chart.methods import NEVER_FROZEN, VARIANTS
from leco_plugin.chart.summary import Line, Verdict, figure_in, lines_of, versus
from leco_plugin.chart.table import rows
from leco_plugin.log import counted

EQUAL_EXPERTS = VARIANTS["leco-occupancy-homogeneous"]
CITY, SURVEY, SURVEY_NAME = "charts/city-3", "charts/caliterra", "`caliterra`"

Results = dict[str, Any]
Values = Sequence[float | None]
"""One for each seed; None where that seed never came so far."""

HEAD = """On two CPU cores. *City* is the procedural city of 3 x 3 blocks, as `city` is below. Each
figure is read from the stored result named beside it: the median over seeds, with the least and the
most. Figures of an occupancy are of the gate with which a run ends, as its file declares them.
*Yes*: every seed reaches the bar. *In the median*: the median does, some seeds do not. A run that
failed reaches no bar. PSNR beside a rival is a difference of means with its 95% interval: ahead,
behind, level where that holds zero, or undecided where it holds zero and half of it is more than
0.5 dB. A *candidate* is a place on a ray at which a model that skips nothing would ask its network.
The *price* is what skipping costs held-out pixels, *lost surface mass* what it leaves out of the
weight near surfaces."""


@dataclass(frozen=True)
class Bar:
    """A figure that was asked for."""

    asked: str
    bound: float
    at_most: bool
    unit: str
    form: str
    """Of a value, as `format` takes it."""
    stored: str
    """File of the results that hold it, in their folder."""
    read: Callable[[Results], Values | Verdict | None]
    """Its values in those results, or a verdict on a rival; None where they do not say."""

    def cells(self, folder: Path) -> list[str]:
        """Its row: bar, measured, reached, stored in."""
        asked = f"{self.asked}, at {'most' if self.at_most else 'least'} {self.bound:g}{self.unit}"
        path = folder / f"{self.stored}.json"
        values = self.read(json.loads(path.read_text())) if path.exists() else None
        if not values:
            return [asked, "not stored", "-", "-"]
        mark = " (*)" if Path(self.stored).name in noted(folder) else ""
        if isinstance(values, Verdict):
            reached = {"ahead": "yes", "behind": "**no**", None: "no verdict"}
            found = [values.said(), reached.get(values.word, str(values.word))]
        else:
            found = [self.measured(values), self.reached(values)]
        return [asked, *found, f"`{self.stored}`{mark}"]

    def measured(self, values: Values) -> str:
        """The values of some seeds, in words."""
        known = [value for value in values if value is not None]
        if len(known) < len(values):
            return f"never with {len(values) - len(known)} of {len(values)} seeds"
        middle, least, most = map(self.said, (statistics.median(known), min(known), max(known)))
        spread = "one seed" if len(known) == 1 else f"{least} to {most}, {len(known)} seeds"
        return f"{middle}{self.unit} ({spread})"

    def said(self, value: float) -> str:
        """A value in its form; what rounds to nothing has no sign."""
        text = format(value, self.form)
        return text if float(text) else text.lstrip("+-")

    def reached(self, values: Values) -> str:
        """Whether they reach the bar."""
        known = [value for value in values if value is not None]
        if len(known) < len(values) or not self.holds(statistics.median(known)):
            return "**no**"
        return "yes" if all(map(self.holds, known)) else "in the median"

    def holds(self, value: float) -> bool:
        """Whether one value does."""
        return value <= self.bound if self.at_most else value >= self.bound


def of_occupancy(key: str, scale: float = 1.0) -> Callable[[Results], Values]:
    """Reads a figure of the learned occupancy of a chart, of the gate with which each run ends."""

    def read(results: Results) -> Values:
        (learned,) = (Learned(**vars(line)) for line in lines_of(results) if line.learned)
        found = [figure_in(facts["at_end"], key) for facts in learned.facts]
        never = [None] * (learned.seeds - len(found) + failed_runs(results, learned))
        return [None if value is None else scale * value for value in found] + never

    return read


def against(rival: str, what: str) -> Callable[[Results], Values | Verdict]:
    """Reads what the learned occupancy of a chart gains over a rival, as `Versus` has it."""

    def read(results: Results) -> Values | Verdict:
        lines = lines_of(results)
        (ours,) = (line for line in lines if line.learned)
        (theirs,) = (line for line in lines if line.runs[0]["name"] == rival)
        values: Values | Verdict = getattr(
            versus(ours, theirs, results["protocol"]["seconds"]), what
        )
        if not (failed := failed_runs(results, ours)):
            return values
        if isinstance(values, Verdict):
            values = [psnr - theirs.psnr for psnr in ours.psnrs]
        return [*values, *[None] * failed]

    return read


def failed_runs(results: Results, line: Line) -> int:
    """How many runs of a contender ended without a result."""
    return sum(one["name"] == line.runs[0]["name"] for one in results["failures"])


def learning_share(report: Results) -> Values:
    """Share of the demo's training, in percent, until its gate was frozen."""
    run = report["runs"][0]
    return [100.0 * run["freeze_seconds"] / run["train_seconds"]]


def demo_minutes(report: Results) -> Values | None:
    """Minutes of the whole demo; earlier releases did not store them."""
    seconds = report.get("seconds_in_all")
    return None if seconds is None else [seconds / 60.0]


def prices(scene: str, stored: str) -> list[Bar]:
    """What skipping may cost, in any scene."""
    lost, price = of_occupancy("lost_surface_mass", 100.0), of_occupancy("image_price_db")
    return [
        Bar(f"{scene}: lost surface mass", 0.1, True, "%", ".3f", stored, lost),
        Bar(f"{scene}: image price", 0.05, True, " dB", ".3f", stored, price),
    ]


def at_equal_time(scene: str, stored: str) -> list[Bar]:
    """What is gained in the same time as the rivals have."""
    experts, same = EQUAL_EXPERTS.name, NEVER_FROZEN.name
    return [
        Bar(
            f"{scene}: sooner at the last PSNR of equal experts without a gate",
            *(2.5, False, " x", ".2f", stored, against(experts, "sooner")),
        ),
        Bar(
            f"{scene}: PSNR at the end, beyond that of never frozen",
            *(0.0, False, " dB", "+.2f", stored, against(same, "psnr")),
        ),
        Bar(
            f"{scene}: renders faster than never frozen",
            *(2.0, False, " x", ".1f", stored, against(same, "faster")),
        ),
    ]


RECALL = of_occupancy("kept_surface_recall", 100.0)
FREE = of_occupancy("free_space_skipped", 100.0)
SKIPPED = of_occupancy("empty_fraction", 100.0)
KILOBYTES = of_occupancy("bytes", 1e-3)

BARS = [
    Bar("City: visible surface kept", 99.5, False, "%", ".2f", CITY, RECALL),
    *prices("City", CITY),
    Bar("City: free space skipped", 90.0, False, "%", ".1f", CITY, FREE),
    Bar("City: candidates skipped", 75.0, False, "%", ".1f", CITY, SKIPPED),
    *prices(SURVEY_NAME, SURVEY),
    Bar(f"{SURVEY_NAME}: candidates skipped", 60.0, False, "%", ".1f", SURVEY, SKIPPED),
    Bar("City: the gate's file", 200.0, True, " kB", ".1f", CITY, KILOBYTES),
    Bar(f"{SURVEY_NAME}: the gate's file", 200.0, True, " kB", ".1f", SURVEY, KILOBYTES),
    Bar("Demo: learning's share of training", 25.0, True, "%", ".1f", "demo", learning_share),
    Bar("Demo: all of it", 6.0, True, " minutes", ".1f", "demo", demo_minutes),
    *at_equal_time("City", CITY),
    *at_equal_time(SURVEY_NAME, SURVEY),
]
CLAIMED = {
    "Dispatch to 8 experts, at least 3 x as fast as its dense twin": "models/test_hmoe.py",
    "`brighton_beach`, `caliterra`, `banana`, `fox`: no flag of the scene": "test_real_scenes.py",
    "Train, resume, evaluate, render, export, view": "test_round_trip.py",
}
"""What files of tests claim, and no result says."""


def of_kills(folder: Path) -> list[str]:
    """The row of runs that are killed and resumed."""
    asked = "Killed at any step and resumed, ends in the same phase with nothing lost"
    path = folder / "kills.json"
    if not path.exists():
        return [asked, "not stored", "-", "-"]
    results = json.loads(path.read_text())
    lost = [has_lost(kill) for run in results["killed"] for kill in run["kills"]]
    gone_on, killed = runs_gone_on(results)
    kills, runs = counted(len(lost), "kill"), counted(killed, "run")
    said = f"{sum(lost)} of {kills} lost something; {gone_on} of {runs} ended frozen"
    old = noted(folder).get("kills")
    said += f". {old.rstrip('.')}" if old else ""
    reached = "yes" if not any(lost) and gone_on == killed else "**no**"
    return [asked, said, reached, "`kills` (*)" if old else "`kills`"]


def of_cards(folder: Path) -> list[str]:
    """The row of CUDA: whether a run on a card is stored that came to its end."""
    asked, found = "On CUDA without a flag", sorted(folder.glob("gpu-*.json"))
    if not found:
        return [asked, "not measured", "-", "-"]
    learned = {path: json.loads(path.read_text())["parts"].get("learned", {}) for path in found}
    ended = [path for path, part in learned.items() if "psnr" in part]
    said = (
        ", ".join(f"{learned[path]['psnr']:.2f} dB" for path in ended) or "no run came to its end"
    )
    stored = ", ".join(f"`{path.stem}`" for path in ended or found)
    return [asked, said, "yes" if ended else "**no**", stored]


def bars_section(folder: Path) -> list[str]:
    """The section of the page.

    Args:
        folder: of stored results.
    """
    tests = [
        [asked, f"not stored; tested by `tests/{file}`", "-", "-"]
        for asked, file in CLAIMED.items()
    ]
    cells = [*(bar.cells(folder) for bar in BARS), of_kills(folder), *tests, of_cards(folder)]
    table = rows(["bar", "measured", "reached", "stored in"], cells)
    return ["## Targets of `leco-occupancy`, set before it was built\n", f"{HEAD}\n", f"{table}\n"]
