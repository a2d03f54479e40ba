"""The folder of a table: it is taken before anything is written in it, and holds nothing else."""

from __future__ import annotations

import shutil
from dataclasses import asdict
from pathlib import Path
from typing import Any

from leco_plugin.chart.runner import UNFINISHED, difference
from leco_plugin.chart.runner import RunFolder as ChartFolder
from leco_plugin.evaluation.report import read_object, write_json
from leco_plugin.scenes.input_error import InputError
from leco_plugin.stability.sizes import Sizes
from leco_plugin.studio.run_folder import LOCK

SIZES = "sizes.json"
"""File whose presence says that a folder is a table's, with the sizes of all runs there."""
SCENES, RUNS, FAILURES = "scenes", "runs", "failures"
DAMAGED = "is damaged, or not of a table; delete it, or name a new folder with --out"
OF_A_RUN = {"sampler", "seed", "psnr", "processor_seconds", "measured"}
"""What is asked of the record of every run."""


def take(out: Path, sizes: Sizes) -> None:
    """Makes a folder one of tables in these sizes, if it is not one already.

    Raises:
        InputError: it holds something else, or a table in other sizes; nothing was written.
    """
    file = out / SIZES
    if file.is_file():
        if unlike := difference(read_object(file, DAMAGED), asdict(sizes)):
            raise InputError(
                f"{out} holds a table of other sizes, with --quick or without: {unlike}; "
                "name a new folder with --out"
            )
    elif out.exists() and any(path.name != LOCK for path in out.iterdir()):
        raise InputError(f"{out} holds something else; name a new folder with --out")
    else:
        write_json(file, asdict(sizes))
    folders = [out / name for name in (SCENES, RUNS, FAILURES)]
    if other := [folder for folder in folders if folder.exists() and not folder.is_dir()]:
        raise InputError(f"{other[0]} is no folder; delete it, or name a new one with --out")
    for folder in folders:
        folder.mkdir(exist_ok=True)


def finished_in(folder: ChartFolder) -> dict[str, dict[str, Any]]:
    """Records of the runs of a scene by name.

    Raises:
        InputError: one is damaged.
    """
    found = {name: record["run"] for name, record in folder.stored().items()}
    for name, run in found.items():
        if missing := OF_A_RUN - run.keys():
            raise InputError(
                f"the run {name} in {folder.path} has no {min(missing)}; delete its file to have "
                "it made again"
            )
    return found


def forget_unfinished(folder: ChartFolder) -> None:
    """Deletes what runs that were killed have left: nobody else may be making any."""
    shutil.rmtree(folder.path / UNFINISHED, ignore_errors=True)
    (folder.path / UNFINISHED).mkdir()
