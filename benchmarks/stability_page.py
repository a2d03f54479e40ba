"""What docs/stability.md shows: the stored table, the cases, and runs that were killed."""

from __future__ import annotations

import json
import math
import statistics
from pathlib import Path
from typing import Any

import checkout  # noqa: F401
from page_parts import ROOT, between, table

from leco_plugin.stability.cases import CASES
from leco_plugin.stability.table import failures, headline, verdicts

PAGE = ROOT / "docs" / "stability.md"
PICTURE = ROOT / "docs" / "images" / "stability.png"
TABLE = "<!-- results: generated -->", "<!-- end of the results -->"
CASE_LIST = "<!-- cases: generated -->", "<!-- end of the cases -->"
KILLS = "<!-- kills: generated -->", "<!-- end of the kills -->"


def page(text: str, results: Path) -> str:
    """The page with its generated parts renewed; a part whose results are not stored says so."""
    for marks, name, shown in ((TABLE, "stability", of_table), (KILLS, "kills", of_kills)):
        stored = results / f"{name}.json"
        body = shown(json.loads(stored.read_text())) if stored.exists() else "Not run yet."
        text = between(text, marks, body)
    return between(text, CASE_LIST, of_cases())


def of_cases() -> str:
    """All cases, with the reason for each."""
    cells = [(f"`{case.name}`", case.title, case.why) for case in CASES.values()]
    return "\n".join(table("name | case | why it is there", cells))


def of_table(results: dict[str, Any]) -> str:
    """Picture, verdicts, what failed, and where the runs come from."""
    runs = {
        (row["scene"]["name"], run["name"]): run
        for row in results["cases"]
        for cell in row["cells"].values()
        for run in cell["runs"]
    }
    seconds = sum(run["processor_seconds"] for run in runs.values())
    made: dict[str, list[str]] = {
        name: sorted({str(run["made"][name]) for run in runs.values()})
        for name in ("cpu", "version", "commit")
    }
    picture = (
        '<picture><source media="(prefers-color-scheme: dark)" srcset="images/stability-dark.png">'
        '<img alt="cases by samplers" src="images/stability.png"></picture>'
    )
    circumstances = (
        f"`{results['made']['command']}`: {len(runs)} runs, {seconds / 3600:.1f} hours of one "
        f"core; {', '.join(made['cpu'])}; leco_plugin {', '.join(made['version'])} at "
        f"{', '.join(made['commit'])}; {results['made']['date']}."
    )
    parts = [f"{sentence(headline(results))}", picture, verdicts(results), failures(results)]
    return "\n\n".join(part for part in [*parts, circumstances] if part)


def sentence(text: str) -> str:
    """With a capital at its beginning and a full stop."""
    return f"{text[:1].upper()}{text[1:]}."


def of_kills(results: dict[str, Any]) -> str:
    """How often runs were killed, what that lost, and how they ended beside the others."""
    kills = [kill for run in results["killed"] for kill in run["kills"]]
    early = sum(max(kill["first"], kill["before"]) < 0 for kill in kills)
    saved = sum(kill["before"] > kill["first"] for kill in kills)
    lost = sum(has_lost(kill) for kill in kills)
    ends = runs_killed(results)
    whole = results["undisturbed"]
    finished, _ = runs_gone_on(results)
    return (
        f"`python benchmarks/kills.py`: {len(kills)} kills with SIGKILL at random moments of runs "
        f"of {results['steps']} steps, {early} of them before anything was saved, {saved} of "
        f"processes that had saved something themselves; {lost or 'none'} of them lost something "
        f"that was saved, or left a damaged checkpoint. "
        f"{finished} of {len(ends)} runs that were killed went on to their last step with a frozen "
        f"gate and an occupancy that loads, at {spread(ends)} on test pixels; {len(whole)} runs "
        f"that nobody killed end at {spread(whole)}{difference(ends, whole)}. "
        f"{results['machine']['cpu']}."
    )


def runs_killed(results: dict[str, Any]) -> list[dict[str, Any]]:
    """Runs that were killed at least once."""
    return [run for run in results["killed"] if run["kills"]]


def runs_gone_on(results: dict[str, Any]) -> tuple[int, int]:
    """How many of the runs that were killed went on to their last step with a frozen gate, and how
    many there are."""
    last, ends = results["steps"] - 1, runs_killed(results)
    return sum(run["step"] >= last and run.get("frozen", False) for run in ends), len(ends)


def has_lost(kill: dict[str, Any]) -> bool:
    """Whether less is saved after it than when its process began or just before it, or whether
    something damaged is left."""
    return kill["after"] < max(kill["first"], kill["before"]) or kill.get("damaged", 0) > 0


def psnrs(runs: list[dict[str, Any]]) -> list[float]:
    """Of the runs that have one."""
    return [run["psnr"] for run in runs if "psnr" in run]


def spread(runs: list[dict[str, Any]]) -> str:
    """From the least PSNR to the most, and their mean."""
    values = psnrs(runs)
    if not values:
        return "no PSNR yet"
    return f"{min(values):.2f} to {max(values):.2f} dB (mean {statistics.fmean(values):.2f})"


def difference(killed: list[dict[str, Any]], whole: list[dict[str, Any]]) -> str:
    """Of the means, with its standard error; nothing where too few runs say so."""
    groups = [psnrs(killed), psnrs(whole)]
    if min(map(len, groups)) < 2:
        return ""
    apart = statistics.fmean(groups[0]) - statistics.fmean(groups[1])
    error = math.sqrt(sum(statistics.variance(values) / len(values) for values in groups))
    return f"; the means differ by {apart:+.2f} dB with a standard error of {error:.2f}"
