"""The table of docs/stability.md, in portions: `python benchmarks/stability.py --minutes 20`.

Each call goes on with the runs that `benchmarks/results/stability.json` lacks, on whatever machine,
and stores what it has made. `python benchmarks/results_page.py` then shows it.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import checkout  # noqa: F401
import tyro

from leco_plugin.evaluation.report import write_json
from leco_plugin.stability.suite import make_table
from leco_plugin.stability.table import headline

ROOT = Path(__file__).resolve().parent.parent
SEEDS = (0, 1, 2)
BESIDE = (0,)
"""Of the samplers that stand beside learned occupancy: where they fail, one seed shows it."""


@dataclass
class Options:
    """Settings of the benchmark."""

    minutes: float | None = None
    """How long this may take; all that is missing where it is left out."""
    results: Path = ROOT / "benchmarks" / "results" / "stability.json"
    """Where results are read and stored."""
    out: Path = ROOT / "runs" / "stability"
    """Folder of the scenes, and of what runs leave besides their figures."""


def main(options: Options) -> None:
    """Makes a portion; runs of other settings than those of now are made again."""
    earlier = json.loads(options.results.read_text()) if options.results.exists() else None
    results = make_table(
        options.out, seeds=SEEDS, seeds_beside=BESIDE, minutes=options.minutes, earlier=earlier
    )
    write_json(options.results, results)
    print(headline(results))


if __name__ == "__main__":
    main(tyro.cli(Options))
