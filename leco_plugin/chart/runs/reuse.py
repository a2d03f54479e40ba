"""Runs of other charts that are just the ones a chart needs, so that nobody makes them twice."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from leco_plugin.chart.contenders.contender import Contender
from leco_plugin.chart.runs.folder import (
    DAMAGED,
    RESULTS,
    RUNS,
    ChartFolder,
    Job,
    difference,
    read_settings,
    stored_in,
)
from leco_plugin.evaluation.json_file import read_object
from leco_plugin.scenes.input_error import InputError


def check_sources(sources: Sequence[Path], settings: Mapping[str, Any]) -> None:
    """Whether runs of other charts may stand beside those of one with these settings.

    Raises:
        InputError: a folder holds no chart, or its runs are of another scene, time, evaluation,
            machine or version. What they were made for, a suite or none, is all that may differ.
    """
    for source in sources:
        found = read_settings(source)
        if found is None:
            raise InputError(f"--reuse {source}: there is no chart in it")
        if other := difference(found, _shared(settings)):
            raise InputError(f"--reuse {source}: its runs have another {other}")


def fitting(sources: Sequence[Path], settings: Mapping[str, Any]) -> list[Path]:
    """Those of several folders that hold charts whose runs may stand beside those of one with
    these settings."""
    charts = [(source, read_settings(source)) for source in sources]
    return [
        source
        for source, found in charts
        if found is not None and difference(found, _shared(settings)) is None
    ]


def _shared(settings: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in settings.items() if name != "suite"}


def take_over(folder: ChartFolder, jobs: Sequence[Job], sources: Sequence[Path]) -> list[Job]:
    """Copies the runs that are stored in other charts and missing in this one.

    Args:
        folder: of this chart.
        jobs: its runs.
        sources: folders of charts, checked; the first that has a run gives it.
    Returns:
        The jobs whose runs were taken over.
    """
    there = folder.stored()
    missing = [job for job in jobs if job.name not in there]
    taken = []
    for source in sources:
        before = _made_before(source)
        for name, record in stored_in(source).items():
            for job in [job for job in missing if serves(record, job)]:
                left = (source / RUNS / f"{name}{kind}" for kind in (".safetensors", ".png"))
                folder.keep(job, [file for file in left if file.exists()])
                made = record.get("made") or before
                folder.store(job, run_for(record, job), made, reused=True)
                missing.remove(job)
                taken.append(job)
    return taken


def _made_before(source: Path) -> dict[str, Any] | None:
    """What a chart from before runs noted it says of all of its runs."""
    file = source / RESULTS
    return read_object(file, DAMAGED).get("made") if file.exists() else None


def serves(record: Mapping[str, Any], job: Job) -> bool:
    """Whether a stored run is the one that a job asks for.

    Grids and taught gates are made after a run, from its field: a run that had more of them is
    the same run.
    """
    made = Contender.from_dict(record["contender"])
    alike = made.alone().key == job.contender.alone().key
    has_all = set(job.contender.grids) <= set(made.grids) and job.contender.taught <= made.taught
    return alike and record["run"]["seed"] == job.seed and has_all


def run_for(record: Mapping[str, Any], job: Job) -> dict[str, Any]:
    """The run of a record with those representations of its field only that the job asks for."""
    run: dict[str, Any] = copy.deepcopy(record["run"])
    facts = (run.get("occupancy") or {}).get("at_equal_loss")
    if facts:
        asked = job.contender.grids
        facts["grids"] = [grid for grid in facts["grids"] if grid["resolution"] in asked]
        facts["left_out"] = [size for size in facts["left_out"] if size in asked]
        if not job.contender.taught:
            facts.pop("taught", None)
    return run
