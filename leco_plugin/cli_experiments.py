"""Subcommands of `leco` that measure: chart, stability, capacity and check."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import tyro

from leco_plugin.scenes.whole_files import check_place, check_report, write_report


def chart(
    data: Path,
    out: Path,
    methods: tuple[str, ...] = (),
    samplers: tuple[str, ...] = (),
    suite: tuple[str, ...] = (),
    seconds: float | None = None,
    steps: int | None = None,
    seeds: tuple[int, ...] = (0, 1, 2),
    learn_seconds: float | None = None,
    images: int = 2,
    at_once: int | None = None,
    reuse: tuple[Path, ...] = (),
    held_out: Literal["spread", "stretch"] = "spread",
    json: Path | None = None,
) -> None:
    """Train methods on a scene for the same time, and draw accuracy against what it costs.

    Writes chart.png, chart-dark.png, chart.html, table.md and results.json. What is finished is
    kept whenever this is stopped; the same command goes on with what is missing.

    Args:
        data: A scene in nerfstudio's format.
        out: Folder of the chart. More methods and seeds may be added to it later.
        methods: As ns-train knows them, or leco-occupancy-never-frozen, -retrained, -homogeneous.
        samplers: Of the registry; occupancy-grid-N or learned-occupancy-grid-N, N cells an axis;
            own; long-steps, 4 times as long, none skipped; learned-occupancy-without-gifts, without
            sparse points and opaque start. By default learned-occupancy, own, perhaps long-steps.
        suite: A named comparison instead of methods and samplers. Minutes that it takes on two CPU
            cores with three seeds, by their speed: representations 12 to 30, empty-expert 14 to 34,
            losses 9 to 22, freeze 13 to 16, enough-time 16 to 18, grid-resolution 19 to 21. Several
            of them, or all, have a folder each in that of --out and share their runs: all take 67
            to 117 minutes.
        seconds: Training time of each run. Methods need it or --steps; without either, runs of a
            suite end after 400 steps (4,000 on a GPU), or after 90 s (freeze) or 120 s where times
            are compared.
        steps: Training steps of each run; with both, a run ends with the first.
        seeds: Seeds.
        learn_seconds: Most of a run, about, for learning its occupancy. By default 0.4 of seconds.
        images: Whole test images that each run renders at its end.
        at_once: Runs beside each other, which share the threads of the CPU. By default 1; suites
            have 2 where there is no GPU.
        reuse: Folders of other charts on this scene: runs of theirs that this one lacks are taken
            over where time, evaluation, machine and version are the same.
        held_out: Photographs that are tested. spread takes some all over the scene, as its file
            says; stretch a whole flight line or arc, whose neighbours are not trained on either.
        json: Another file for the results.
    """
    check_report(json, data, out)
    from leco_plugin.chart.command import make_charts, refuse_failures

    times = {"seconds": seconds, "steps": steps, "learn_seconds": learn_seconds}
    asked = {**times, "images": images, "at_once": at_once, "held_out": held_out}
    made = make_charts(data, out, methods, samplers, suite, seeds, reuse, asked)
    for folder, results in made.items():
        drawn = "chart.png, chart.html, " if results["runs"] else ""
        print(f"see {drawn}table.md and results.json in {folder}")
    charts = {folder.name: results for folder, results in made.items()}
    write_report(json, {"format": 1, "charts": charts} if len(made) > 1 else made[out])
    refuse_failures(list(made.values()))


def stability(
    out: Path,
    cases: tuple[str, ...] = (),
    samplers: tuple[str, ...] = (),
    seeds: tuple[int, ...] = (0,),
    seeds_beside: tuple[int, ...] = (),
    minutes: float | None = None,
    quick: bool = False,
    json: Path | None = None,
) -> None:
    """Run samplers through scenes and disturbances in which they fail: a table of who passes.

    Writes stability.json, table.md, stability.png, stability-dark.png, and for each failure a
    picture in failures. What is finished is kept whenever this is stopped; the same command goes on
    with what is missing. Exits with 1 if the case that must fail has not failed by its figures:
    then no verdict counts.

    Args:
        out: Folder of the table. More cases, samplers and seeds may be added to it later.
        cases: Names of cases, by default all; an unknown one is answered with all there are.
        samplers: learned, grid-128, grid-256, proposal-networks, dense, dense-proposal; by default
            all. The dense reference of a sampler's host joins by itself.
        seeds: Seeds of each cell; the case ten-seeds has ten.
        seeds_beside: Seeds of the samplers that learned occupancy is compared with, by default as
            many.
        minutes: How long this may take; the same command then goes on with what is missing.
        quick: Tiny pictures and few steps, to see whether everything works; no verdicts.
        json: Another file for the results.
    """
    from leco_plugin.stability.suite import make_table
    from leco_plugin.stability.table import blind, headline

    check_report(json, out)
    results = make_table(out, cases, samplers, seeds, seeds_beside, quick, minutes)
    print(headline(results))
    print(f"see stability.png, table.md, stability.json and failures in {out}")
    write_report(json, results)
    if blind(results) and not quick:
        raise RuntimeError(blind(results)[0])


def capacity(
    data: Path,
    out: Path,
    grids: tuple[int, ...] = (32, 64, 128, 256, 512),
    lost_surface_mass: float = 1e-3,
    learn_steps: int = 200,
    json: Path | None = None,
) -> None:
    """Answer how much a scene needs: gates and grids of growing size, and which of them suffices.

    One field is learned, and teaches them all. Writes capacity.png, capacity-dark.png and
    results.json. What is finished is kept whenever this is stopped.

    Args:
        data: A scene in nerfstudio's format.
        out: Folder of the picture.
        grids: Cells along an axis of the occupancy grids.
        lost_surface_mass: Share of the weight near surfaces that each may lose.
        learn_steps: Steps in which the field is learned; where its gate has not settled by then, up
            to half as many more.
        json: Another file for the results.
    """
    from leco_plugin.capacity.measuring import capacity as measure

    check_report(json, data, out)
    results = measure(data, out, grids, lost_surface_mass, learn_steps)
    print(results["verdict"])
    print(f"see capacity.png and results.json in {out}")
    write_report(json, results)


def check(name: Annotated[str, tyro.conf.Positional], json: Path | None = None) -> None:
    """Hold a sampler, or a guided method, to the rules that others rely on: one line a rule.

    A method that is not guided is checked with its sampler swapped, as leco swap does it.

    Args:
        name: A registered sampler or nerfstudio method, of this package or of another.
        json: File for the verdicts as JSON.
    """
    check_place("--json", json)
    from leco_plugin.conformance.cases import check as verdicts_on
    from leco_plugin.log import kept_back

    verdicts = []
    with kept_back() as said:
        for verdict in verdicts_on(name):
            print(verdict.line(), flush=True)
            verdicts.append(verdict)
            for line in said if not verdict.passed else ():
                print(f"      said before: {line}")
            said.clear()
    rows = [verdict.to_dict() for verdict in verdicts]
    write_report(json, {"format": 1, "name": name, "verdicts": rows})
    failed = sum(not verdict.passed for verdict in verdicts)
    if failed:
        raise RuntimeError(f"{name} breaks {failed} of {len(verdicts)} rules")
    print(f"{name} keeps all {len(verdicts)} rules")
