"""`leco chart`: from the words on the command line to a chart that is made and drawn."""

from __future__ import annotations

import functools
import shlex
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from nerfstudio.utils.rich_utils import CONSOLE

from leco_plugin.chart.folder import ChartFolder
from leco_plugin.chart.methods import contenders
from leco_plugin.chart.processes import ProcessRunner
from leco_plugin.chart.protocol import Protocol
from leco_plugin.chart.run import Chart, Runner
from leco_plugin.chart.suites import suite as suite_of
from leco_plugin.progress_bar import bar
from leco_plugin.scenes.input_error import InputError


def make_chart(
    data: Path,
    out: Path,
    methods: Sequence[str] = (),
    samplers: Sequence[str] = (),
    suite: str | None = None,
    seconds: float | None = None,
    steps: int | None = None,
    seeds: Sequence[int] = (0, 1, 2),
    learn_seconds: float | None = None,
    images: int = 2,
    reuse: Sequence[Path] = (),
    runner_for: Callable[[Path, Protocol, ChartFolder], Runner] = ProcessRunner,
) -> dict[str, Any]:
    """Makes what is missing of a chart and draws it.

    Args:
        data: a scene in nerfstudio's format.
        out: the chart's folder.
        methods, samplers: what is compared, or
        suite: the name of a comparison.
        seconds, steps: of each run; a suite has a time of its own.
        seeds: of each.
        learn_seconds: most of it for learning an occupancy.
        images: whole test images for each run.
        reuse: folders of other charts on this scene, whose runs need not be made again.
        runner_for: gives what makes a run.
    Returns:
        The results, as in `results.json`.
    Raises:
        ValueError, OSError: a name, a time, the scene or the folder is wrong; nothing was started.
    """
    about = None
    if suite is not None:
        if methods or samplers:
            raise InputError("a suite has methods of its own: give --suite or --methods, not both")
        comparison = suite_of(suite)
        compared, about = list(comparison.contenders), (suite, comparison.question)
        if seconds is None and steps is None:
            seconds = comparison.seconds
            if learn_seconds is None:
                learn_seconds = comparison.learn_seconds
    else:
        compared = contenders(methods, samplers)
    protocol = Protocol(seconds, steps, learn_seconds, images)
    named = {"methods": methods, "samplers": samplers, "seeds": seeds}
    chosen = {
        "suite": suite,
        "seconds": seconds,
        "steps": steps,
        "learn-seconds": learn_seconds,
        "images": images,
    }
    command = command_line(data, chosen, named)
    chart = Chart(data, out, compared, seeds, protocol, about, command, reuse)
    say = functools.partial(CONSOLE.print, markup=False, highlight=False)
    with bar(f"{chart.scene['name']}, {protocol.describe()} a run") as show:
        chart.make(runner_for(data, protocol, chart.folder), say, show)
    return chart.draw()


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
