"""`leco chart`: from the words on the command line to charts that are made and drawn."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from leco_plugin.chart.chart import Chart, why_not_shared
from leco_plugin.chart.contender import Protocol
from leco_plugin.chart.methods import SUITES, contenders, in_order
from leco_plugin.chart.runner import ProcessRunner, Runner
from leco_plugin.chart.worker import WORKER
from leco_plugin.log import bar, counted, put, resumable
from leco_plugin.scenes.input_error import InputError

LEFT_BY_SYSTEMS = (".DS_Store", "Thumbs.db")
"""Files in folders that somebody has looked into."""


def processes(chart: Chart) -> Runner:
    threads = chart.machine["threads"] if chart.protocol.at_once > 1 else None
    return ProcessRunner(chart.data, chart.protocol, chart.folder, WORKER, threads, chart.stop)


def make_charts(
    data: Path,
    out: Path,
    methods: Sequence[str],
    samplers: Sequence[str],
    suites: Sequence[str],
    seeds: Sequence[int],
    reuse: Sequence[Path],
    asked: Mapping[str, Any],
) -> dict[Path, dict[str, Any]]:
    """Makes what is missing of one chart, or of those of several suites, and draws it.

    Args:
        out: the chart's folder; several suites have one each in it, and reuse each other's runs.
        suites: names of comparisons, or `all`; in place of methods and samplers.
        reuse: folders of other charts on this scene, whose runs need not be made again.
        asked: fields of `Protocol`; None where a suite may have its own.
    Returns:
        The results by folder, as in `results.json`.
    Raises:
        ValueError, OSError: a name, a time, the scene or a folder is wrong; nothing was started.
    """
    if suites and (methods or samplers):
        raise InputError("a suite has methods of its own: give --suite or --methods, not both")
    names: Sequence[str | None] = in_order(suites) or [None]
    several = len(names) > 1
    if several:
        if reuse:
            raise InputError("several suites share their runs by themselves: --reuse is for one")
        _check_shared(out)
    charts = []
    for name in names:
        folder = out / str(name) if several else out
        charts.append(_chart_of(data, folder, name, methods, samplers, seeds, reuse, asked))
    if several:
        for chart in charts:
            others = [out / other for other in SUITES if other != chart.suite]
            chart.reuse = [other for other in others if not why_not_shared(other, chart.settings)]
    return {chart.folder.path: _make(chart) for chart in charts}


def refuse_failures(made: Sequence[Mapping[str, Any]]) -> None:
    """Raises `RuntimeError` where runs that were asked for have failed in some of the results."""
    failures = [one for results in made for one in results["failures"] if one["asked"]]
    if failures:
        count = len(failures) + sum(len(results["runs"]) for results in made)
        first = f"({failures[0]['name']}, seed {failures[0]['seed']})"
        raise RuntimeError(
            f"{len(failures)} of {counted(count, 'run')} failed, the first {first} with: "
            f"{failures[0]['reason']}"
        )


def _check_shared(out: Path) -> None:
    """Refuses a folder that holds something else than suites."""
    known = [*SUITES, *LEFT_BY_SYSTEMS]
    held = sorted(path.name for path in out.iterdir()) if out.exists() else []
    others = [name for name in held if name not in known]
    if others:
        raise InputError(
            f"{out} holds something else ({others[0]}); name a new folder with --out, in which "
            "each suite has one of its own"
        )


def _chart_of(
    data: Path,
    out: Path,
    name: str | None,
    methods: Sequence[str],
    samplers: Sequence[str],
    seeds: Sequence[int],
    reuse: Sequence[Path],
    asked: Mapping[str, Any],
) -> Chart:
    suite = SUITES[name] if name is not None else None
    compared = suite.contenders if suite else contenders(methods, samplers)
    given = {name: value for name, value in asked.items() if value is not None}
    usual = asdict(suite.protocol) if suite else {}
    if not given.keys().isdisjoint(("seconds", "steps")):
        usual |= dict.fromkeys(("seconds", "steps", "learn_seconds"))
    protocol = Protocol(**usual | given)
    options = {"suite": name, **asdict(protocol), "methods": methods, "samplers": samplers}
    del options["curve_points"]
    if protocol.held_out == "spread":
        del options["held_out"]
    if not suite and protocol.at_once == 1:
        del options["at_once"]
    command = command_line(data, {**options, "seeds": seeds})
    titled = name, suite.question if suite else None
    return Chart(data, out, compared, seeds, protocol, titled, command, reuse)


def _make(chart: Chart) -> dict[str, Any]:
    suite = f"{chart.suite}, " if chart.suite else ""
    title = f"{chart.scene['name']}, {suite}{chart.protocol.describe()} a run"
    with resumable(), bar(title) as show:
        chart.make(processes(chart), put, show)
    return chart.draw()


def command_line(data: Path, options: Mapping[str, object]) -> str:
    """The command that makes the same chart elsewhere: without this machine's paths.

    Args:
        options: values by option; those that are None or empty are left out.
    """
    words: list[object] = ["leco", "chart", "--data", data.resolve().name]
    for name, value in options.items():
        values = value if isinstance(value, (list, tuple)) else [value]
        if value is not None and values:
            words += ["--" + name.replace("_", "-")]
            words += [f"{one:g}" if isinstance(one, float) else one for one in values]
    return shlex.join(map(str, words))
