"""The command `leco`. What a subcommand needs is imported inside it, so that help comes at once."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Literal

import tyro

from leco_plugin.cli_capacity import capacity, export, shrink
from leco_plugin.cli_reports import check_json as _check_json
from leco_plugin.cli_reports import check_picture, occupancy_of
from leco_plugin.cli_reports import write_json as _write_json
from leco_plugin.scenes.input_error import one_line

BAD_INPUT, FAILURE = 2, 1
FEW_PICTURES = 20
"""For training: with fewer of a city PSNR scatters by decibels between seeds."""
SEPARATE = (
    "leco: what ns-train would be given stands behind --, as in "
    "`leco swap METHOD --occupancy FILE -- --data SCENE`"
)


def city(
    out: Path,
    blocks: int = 3,
    seed: int = 0,
    block_size: float = 40.0,
    width: int = 160,
    height: int = 120,
    aerial_per_block: float = 8.5,
    aerial_only: bool = False,
    sky: bool = False,
    far_terrain: bool = False,
    format: Literal["nerfstudio", "mega-nerf"] = "nerfstudio",
    json: Path | None = None,
) -> None:
    """Write the procedural city as a scene to train on, with its exact geometry.

    A run that was killed goes on where it ended when the same is asked for again.

    Args:
        out: Folder to write. If it holds just this city, nothing is done.
        blocks: The city covers blocks x blocks blocks; above 8, with an irregular outline.
        seed: Another seed, another city.
        block_size: Metres from one street's middle to the next, 32 to 200.
        width: Width of the pictures in pixels.
        height: Height of the pictures in pixels.
        aerial_per_block: Pictures from the air for each block that is built.
        aerial_only: No pictures from the street, as in the city of `leco demo`.
        sky: A sky behind the city; without it, rays that miss are transparent.
        far_terrain: A plain around the city, and hills at several times its size.
        format: Of the scene: nerfstudio's, or Mega-NeRF's, for the data parser mega-nerf.
        json: File for what was written, as JSON.
    """
    _check_json(json)
    from leco_plugin.scenes.city.city import City, CityConfig
    from leco_plugin.scenes.city.folder import CaptureConfig, count_pictures, write_city

    config = CityConfig(blocks, seed, block_size, sky=sky, far_terrain=far_terrain)
    capture = CaptureConfig(width, height)
    capture = replace(capture, aerial_per_block=aerial_per_block)
    if aerial_only:
        capture = replace(capture, street_per_block=0.0)
    folder = write_city(config, out, capture, layout=format)
    images, test_images = count_pictures(folder)
    facts = {
        "format": 1,
        "layout": format,
        "blocks": blocks,
        "block_size": block_size,
        "seed": seed,
        "sky": sky,
        "far_terrain": far_terrain,
        "images": images,
        "test_images": test_images,
        "width": width,
        "height": height,
    }
    print(f"{folder}: {images} pictures, {test_images} of them for testing")
    if images - test_images < FEW_PICTURES:
        print("those are few: with --aerial-per-block 40, PSNR differs less from seed to seed")
    command = f"ns-train leco-occupancy --data {folder}"
    if format == "mega-nerf":  # which has no sparse points to say where the ground is
        roof = City(config).roof
        levels = f"--ray-altitude-range {-1.3 * roof:.0f} {0.5 * roof:.0f}"
        command = f"ns-train leco-occupancy mega-nerf --data {folder} {levels}"
    print(f"train on it with: {command}")
    _write_json(json, facts)


def inspect(
    file: Annotated[Path, tyro.conf.Positional],
    picture: Path | None = None,
    history: Path | None = None,
    json: Path | None = None,
) -> None:
    """Say what an occupancy is: sizes, threshold, price and gain; and draw it.

    Args:
        file: An occupancy.safetensors, or a folder of runs: the newest in it.
        picture: File for a picture: slices of o(x) with the cameras, and the kept points.
        history: File for how it was learned: a .gif that moves, or a still picture. For runs of
            leco-occupancy with --pipeline.model.schedule.steps-per-record 10, say.
        json: File for the same as JSON.
    """
    _check_json(json)
    check_picture("--picture", picture)
    check_picture("--history", history, moving=True)
    from leco_plugin.evaluation.inspection import describe
    from leco_plugin.occupancy import Occupancy

    file = occupancy_of(file)
    occupancy = Occupancy.load(file)
    facts = {**describe(occupancy), "bytes": file.stat().st_size}
    space = facts["space"]
    print(f"{file}: {facts['params']} parameters in {facts['bytes'] / 1000:.1f} kB")
    print(
        f"space: {space['kind']} around {_listed(space['center'])}, {space['half_extent']:.4g} half"
    )
    print(f"kept where o(x) >= {facts['threshold']:.4g}, asked in {facts['precision']}")
    print(f"kept share of its box: {facts['kept_share_of_box']:.2%}")
    for name, value in facts["report"].items():
        if isinstance(value, (int, float, str)) and name not in ("params", "threshold"):
            print(f"{name.replace('_', ' ')}: {_said(value)}")
    if picture is not None:
        from leco_plugin.evaluation.occupancy_picture import draw

        picture.parent.mkdir(parents=True, exist_ok=True)
        print(f"drew {draw(occupancy, picture)}")
    if history is not None:
        from leco_plugin.evaluation.history_picture import draw_history

        history.parent.mkdir(parents=True, exist_ok=True)
        print(f"drew {draw_history(occupancy, file.parent, history)}")
    _write_json(json, facts)


def swap(
    method: Annotated[str, tyro.conf.Positional],
    occupancy: Path | None = None,
    arguments: Annotated[tuple[str, ...], tyro.conf.Positional] = (),
    sampler: str = "learned-occupancy",
    options: Mapping[str, int | float] = MappingProxyType({}),
    codes: Literal["small", "own"] = "small",
    json: Path | None = None,
) -> None:
    """Train any registered nerfstudio method with its sampler swapped for a learned occupancy.

    The run folder opens with every ns-* command as it is.

    Args:
        method: As ns-train knows it: instant-ngp, nerfacto, or of another plugin.
        occupancy: An occupancy.safetensors, or the folder of a run that left one. Without it, one
            is learned first, for samplers that ask one.
        arguments: After --, what ns-train would be given for this method: -- --data DIR ...
        sampler: Of this package or of another, in place of the method's own.
        options: Of that sampler, by name: --options num_candidates 512 cache_bytes 4194304.
        codes: Of the host, for the light of each photograph. small: they begin at zero and are
            scaled by 0.1. own: as the method has them, which can cost test views several dB.
        json: File for the folder of the run, as JSON.
    """
    from leco_plugin.swap import swap as train_swapped

    _check_json(json)
    folder = train_swapped(method, occupancy, arguments, sampler, options, codes)
    print(f"{method}, guided: {folder}")
    facts = {"method": method, "sampler": sampler, "options": dict(options), "codes": codes}
    _write_json(json, {"format": 1, **facts, "folder": str(folder)})


def demo(out: Path = Path("runs/demo"), seconds: float = 130.0, json: Path | None = None) -> None:
    """Learn the occupancy of a small city, go on guided, and compare with never freezing.

    Writes report.json, chart.png, picture.png and occupancy.safetensors. About six minutes on two
    CPU cores.

    Args:
        out: Folder for everything.
        seconds: Training time of each of the two runs.
        json: Another file for the report.
    """
    import time

    began = time.monotonic()
    from leco_plugin.demo import run_demo, summary

    _check_json(json)
    report = run_demo(out, seconds, began=began)
    print("\n".join(summary(report)))
    print(f"see report.json, chart.png and picture.png in {out}")
    _write_json(json, report)


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
    json: Path | None = None,
) -> None:
    """Train methods on a scene for the same time, and draw accuracy against what it costs.

    Writes chart.png, chart-dark.png, chart.html, table.md and results.json. What is finished is
    kept whenever this is stopped; the same command goes on with what is missing.

    Args:
        data: A scene in nerfstudio's format.
        out: Folder of the chart. More methods and seeds may be added to it later.
        methods: As ns-train knows them, or leco-occupancy-never-frozen, -retrained, -homogeneous.
        samplers: Of the registry, occupancy-grid-N for N cells along an axis, or own. By default
            learned-occupancy and own where the method can have both.
        suite: A named comparison instead of methods and samplers. Minutes that it takes on two CPU
            cores with three seeds, by their speed: representations 12 to 30, empty-expert 14 to 34,
            losses 9 to 22, freeze 13 to 16, enough-time 12 to 14, grid-resolution 15 to 16. Several
            of them, or all, have a folder each in that of --out and share their runs: all take 61
            to 108 minutes.
        seconds: Training time of each run. Methods need it or --steps; without either, runs of a
            suite end after 400 steps (4,000 on a GPU), or after 90 s (freeze) or 120 s where times
            are compared.
        steps: Training steps of each run; with both, a run ends with the first.
        seeds: Seeds.
        learn_seconds: Most of a run, about, that learning its occupancy may take. By default 0.4 of
            seconds.
        images: Whole test images that each run renders at its end.
        at_once: Runs beside each other, which share the threads of the CPU. By default 1; suites
            have 2 where there is no GPU.
        reuse: Folders of other charts on this scene: runs of theirs that this one lacks are taken
            over where time, evaluation, machine and version are the same.
        json: Another file for the results.
    """
    _check_json(json)
    from leco_plugin.chart.command import Asked, make_charts

    asked = Asked(seconds, steps, learn_seconds, seeds, images, at_once, reuse)
    made = make_charts(data, out, methods, samplers, suite, asked)
    for folder, results in made.items():
        drawn = "chart.png, chart.html, " if results["runs"] else ""
        print(f"see {drawn}table.md and results.json in {folder}")
    charts = {folder.name: results for folder, results in made.items()}
    _write_json(json, {"format": 1, "charts": charts} if len(made) > 1 else made[out])
    failures = [one for results in made.values() for one in results["failures"] if one["asked"]]
    if failures:
        count = len(failures) + sum(len(results["runs"]) for results in made.values())
        raise RuntimeError(
            f"{len(failures)} of {count} runs failed, the first "
            f"({failures[0]['name']}, seed {failures[0]['seed']}) with: {failures[0]['reason']}"
        )


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
    with what is missing. Exit 0 whatever the verdicts are; 1 says that the case that must fail did
    not fail by its figures, so that no verdict can be believed.

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

    _check_json(json)
    results = make_table(out, cases, samplers, seeds, seeds_beside, quick, minutes)
    print(headline(results))
    print(f"see stability.png, table.md, stability.json and failures in {out}")
    _write_json(json, results)
    if blind(results) and not quick:
        raise RuntimeError(blind(results)[0])


def check(name: Annotated[str, tyro.conf.Positional], json: Path | None = None) -> None:
    """Hold a sampler, or a guided method, to the rules that others rely on: one line a rule.

    A method that is not guided is checked with its sampler swapped, as leco swap does it.

    Args:
        name: A registered sampler or nerfstudio method, of this package or of another.
        json: File for the verdicts as JSON.
    """
    _check_json(json)
    from leco_plugin.conformance.checking import check as verdicts_on

    verdicts = []
    for verdict in verdicts_on(name):
        print(verdict.line(), flush=True)
        verdicts.append(verdict)
    rows = [verdict.to_dict() for verdict in verdicts]
    _write_json(json, {"format": 1, "name": name, "verdicts": rows})
    failed = sum(not verdict.passed for verdict in verdicts)
    if failed:
        raise RuntimeError(f"{name} breaks {failed} of {len(verdicts)} rules")
    print(f"{name} keeps all {len(verdicts)} rules")


COMMANDS: dict[str, Callable[..., None]] = {
    "city": city,
    "inspect": inspect,
    "export": export,
    "shrink": shrink,
    "capacity": capacity,
    "swap": swap,
    "demo": demo,
    "chart": chart,
    "stability": stability,
    "check": check,
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs `leco`: 0, or one line on stderr and 2 for bad input, 1 for a failure."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    # what nerfstudio and torch think of each other is nothing that a user can act on
    warnings.filterwarnings("ignore", module=r"nerfstudio|torch")
    try:
        tyro.extras.subcommand_cli_from_dict(
            COMMANDS,
            prog="leco",
            description="Learned occupancy for nerfstudio: what is empty is skipped.",
            args=given,
        )
    except (ValueError, OSError) as error:  # InputError is both a ValueError and a SystemExit
        return _complain(error, BAD_INPUT)
    except SystemExit as end:
        if end.code == BAD_INPUT and given[:1] == ["swap"] and "--" not in given:
            print(SEPARATE, file=sys.stderr)
        raise
    except (RuntimeError, FloatingPointError, ImportError) as error:
        return _complain(error, FAILURE)
    except KeyboardInterrupt:
        print("leco: stopped; what had been stored stays", file=sys.stderr)
        return 130
    return 0


def _complain(error: BaseException, status: int) -> int:
    message = one_line(error) or type(error).__name__
    print(f"leco: {message}", file=sys.stderr)
    return status


def _said(value: bool | float | str) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return str(value) if isinstance(value, str | int) else f"{value:.4g}"


def _listed(values: Sequence[float]) -> str:
    return "(" + ", ".join(f"{value:.4g}" for value in values) + ")"
