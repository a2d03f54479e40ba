"""`leco capacity`: from the words on the command line to the picture."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from leco_plugin.capacity.choice import choose, draw, kilobytes, verdict
from leco_plugin.capacity.measuring import STEPS, Taught, measure_gate, measure_grid, prepare
from leco_plugin.capacity.search import Candidate, gates, grids
from leco_plugin.chart.runner import SETTINGS, make_jobs, take_folder
from leco_plugin.chart.theme import DARK, LIGHT
from leco_plugin.evaluation.field_grids import fits_memory
from leco_plugin.evaluation.report import (
    describe_code,
    describe_machine,
    made_by,
    read_object,
    write_json,
)
from leco_plugin.log import bar, console
from leco_plugin.scenes.input_error import InputError, require_folder
from leco_plugin.scenes.photographs import describe_scene

POINTS = "points"
DAMAGED = "is damaged; delete it, or name a new folder with --out"


def capacity(
    data: Path,
    out: Path,
    resolutions: Sequence[int] = (32, 64, 128, 256, 512),
    lost_surface_mass: float = 1e-3,
    learn_steps: int = 200,
) -> dict[str, Any]:
    """Teaches and measures what is missing in a folder, and draws all of it.

    Args:
        data: the scene in nerfstudio's format.
        out: the folder; what is finished stays there whenever this is stopped.
        resolutions: of grids; those that do not fit the memory are left out.
        lost_surface_mass: at which kept volumes are compared.
        learn_steps: of the field.
    Returns:
        The results, as in `results.json`.
    Raises:
        ValueError, OSError: a folder or a size is wrong; nothing was started.
    """
    _check_options(resolutions, lost_surface_mass, learn_steps)
    require_folder("--data", data)
    scene, machine, code = describe_scene(data), describe_machine(), describe_code()
    settings = {
        "lost_surface_mass": lost_surface_mass,
        "learn_steps": learn_steps,
        "teach_steps": STEPS,
        "grids": "by the lesson of the gates",
    }
    _take_folder(out, {"scene": scene, **settings}, data)
    say = functools.partial(console().print, markup=False, highlight=False)
    candidates = [*gates(), *_grids_that_fit(resolutions, say)]
    taught = prepare(data, out, learn_steps)
    rows = _measure_missing(out, taught, candidates, lost_surface_mass, code, say)
    results = {
        "format": 1,
        "machine": machine,
        "scene": {**scene, "train_images": taught.mixture.num_images},
        **settings,
        "rays": taught.held_out.rays,
        "representations": rows,
        "chosen": dict(choose(rows)),
        "verdict": verdict(rows),
    }
    write_json(out / "results.json", results)
    draw(results, out / "capacity.png", LIGHT)
    draw(results, out / "capacity-dark.png", DARK)
    return results


def _check_options(resolutions: Sequence[int], lost_surface_mass: float, learn_steps: int) -> None:
    if not 0.0 < lost_surface_mass < 0.5:
        raise InputError(f"--lost-surface-mass is {lost_surface_mass}, not between 0 and 0.5")
    if learn_steps < 1:
        raise InputError(f"--learn-steps is {learn_steps}; a field is learned in one or more")
    if any(n < 2 for n in resolutions):
        raise InputError(
            f"--grids has {min(resolutions)}; a grid has 2 cells or more along an axis"
        )


def _measure_missing(
    out: Path,
    taught: Taught,
    candidates: Sequence[Candidate],
    lost_surface_mass: float,
    code: dict[str, Any],
    say: Callable[[str], None],
) -> list[dict[str, Any]]:
    rows = {one.key: row for one in candidates if (row := _stored(out, one)) is not None}
    todo = [one for one in candidates if one.key not in rows]

    def measure_one(candidate: Candidate, show: Callable[[float], None]) -> str:
        measured = measure_grid if candidate.gate is None else measure_gate
        row = rows[candidate.key] = measured(taught, candidate, lost_surface_mass) | made_by(code)
        write_json(out / POINTS / f"{candidate.key}.json", row)
        return line_of(row)

    with bar("Teaching representations") as show:
        make_jobs(todo, measure_one, say, show, done=len(rows))
    return [rows[one.key] for one in candidates]


def _take_folder(out: Path, settings: dict[str, Any], data: Path) -> None:
    """As `take_folder`; of another scene only its folder is said."""
    file = out / SETTINGS
    if file.is_file() and read_object(file, DAMAGED).get("scene") != settings["scene"]:
        raise InputError(
            f"{out} holds points of another scene than {data}; name a new folder with --out"
        )
    take_folder(file, settings, "points with another", DAMAGED)


def _grids_that_fit(resolutions: Sequence[int], say: Callable[[str], None]) -> list[Candidate]:
    """The grids that fit the memory; says which do not."""
    found = grids(tuple(dict.fromkeys(resolutions)))
    for candidate in found:
        if not fits_memory(int(candidate.size) ** 3):
            say(f"a grid of {candidate.size}^3 cells does not fit the free memory; it is left out")
    return [one for one in found if fits_memory(int(one.size) ** 3)]


def _stored(out: Path, candidate: Candidate) -> dict[str, Any] | None:
    """The row of an earlier call; None where there is none."""
    file = out / POINTS / f"{candidate.key}.json"
    if not file.exists():
        return None
    row = read_object(file, DAMAGED)
    if row.get("bytes") != candidate.bytes:
        raise InputError(f"{file} is no measured representation; delete it to measure it again")
    return row


def line_of(row: dict[str, Any]) -> str:
    """A representation as a line of the table."""
    return (
        f"{row['family']:<10} {row['size']:<10} {kilobytes(row):>10}  keeps "
        f"{row['kept_volume']:>6.2%} of the volume"
    )
