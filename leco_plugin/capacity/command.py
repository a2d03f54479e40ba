"""`leco capacity`: from the words on the command line to the picture."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from nerfstudio.utils.rich_utils import CONSOLE

from leco_plugin.capacity.choice import choose, kilobytes, verdict
from leco_plugin.capacity.field import prepare
from leco_plugin.capacity.measuring import STEPS, Candidate, gates, grids, of_gate, of_grids
from leco_plugin.capacity.picture import draw
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
from leco_plugin.scenes.description import describe_scene
from leco_plugin.scenes.input_error import InputError, require_folder

SETTINGS, POINTS, LEFT_OUT = "settings.json", "points", "left_out.json"
TOO_MANY = f"would ask the field at more than {MOST_ON_CPU / 1e6:.0f} million places"
DAMAGED = "is damaged; delete it, or name a new folder with --out"
MEASURED = {"family", "size", "kept_volume", "lost_at_volumes"}
"""What a row must have beside its bytes."""


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
    if not 0.0 < lost_surface_mass < 0.5:
        raise ValueError(f"--lost-surface-mass is {lost_surface_mass}, not between 0 and 0.5")
    if learn_steps < 1:
        raise ValueError(f"--learn-steps is {learn_steps}; a field is learned in one or more")
    if any(n < 2 for n in resolutions):
        raise ValueError(
            f"--grids has {min(resolutions)}; a grid has 2 cells or more along an axis"
        )
    require_folder("--data", data)
    scene, machine, code = describe_scene(data), describe_machine(), describe_code()
    settings = {
        "lost_surface_mass": lost_surface_mass,
        "learn_steps": learn_steps,
        "teach_steps": STEPS,
    }
    _settle(out, {"scene": scene, **settings}, data)
    wanted = list(gates() if gate_candidates is None else gate_candidates)
    known = _left_out(out) if machine["device"] == "cpu" else []
    of_cells = _grids_to_fill(resolutions, known)
    ground = prepare(data, out, learn_steps)
    rows: list[dict[str, Any]] = []
    with bar("Teaching representations") as show:
        for number, candidate in enumerate(wanted):
            row = _stored(out, candidate)
            if row is None:
                row = of_gate(ground, candidate, lost_surface_mass)
                _store(out, candidate, row, code)
            rows.append(row)
            show((number + 1) / (len(wanted) + len(of_cells)))
        stored = [_stored(out, candidate) for candidate in of_cells]
        if all(row is not None for row in stored):
            rows += [row for row in stored if row is not None]
        else:  # each grid is refined from the one before
            filling = of_grids(ground, of_cells, lost_surface_mass)
            for number, (candidate, row) in enumerate(filling):
                _store(out, candidate, row, code)
                rows.append(row)
                show((len(wanted) + number + 1) / (len(wanted) + len(of_cells)))
            left_out = [candidate.size for candidate in of_cells[len(rows) - len(wanted) :]]
            for size in left_out:
                CONSOLE.print(f"a grid of {size}^3 cells {TOO_MANY}; it is left out")
            if left_out:
                write_json(out / LEFT_OUT, {"places": MOST_ON_CPU, "grids": [*known, *left_out]})
    manager_images = int(ground.model.num_train_data)
    results = {
        "format": 1,
        "machine": machine,
        "scene": {**scene, "train_images": manager_images},
        "lost_surface_mass": lost_surface_mass,
        "learn_steps": learn_steps,
        "teach_steps": STEPS,
        "rays": ground.held_out.rays,
        "representations": rows,
        "chosen": dict(choose(rows)),
        "verdict": verdict(rows),
    }
    write_json(out / "results.json", results)
    draw(results, out / "capacity.png", LIGHT)
    draw(results, out / "capacity-dark.png", DARK)
    return results


def _settle(out: Path, settings: dict[str, Any], data: Path) -> None:
    """Whether a folder may hold points of these settings.

    Raises:
        InputError: it holds something else, or points of another scene or of other settings.
    """
    file = out / SETTINGS
    if file.exists():
        found = read_object(file, DAMAGED)
        if found.get("scene") != settings["scene"]:
            raise InputError(
                f"{out} holds points of another scene than {data}, or of an earlier version; "
                "name a new folder with --out"
            )
        names = [name for name, value in settings.items() if found.get(name) != value]
        if names:
            raise InputError(
                f"{out} holds points with another {names[0].replace('_', ' ')} "
                f"({found.get(names[0])}, not {settings[names[0]]}); name a new folder with --out"
            )
    elif out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"{out} holds something else; name a new folder with --out")
    else:
        write_json(file, settings)


def _grids_to_fill(resolutions: Sequence[int], known: Sequence[str]) -> list[Candidate]:
    """The grids that fit the memory and are not known to take too long; says which are left out."""
    found = []
    for candidate in grids(tuple(dict.fromkeys(resolutions))):
        if not fits_memory(int(candidate.size) ** 3):
            CONSOLE.print(
                f"a grid of {candidate.size}^3 cells does not fit the free memory; it is left out"
            )
        elif candidate.size in known:
            CONSOLE.print(f"a grid of {candidate.size}^3 cells {TOO_MANY}; left out, as before")
        else:
            found.append(candidate)
    return found


def _left_out(out: Path) -> list[str]:
    """Sizes of the grids that an earlier call on a CPU found to take too long."""
    file = out / LEFT_OUT
    if not file.exists():
        return []
    found = read_object(file, DAMAGED)
    sizes = found.get("grids")
    same = found.get("places") == MOST_ON_CPU and isinstance(sizes, list)
    return [str(size) for size in sizes if str(size).isdigit()] if same and sizes else []


def _stored(out: Path, candidate: Candidate) -> dict[str, Any] | None:
    file = out / POINTS / f"{candidate.key}.json"
    if not file.exists():
        return None
    row = read_object(file, DAMAGED)
    if row.get("bytes") != candidate.bytes or not row.keys() >= MEASURED:
        raise InputError(f"{file} is no measured representation; delete it to measure it again")
    return row


def _store(out: Path, candidate: Candidate, row: dict[str, Any], code: dict[str, Any]) -> None:
    """Leaves a row that was measured now, with what made it."""
    row |= made_by(code)
    write_json(out / POINTS / f"{candidate.key}.json", row)
    CONSOLE.print(line_of(row), markup=False, highlight=False)


def line_of(row: dict[str, Any]) -> str:
    """A representation as a line of the table."""
    return (
        f"{row['family']:<10} {row['size']:<10} {kilobytes(row):>10}  keeps "
        f"{row['kept_volume']:>6.2%} of the volume"
    )
