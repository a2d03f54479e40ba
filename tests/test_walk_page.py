"""What pages quote of the walk from photographs to a film."""

from __future__ import annotations

import json
import re
from pathlib import Path

import walk

DOCS = Path(__file__).resolve().parent.parent / "docs"

LOG = """/somewhere/script.py:1: FutureWarning: old
  warnings.warn(
[15:33:03] Using --data alias                                          train.py:230
SCENE: 148 photographs to learn from
  rays from 0.2 to 0.8
Training: 2% after 10 s
Training: 27% after 2 min
step 199: it learns on
Training: 90% after 7 min
finished: 4000 steps

next:
  ns-viewer
real 507
"""


def test_a_page_quotes_what_is_ours_and_one_line_on_progress() -> None:
    assert walk.lines_of(LOG) == [
        "SCENE: 148 photographs to learn from",
        "  rays from 0.2 to 0.8",
        "Training: 27% after 2 min",
        "step 199: it learns on",
        "finished: 4000 steps",
    ]
    assert walk.REAL.findall(LOG) == ["507"]


def test_the_readme_says_what_skipping_costs_and_what_another_run_lost() -> None:
    lines = {"poses": ["2 of 3 are placed"], "train": ["a gate of 7 values", "finished: 9 steps"]}
    report = {
        "lines": lines,
        "seconds": {"poses": 60, "train": 100, "film": 20, "eval": 900},
        "costs": {
            "empty_fraction": 0.77,
            "lost_surface_mass": 7.8e-4,
            "worst_surface_mass": 0.0128,
        },
        "other_runs": [{"worst_surface_mass": 0.021}],
    }
    said = walk.quote(report)
    assert said.startswith("```\n2 of 3 are placed\nfinished: 9 steps\n```\n\n")
    assert "took 3 minutes" in said and "77% of all places" in said and "hide 0.08%" in said
    assert said.endswith(
        "Of photographs that taught them nothing, the worst lost 1.28% (2.10% in another run)."
    )
    lines["train"].append("8 photographs that taught it nothing lose at most 1.28% of theirs")
    assert " pixels. Of 8 photographs that taught them nothing, the worst" in walk.quote(report)


def test_what_pages_say_of_the_walk_is_of_the_stored_one() -> None:
    stored = json.loads(walk.WALK.read_text())
    tutorial, large = ((DOCS / f"{name}.md").read_text() for name in ("tutorial", "large-scenes"))
    for row, name in (("poses", "poses"), ("training", "train"), ("film", "film")):
        (minutes,) = re.findall(rf"^\| {row}\b[^|]*\| (\d+) minutes", tutorial, re.MULTILINE)
        assert abs(60.0 * int(minutes) - stored["seconds"][name]) < 60.0, row
    reached = "PSNR of {psnr:.1f} dB and an SSIM of {ssim:.2f}".format(**stored["eval"])
    assert reached in " ".join(tutorial.split())
    assert f"took {stored['seconds']['poses'] / 60.0:.1f} minutes" in large
    stays = any("and the gate stays" in line for line in stored["lines"]["train"])
    assert ("which therefore stays" in tutorial) == stays
