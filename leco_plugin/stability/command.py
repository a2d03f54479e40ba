"""`leco stability`: from the words on the command line to a table that is made and drawn."""

from __future__ import annotations

import functools
import math
import shlex
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from nerfstudio.utils.rich_utils import CONSOLE

from leco_plugin.log import bar, resumable
from leco_plugin.scenes.input_error import InputError
from leco_plugin.stability.cases import cases_named
from leco_plugin.stability.contenders import samplers_named
from leco_plugin.stability.sizes import FULL, QUICK
from leco_plugin.stability.suite import Runner, Suite
from leco_plugin.studio.run_folder import alone_in


def make_table(
    out: Path,
    cases: Sequence[str] = (),
    samplers: Sequence[str] = (),
    seeds: Sequence[int] = (0,),
    seeds_beside: Sequence[int] = (),
    quick: bool = False,
    minutes: float | None = None,
    runner_for: Callable[[str], Runner] | None = None,
    earlier: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Makes what is missing of a table and draws it.

    Args:
        out: the table's folder.
        cases, samplers: their names; none is all.
        seeds: of each cell; cases that are about seeds have more.
        seeds_beside: of the samplers that learned occupancy is compared with, see `entries_of`.
        quick: tiny sizes, for a look at whether everything works.
        minutes: that this may take, about; None is as many as it takes.
        runner_for: gives what makes the runs of a scene.
        earlier: results whose runs are kept where they would be made here just so.
    Returns:
        The results, as in `stability.json`.
    Raises:
        ValueError, OSError: a name or the folder is wrong; nothing was started.
    """
    if minutes is not None and not 0.0 < minutes < math.inf:
        raise InputError(f"a table is made in a positive number of minutes, not {minutes}")
    chosen, compared = cases_named(tuple(cases)), samplers_named(tuple(samplers))
    say = functools.partial(CONSOLE.print, markup=False, highlight=False)
    named = {"cases": cases, "samplers": samplers, "seeds": seeds, "seeds-beside": seeds_beside}
    command, sizes = command_line(quick, named), QUICK if quick else FULL
    with alone_in(out, "table"):
        suite = Suite(out, chosen, compared, seeds, sizes, command, seeds_beside)
        if earlier is not None:
            say(f"{suite.take_over(earlier)} runs of earlier results are taken over")
        say(suite.estimate())
        with resumable(say), bar(f"{len(chosen)} cases") as show:
            suite.make(say, show, runner_for, math.inf if minutes is None else 60.0 * minutes)
        if left := len(suite.missing()):
            say(f"{left} runs are left or have failed; the same command goes on with them")
        return suite.draw()


def command_line(quick: bool, named: dict[str, Sequence[object]]) -> str:
    """What to type for the same table elsewhere: without this machine's paths."""
    words: list[object] = ["leco", "stability", "--out", "DIR"]
    for name, values in named.items():
        if values:
            words += [f"--{name}", *values]
    return shlex.join(map(str, [*words, *(["--quick"] if quick else [])]))
