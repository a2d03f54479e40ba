"""`table.md`: the verdicts with their figures, and what every failure is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from leco_plugin.stability.contenders import OURS
from leco_plugin.stability.sizes import QUICK

NOTHING = "nothing has been run yet"
QUICKLY = "made with --quick, which shows that everything runs and no more"
NO_VERDICT = "no verdict yet: nothing has been run beside a dense run that trains"
SIGNS = {"pass": "pass", "degraded": "degraded", "fail": "**fail**", "no reference": "-"}


def table(results: Mapping[str, Any]) -> str:
    """The whole of `table.md`."""
    made = results["made"]
    reasons = [[row["title"], row["why"]] for row in results["cases"]]
    parts = ["# Stability", f"{headline(results)}", verdicts(results), failures(results)]
    parts.append(_rows(["case", "why it is there"], reasons))
    commit = f" at {made['commit']}" if made["commit"] else ""
    parts.append(f"`{made['command']}`, {made['date']}, leco_plugin {made['version']}{commit}.")
    return "\n\n".join(part for part in parts if part) + "\n"


def verdicts(results: Mapping[str, Any]) -> str:
    """A row a case, a column a sampler."""
    samplers = results["samplers"]
    rows = [
        [row["title"], *(_cell(row["cells"].get(one["name"])) for one in samplers)]
        for row in results["cases"]
    ]
    return _rows(["case", *(one["title"] for one in samplers)], rows)


def failures(results: Mapping[str, Any]) -> str:
    """What fails or is degraded, and why; empty where nothing is."""
    broken = [
        [row["title"], one["title"], row["cells"][one["name"]]["reason"]]
        for row in results["cases"]
        for one in results["samplers"]
        if row["cells"].get(one["name"], {}).get("verdict") in ("fail", "degraded")
    ]
    return _rows(["case", "sampler", "what failed"], broken) if broken else ""


def headline(results: Mapping[str, Any]) -> str:
    """What the table shows, in a sentence or two."""
    quick = results.get("sizes") == asdict(QUICK)
    return f"{QUICKLY}: {_counted(results)}" if quick else _counted(results)


def _counted(results: Mapping[str, Any]) -> str:
    said = []
    for one in results["samplers"]:
        if one["reference"] is None:
            continue
        verdicts = verdicts_of(results, one["name"])
        held = [verdict for verdict in verdicts if verdict != "no reference"]
        if held:
            said.append((one, held.count("pass"), len(held)))
    if not said:
        ran = any(cell["seeds"] for row in results["cases"] for cell in row["cells"].values())
        return NO_VERDICT if ran else NOTHING
    said.sort(key=lambda part: part[0]["name"] != OURS)
    first, *others = [f"{one['title']} passes {n} of {many}" for one, n, many in said]
    if more := without_reference(results):
        others.insert(0, f"for {more} more it has no dense run that trains")
    missing = sum(cell["missing"] for row in results["cases"] for cell in row["cells"].values())
    if missing:
        others.append(f"{missing} seeds of cells are missing")
    if unproven(results):
        others.append("unproven: the case that must fail has not failed")
    return f"{first} cases" + "".join(f"; {other}" for other in others)


def verdicts_of(results: Mapping[str, Any], sampler: str) -> list[str]:
    """Verdicts of a sampler on all cases but those that must fail."""
    return [
        row["cells"][sampler]["verdict"]
        for row in results["cases"]
        if not row["must_fail"] and sampler in row["cells"]
    ]


def without_reference(results: Mapping[str, Any]) -> int:
    """Cases in which learned occupancy was run and is held to nothing: none that it passes."""
    cells = [row["cells"].get(OURS, {}) for row in results["cases"] if not row["must_fail"]]
    return sum(cell.get("verdict") == "no reference" and cell["seeds"] > 0 for cell in cells)


def blind(results: Mapping[str, Any]) -> list[str]:
    """Why the suite cannot be believed, in a line each: cases that must fail, and have been run
    without failing for what is measured of them."""
    said = []
    for row in results["cases"]:
        cell = row["cells"].get(OURS)
        if not row["must_fail"] or cell is None or cell["verdict"] == "no reference":
            continue
        if cell["verdict"] != "fail":
            said.append(f"the case {row['name']} must fail, and its verdict is {cell['verdict']}")
        elif cell["psnr"] is None:
            said.append(f"the case {row['name']} must fail by its figures; {cell['reason']}")
    return said


def unproven(results: Mapping[str, Any]) -> bool:
    """Whether a case that must fail has not failed: nobody knows then what this table notices."""
    cells = [row["cells"].get(OURS, {}) for row in results["cases"] if row["must_fail"]]
    return bool(blind(results)) or any(cell.get("verdict") != "fail" for cell in cells)


def figures(cell: Mapping[str, Any]) -> tuple[str, str, str]:
    """The figures of a cell in short words: its PSNR, what it skips and how often it was healed,
    and what its seeds say."""
    if cell["psnr"] is None:
        return "no result" if cell["verdict"] == "fail" else cell["reason"], "", ""
    first = f"{cell['psnr']:.1f} dB" if cell["gap"] is None else f"{cell['gap']:+.2f} dB"
    parts = [] if cell["gap"] is None else [f"kept {cell['kept_fraction']:.0%}"]
    if cell["gap"] is not None and cell["lost_mass"] is not None:
        parts.append(f"lost {cell['lost_mass']:.1%}")
    occupancies = [run.get("occupancy") or {} for run in cell.get("runs", ())]
    if healed := max((one.get("recoveries") or 0 for one in occupancies), default=0):
        parts.append(f"healed {healed} x")
    seeds = [f"worst {cell['worst']:+.2f}"] if cell["seeds"] > 1 else []
    if cell["missing"]:
        seeds.append(f"{cell['seeds']} of {cell['seeds'] + cell['missing']} seeds")
    return first, ", ".join(parts), ", ".join(seeds)


def _cell(cell: Mapping[str, Any] | None) -> str:
    if cell is None:
        return ""
    first, *rest = figures(cell)
    more = ", ".join(part for part in rest if part)
    return f"{SIGNS[cell['verdict']]}: {first}" + (f" ({more})" if more else "")


def _rows(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(
        f"| {' | '.join(str(cell).replace('|', chr(92) + '|') for cell in cells)} |"
        for cells in lines
    )
