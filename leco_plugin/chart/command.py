"""`leco chart`: from the words on the command line to charts that are made and drawn."""

from __future__ import annotations

import functools
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nerfstudio.utils.rich_utils import CONSOLE

from leco_plugin.chart.contenders.methods import contenders
from leco_plugin.chart.contenders.protocol import Protocol
from leco_plugin.chart.contenders.suites import SUITES, in_order
from leco_plugin.chart.contenders.suites import suite as suite_of
from leco_plugin.chart.runs.processes import ProcessRunner
from leco_plugin.chart.runs.reuse import fitting
from leco_plugin.chart.runs.run import Chart, Runner
from leco_plugin.log import bar, resumable
from leco_plugin.scenes.input_error import InputError

LEFT_BY_SYSTEMS = (".DS_Store", "Thumbs.db")
"""In folders that somebody has looked into."""


@dataclass(frozen=True)
class Asked:
    """What is asked for beside what is compared; None where a suite has its own."""

    seconds: float | None = None
    """Of each run."""
    steps: int | None = None
    """Of each run."""
    learn_seconds: float | None = None
    """Most of that for learning an occupancy."""
    seeds: Sequence[int] = (0, 1, 2)
    """Of each."""
    images: int = 2
    """Whole test images for each run."""
    at_once: int | None = None
    """Runs beside each other; one, or as a suite has it."""
    reuse: Sequence[Path] = ()
    """Folders of other charts on this scene, whose runs need not be made again."""


def processes(chart: Chart) -> Runner:
    """Makes the runs of a chart in processes of their own."""
    threads = {"OMP_NUM_THREADS": str(chart.machine["threads"])}
    return ProcessRunner(
        chart.data,
        chart.protocol,
        chart.folder,
        environment=threads if chart.protocol.at_once > 1 else None,
        stop=chart.stop,
    )


def make_charts(
    data: Path,
    out: Path,
    methods: Sequence[str] = (),
    samplers: Sequence[str] = (),
    suites: Sequence[str] = (),
    asked: Asked = Asked(),
    runner_for: Callable[[Chart], Runner] = processes,
) -> dict[Path, dict[str, Any]]:
    """Makes what is missing of one chart, or of those of several suites, and draws it.

    Args:
        data: a scene in nerfstudio's format.
        out: the chart's folder; of several suites each has one of its own in it, and takes over
            what the others there have made.
        methods, samplers: what is compared, or
        suites: names of comparisons, or `all`.
        asked: how long and how often.
        runner_for: gives what makes the runs of a chart.
    Returns:
        The results by folder, as in `results.json`.
    Raises:
        ValueError, OSError: a name, a time, the scene or a folder is wrong; nothing was started.
    """
    if suites and (methods or samplers):
        raise InputError("a suite has methods of its own: give --suite or --methods, not both")
    names = in_order(suites)
    if len(names) > 1:
        if asked.reuse:
            raise InputError("several suites share their runs by themselves: --reuse is for one")
        _check_shared(out)
        charts = [_chart_of_suite(data, out / name, name, asked, out) for name in names]
    elif names:
        charts = [_chart_of_suite(data, out, names[0], asked)]
    else:
        charts = [_chart_of_methods(data, out, methods, samplers, asked)]
    return {chart.folder.path: _made(chart, runner_for) for chart in charts}


def _check_shared(out: Path) -> None:
    """Whether the suites may have their folders in one.

    Raises:
        InputError: it holds something else.
    """
    known = [*SUITES, *LEFT_BY_SYSTEMS]
    held = sorted(path.name for path in out.iterdir()) if out.exists() else []
    others = [name for name in held if name not in known]
    if others:
        raise InputError(
            f"{out} holds something else ({others[0]}); name a new folder with --out, in which "
            "each suite has one of its own"
        )


def _chart_of_suite(
    data: Path, out: Path, name: str, asked: Asked, beside: Path | None = None
) -> Chart:
    """The chart of a suite; `beside` is where the folders of other suites may be."""
    suite, own = suite_of(name), suite_of(name).protocol
    by_itself = asked.seconds is None and asked.steps is None
    protocol = Protocol(
        own.seconds if by_itself else asked.seconds,
        own.steps if by_itself else asked.steps,
        own.learn_seconds if by_itself and asked.learn_seconds is None else asked.learn_seconds,
        asked.images,
        at_once=own.at_once if asked.at_once is None else asked.at_once,
    )
    chart = Chart(
        *(data, out, suite.contenders, asked.seeds, protocol, (name, suite.question)),
        _command(data, protocol, asked, suite=name),
        asked.reuse,
    )
    if beside is not None:
        others = [beside / other for other in SUITES if other != name]
        chart.reuse = fitting(others, chart.settings)
    return chart


def _chart_of_methods(
    data: Path, out: Path, methods: Sequence[str], samplers: Sequence[str], asked: Asked
) -> Chart:
    compared = contenders(methods, samplers)
    protocol = Protocol(
        *(asked.seconds, asked.steps, asked.learn_seconds, asked.images),
        at_once=1 if asked.at_once is None else asked.at_once,
    )
    command = _command(data, protocol, asked, methods=methods, samplers=samplers)
    return Chart(data, out, compared, asked.seeds, protocol, None, command, asked.reuse)


def _made(chart: Chart, runner_for: Callable[[Chart], Runner]) -> dict[str, Any]:
    """What is missing of a chart is made, and all of it drawn."""
    say = functools.partial(CONSOLE.print, markup=False, highlight=False)
    suite = f"{chart.suite[0]}, " if chart.suite is not None else ""
    title = f"{chart.scene['name']}, {suite}{chart.protocol.describe()} a run"
    with resumable(say), bar(title) as show:
        chart.make(runner_for(chart), say, show)
    return chart.draw()


def _command(
    data: Path,
    protocol: Protocol,
    asked: Asked,
    suite: str | None = None,
    methods: Sequence[str] = (),
    samplers: Sequence[str] = (),
) -> str:
    chosen = {
        "suite": suite,
        "seconds": protocol.seconds,
        "steps": protocol.steps,
        "learn-seconds": protocol.learn_seconds,
        "images": protocol.images,
        "at-once": protocol.at_once if protocol.at_once > 1 or suite is not None else None,
    }
    return command_line(
        data, chosen, {"methods": methods, "samplers": samplers, "seeds": asked.seeds}
    )


def command_line(
    data: Path, chosen: Mapping[str, object], named: Mapping[str, Sequence[object]]
) -> str:
    """What to type for the same chart elsewhere: without this machine's paths."""
    words: list[object] = ["leco", "chart", "--data", data.resolve().name]
    for name, value in chosen.items():
        if value is not None:
            words += [f"--{name}", f"{value:g}" if isinstance(value, float) else value]
    for name, values in named.items():
        if values:
            words += [f"--{name}", *values]
    return shlex.join([str(word) for word in words])
