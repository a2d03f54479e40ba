"""What is known and measured of an occupancy that a run has left: the `occupancy` of reports."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from leco_plugin.evaluation.json_file import finite_or_null
from leco_plugin.evaluation.occupancy_truth import compare_with_truth
from leco_plugin.occupancy import CALIBRATED_AT, Occupancy
from leco_plugin.scenes.city.city import DESCRIPTION
from leco_plugin.scenes.city.truth import CityTruth

FROM_REPORT = (
    "train_seconds",
    "empty_fraction",
    "lost_mass",
    "threshold",
    "lost_surface_mass",
    "image_price_db",
)


def truth_of(folder: Path, manager: Any) -> CityTruth | None:
    """The exact scene in the coordinates of a data manager, where it is a city; None elsewhere."""
    if not (folder / DESCRIPTION).is_file():
        return None
    return CityTruth.from_dataparser(folder, manager.train_dataparser_outputs)


def occupancy_facts(
    occupancy: Occupancy, file: Path, manager: Any, truth: CityTruth | None
) -> dict[str, Any]:
    """Sizes, calibration, and the comparison with the exact scene: JSON values.

    Args:
        occupancy: in the coordinates of `manager`.
        file: that holds it.
        manager: nerfstudio's data manager of the scene.
        truth: the exact scene; without one its figures are None.
    """
    report = occupancy.report
    measured: dict[str, Any] = {"kept_surface_recall": None, "free_space_skipped": None}
    if truth is not None:
        highest = float(manager.train_dataset.cameras.camera_to_worlds[:, 2, 3].max())
        box = torch.tensor(report["aabb"])
        measured = compare_with_truth(occupancy, truth, box, report["step_size"], highest)
    facts: dict[str, Any] = {"params": occupancy.num_params, "bytes": file.stat().st_size}
    for name in ("recoveries", CALIBRATED_AT):  # not every file says
        facts[name] = report.get(name)
    return finite_or_null(facts | {name: report[name] for name in FROM_REPORT} | measured)
