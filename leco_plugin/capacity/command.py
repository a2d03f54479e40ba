"""`leco capacity`: from the words on the command line to the picture."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from nerfstudio.utils.rich_utils import CONSOLE

from leco_plugin.capacity.choice import choose, draw, kilobytes, verdict
from leco_plugin.capacity.gates import Candidate, gates, grids
from leco_plugin.capacity.measuring import STEPS, Taught, measure_gate, measure_grids, prepare
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
from leco_plugin.log import bar
from leco_plugin.scenes.input_error import InputError, require_folder
from leco_plugin.scenes.photographs import describe_scene

SETTINGS, POINTS, LEFT_OUT = "settings.json", "points", "left_out.json"
TOO_MANY = f"would ask the field at more than {MOST_ON_CPU / 1e6:.0f} million places"
DAMAGED = "is damaged; delete it, or name a new folder with --out"


def capacity(
    data: Path,
    out: Path,
    resolutions: Sequence[int] = (32, 64, 128, 256, 512),
    lost_surface_mass: float = 1e-3,
    learn_steps: int = 200,
    gate_candidates: Sequence[Candidate] | None = None,
) -> dict[str, Any]:
    """Teaches and measures what is missing in a folder, and draws all of it.

    Args:
        data: the scene in nerfstudio's format.
        out: the folder; what is finished stays there whenever this is stopped.
        resolutions: of grids; those that do not fit the memory are left out, and on a CPU those
            that would take long.
        lost_surface_mass: at which kept volumes are compared.
        learn_steps: of the field.
        gate_candidates: `gates()` by default.
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
    wanted = list(gates() if gate_candidates is None else gate_candidates)
    known = _left_out(out) if machine["device"] == "cpu" else []
    of_cells = _grids_to_fill(resolutions, known)
    taught = prepare(data, out, learn_steps)
    rows = _measure_missing(out, taught, wanted, of_cells, lost_surface_mass, code)
    _leave_out(out, [one.size for one in of_cells[len(rows) - len(wanted) :]], known)
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
    wanted: Sequence[Candidate],
    of_cells: Sequence[Candidate],
    lost_surface_mass: float,
    code: dict[str, Any],
) -> list[dict[str, Any]]:
    """A row for each gate, and for each grid up to the first that would take too long."""
    rows: list[dict[str, Any]] = []
    with bar("Teaching representations") as show:

        def add(row: dict[str, Any], new: Candidate | None = None) -> None:
            if new is not None:
                row |= made_by(code)
                write_json(out / POINTS / f"{new.key}.json", row)
                CONSOLE.print(line_of(row), markup=False, highlight=False)
            rows.append(row)
            show(len(rows) / (len(wanted) + len(of_cells)))

        for candidate in wanted:
            row = _stored(out, candidate)
            if row is not None:
                add(row)
            else:
                add(measure_gate(taught, candidate, lost_surface_mass), candidate)
        stored = [row for one in of_cells if (row := _stored(out, one)) is not None]
        if len(stored) == len(of_cells):
            return rows + stored
        for candidate, row in measure_grids(taught, of_cells, lost_surface_mass):
            add(row, candidate)  # all of them: each is refined from the one before
    return rows


def _take_folder(out: Path, settings: dict[str, Any], data: Path) -> None:
    """Makes a folder one of points of these settings, if it is not one already.

    Raises:
        InputError: it holds something else, or points of another scene or of other settings.
    """
    file = out / SETTINGS
    if not file.exists():
        if out.exists() and (not out.is_dir() or any(out.iterdir())):
            raise InputError(f"{out} holds something else; name a new folder with --out")
        return write_json(file, settings)
    found = read_object(file, DAMAGED)
    if found.get("scene") != settings["scene"]:
        raise InputError(
            f"{out} holds points of another scene than {data}; name a new folder with --out"
        )
    for name, value in settings.items():
        if found.get(name) != value:
            raise InputError(
                f"{out} holds points with another {name.replace('_', ' ')} "
                f"({found.get(name)}, not {value}); name a new folder with --out"
            )


def _grids_to_fill(resolutions: Sequence[int], known: Sequence[str]) -> list[Candidate]:
    """The grids that fit the memory and are not known to take too long; says which are left out."""
    found = []
    for candidate in grids(tuple(dict.fromkeys(resolutions))):
        named = f"a grid of {candidate.size}^3 cells"
        if not fits_memory(int(candidate.size) ** 3):
            CONSOLE.print(f"{named} does not fit the free memory; it is left out")
        elif candidate.size in known:
            CONSOLE.print(f"{named} {TOO_MANY}; left out, as before")
        else:
            found.append(candidate)
    return found


def _left_out(out: Path) -> list[str]:
    """Sizes of the grids that an earlier call on a CPU found to take too long."""
    file = out / LEFT_OUT
    found = read_object(file, DAMAGED) if file.exists() else {}
    return list(found["grids"]) if found.get("places") == MOST_ON_CPU else []


def _leave_out(out: Path, sizes: Sequence[str], known: Sequence[str]) -> None:
    """Says and notes which grids would take too long, so that no later call tries them."""
    for size in sizes:
        CONSOLE.print(f"a grid of {size}^3 cells {TOO_MANY}; it is left out")
    if sizes:
        write_json(out / LEFT_OUT, {"places": MOST_ON_CPU, "grids": [*known, *sizes]})


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
