"""`leco capacity`: from the words on the command line to the picture."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from leco_plugin.capacity.choice import choose, draw, kilobytes, verdict
from leco_plugin.capacity.gates import Candidate, gates, grids
from leco_plugin.capacity.measuring import STEPS, Taught, measure_gate, measure_grids, prepare
from leco_plugin.chart.runner import SETTINGS, make_jobs, take_folder
from leco_plugin.chart.theme import DARK, LIGHT
from leco_plugin.evaluation.equal_loss import MOST_ON_CPU
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

POINTS, LEFT_OUT = "points", "left_out.json"
TOO_MANY = f"would ask the field at more than {MOST_ON_CPU / 1e6:.0f} million places"
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
        resolutions: of grids; those that do not fit the memory are left out, and on a CPU those
            that would take long.
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
    }
    _take_folder(out, {"scene": scene, **settings}, data)
    say = functools.partial(console().print, markup=False, highlight=False)
    known = _left_out(out) if machine["device"] == "cpu" else []
    candidates = [*gates(), *_grids_to_fill(resolutions, known, say)]
    taught = prepare(data, out, learn_steps)
    rows = _measure_missing(out, taught, candidates, lost_surface_mass, code, say)
    # what is left of the candidates are grids that would take too long: no later call tries them
    if left := [candidate.size for candidate in candidates[len(rows) :]]:
        write_json(out / LEFT_OUT, {"places": MOST_ON_CPU, "grids": [*known, *left]})
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
    """A row for each gate, and for each grid up to the first that would take too long."""
    rows = {one.key: row for one in candidates if (row := _stored(out, one)) is not None}
    of_cells = [one for one in candidates if one.gate is None]
    if all(one.key in rows for one in of_cells):
        of_cells = []
    for one in of_cells:  # all of them: each is refined from the one before
        rows.pop(one.key, None)
    todo = [one for one in candidates if one.key not in rows]
    filling = measure_grids(taught, of_cells, lost_surface_mass)

    def measure_one(candidate: Candidate, show: Callable[[float], None]) -> str:
        if candidate.gate is not None:
            row = measure_gate(taught, candidate, lost_surface_mass)
        elif (filled := next(filling, None)) is not None:
            row = filled[1]
        else:
            return f"{_in_words(candidate)} {TOO_MANY}; it is left out"
        rows[candidate.key] = row | made_by(code)
        write_json(out / POINTS / f"{candidate.key}.json", rows[candidate.key])
        return line_of(row)

    with bar("Teaching representations") as show:
        make_jobs(todo, measure_one, say, show, done=len(rows))
    return [rows[one.key] for one in candidates if one.key in rows]


def _take_folder(out: Path, settings: dict[str, Any], data: Path) -> None:
    """As `take_folder`; of another scene only its folder is said."""
    file = out / SETTINGS
    if file.is_file() and read_object(file, DAMAGED).get("scene") != settings["scene"]:
        raise InputError(
            f"{out} holds points of another scene than {data}; name a new folder with --out"
        )
    take_folder(file, settings, "points with another", DAMAGED)


def _grids_to_fill(
    resolutions: Sequence[int], known: Sequence[str], say: Callable[[str], None]
) -> list[Candidate]:
    """The grids that fit the memory and are not known to take too long; says which are left out."""
    found = []
    for candidate in grids(tuple(dict.fromkeys(resolutions))):
        if not fits_memory(int(candidate.size) ** 3):
            say(f"{_in_words(candidate)} does not fit the free memory; it is left out")
        elif candidate.size in known:
            say(f"{_in_words(candidate)} {TOO_MANY}; left out, as before")
        else:
            found.append(candidate)
    return found


def _left_out(out: Path) -> list[str]:
    """Sizes of the grids that an earlier call on a CPU found to take too long."""
    file = out / LEFT_OUT
    found = read_object(file, DAMAGED) if file.exists() else {}
    return list(found["grids"]) if found.get("places") == MOST_ON_CPU else []


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


def _in_words(grid: Candidate) -> str:
    return f"a grid of {grid.size}^3 cells"
