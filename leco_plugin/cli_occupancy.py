"""Subcommands of `leco` about an occupancy file: inspect, export and shrink."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from leco_plugin.scenes.whole_files import check_apart, check_picture, check_place, write_report

if TYPE_CHECKING:
    from leco_plugin.occupancy import Occupancy

PAGE = ".html"
"""Ending of the page beside a picture."""


def occupancy_of(path: Path) -> Path:
    """The file that is meant: itself, or the newest occupancy in a folder of runs. ValueError if
    there is none."""
    give = "give an occupancy.safetensors, or a folder with a run that left one"
    give += ", as outputs/SCENE/leco-occupancy"
    if not path.exists():
        raise ValueError(f"there is no {path}: {give}")
    if not path.is_dir():
        return path
    from leco_plugin.hosts.guided_start import occupancy_file

    file = occupancy_file(path)
    if not file.exists():
        raise ValueError(f"there is no occupancy.safetensors in {path}: {give}")
    return file


def inspect(
    file: Annotated[Path, tyro.conf.Positional],
    picture: Path | None = None,
    history: Path | None = None,
    data: Path | None = None,
    json: Path | None = None,
    dark: bool = False,
) -> None:
    """Say what an occupancy is: sizes, threshold, price and gain; and draw it.

    Args:
        file: An occupancy.safetensors, or a folder of runs: the newest in it.
        picture: File for a picture: slices of o(x) with the cameras, and the kept points. A page to
            look around in the kept volume, for any browser, is written beside it, as .html.
        history: File for how it was learned: a .gif that moves, or a still picture. For runs of
            leco-occupancy with --pipeline.model.schedule.steps-per-record 10, say.
        data: The scene that it was learned on, for the colours of its sparse points in picture and
            page. By default that of the run it lies in.
        json: File for the same as JSON.
        dark: Draw the picture for a dark page.
    """
    check_place("--json", json)
    check_picture("--picture", picture)
    page = None if picture is None else picture.with_suffix(PAGE)
    check_place("--picture", page)
    check_picture("--history", history, moving=True)
    if picture is None and (dark or data is not None):
        raise ValueError("--data and --dark are about the picture: give --picture FILE")
    from leco_plugin.evaluation.inspection import describe, doubts, scene_of
    from leco_plugin.learning.quality import price_in_words, views_in_words
    from leco_plugin.occupancy import Occupancy

    file = occupancy_of(file)
    written = {"--picture": picture, "the page of --picture": page, "--history": history}
    _check_apart({**written, "--json": json}, file, data)
    occupancy = Occupancy.load(file)
    scene = None if picture is None else scene_of(occupancy, file, data)
    if history is not None:
        from leco_plugin.evaluation.history_picture import draw_history, read_history

        looks = read_history(occupancy, file.parent)  # a fault is said before anything is drawn
    facts = {**describe(occupancy), "bytes": file.stat().st_size}
    space = facts["space"]
    print(f"{file}: {facts['params']} parameters in {facts['bytes'] / 1000:.1f} kB")
    center = ", ".join(f"{value:.4g}" for value in space["center"])
    print(f"space: {space['kind']} around ({center}), {space['half_extent']:.4g} half")
    print(f"kept where o(x) >= {facts['threshold']:.4g}, asked in {facts['precision']}")
    print(f"kept share of its box: {facts['kept_share_of_box']:.2%}")
    print(f"share of its box that photographs show: {facts['seen_share_of_box']:.2%}")
    report = facts["report"]
    print(*price_in_words(report), views_in_words(report), *doubts(facts), sep="\n")
    print("its report, whose keys docs/file-format.md explains:")
    for name, value in report.items():
        if isinstance(value, (int, float, str)) and name not in ("params", "threshold"):
            print(f"  {name}: {_said(value)}")
    if picture is not None:
        _draw(occupancy, picture, scene, dark)
    if history is not None:
        print(f"drew {draw_history(occupancy, looks, history)}")
    write_report(json, facts)


def export(
    file: Annotated[Path, tyro.conf.Positional],
    out: Path,
    format: Literal["ply", "splat-init", "npz", "nerfacc-grid"] | None = None,
    resolution: int | None = None,
    levels: int | None = None,
    frame: Literal["data", "run"] | None = None,
    data: Path | None = None,
    json: Path | None = None,
) -> None:
    """Write an occupancy for other programs: into a folder all that they take, or one file.

    Args:
        file: An occupancy.safetensors, or a folder of runs: the newest in it.
        out: Folder to write pictures, points, a start for splats and a volume into; with --format,
            the file to write.
        format: Without it, all but the grid. ply is what the photographs show of the kept volume,
            as points on it where their rays first meet matter, in the colours of the sparse points
            nearby; its head has the geographic origin where transforms.json has one. Without
            coloured sparse points, colours are o(x): black at 0, purple, orange, pale yellow at 1.
            splat-init is a copy of transforms.json beside the scene's own, with these points and
            the kept sparse points as its start: ns-train splatfacto --data OUT leco-photographs.
            npz is o(x) in the cells of the box. nerfacc-grid is what
            OccGridEstimator.load_state_dict takes, a cell marked where any of 27 points in it is
            kept. A host that goes on updating such a grid replaces it by its own.
        resolution: Cells along the longest side of the space, or along each axis of a grid. By
            default 128, and along a flat space so many that it has as many cells as a cube.
        levels: Nested boxes of a grid, each twice as wide as the one inside it. By default one, or
            as many as the rays of an unbounded scene reach.
        frame: Coordinates of points. data, the default, are those of the poses and sparse points in
            the data's own files, as of UTM; run are those in which the run works. A grid is always
            in those of the run, for its boxes lie along the axes.
        data: The scene that it was learned on. By default that of the run it lies in.
        json: File for what was written, as JSON.
    """
    from leco_plugin import export as made

    check_place("--json", json)
    file = occupancy_of(file)
    start = format == "splat-init" and out.suffix == ".json"
    points = out.with_suffix(".ply") if start else None
    check_apart({"--out": out, "the points of --out": points, "--json": json}, file)
    # a start for splats has lines of its own about the scene's files, and a folder may be the scene
    is_file = format is not None and format != "splat-init"
    _check_apart({"--json": json, **({"--out": out} if is_file else {})}, file, data)
    if format is not None:
        facts = made.export(file, format, out, resolution, levels, frame, data)
        print("\n".join(_export_in_words(out, facts, frame)))
        write_report(json, facts)
        return
    if levels is not None or frame is not None:
        raise ValueError("--levels and --frame go with --format: give one, or leave them out")
    parts, doubted = made.export_folder(file, out, resolution, data)
    print("\n".join(made.in_words(out, parts, doubted)))
    write_report(json, {"format": 1, "parts": {part.name: part.facts for part in parts}})


def _export_in_words(out: Path, facts: dict[str, Any], frame: str | None) -> list[str]:
    """What was written, a line each; `frame` of points is the one that was asked for."""
    from leco_plugin.export import counts_in_words

    if facts["written"] == "npz":
        return [f"{out}: {facts['shape']} cells, {facts['kept_share_of_cells']:.2%} of them kept"]
    if facts["written"] == "nerfacc-grid":
        levels, cells, kept = facts["levels"], facts["resolution"], facts["kept_share_of_cells"]
        return [
            f"{out}: {levels} x {cells}^3 cells, {kept:.2%} of them kept",
            f"for OccGridEstimator({facts['aabbs'][0]}, {cells}, {levels})",
        ]
    counted = counts_in_words(facts)
    lines = [f"{out}: {counted}, in the coordinates of the {facts['frame']}"]
    splats = facts["written"] == "splat-init"
    if not facts["photograph_colours"]:
        shown = "grey" if splats else "o(x)"
        why = "no sparse points with colours; --data names a scene"
        lines.append(f"their colour is {shown}: {why}")
    if "geographic_origin" in facts:
        lines.append(f"its origin on earth: {facts['geographic_origin']}")
    if splats:
        command = f"ns-train splatfacto --data {shlex.quote(str(out))} leco-photographs"
        lines.append(f"start from it with: {command} (on a GPU)")
    if frame != facts["frame"] == "run":
        lines.append("the file does not say how its run moved the data: learn it anew to know")
    return lines


def shrink(
    file: Annotated[Path, tyro.conf.Positional],
    data: Path,
    out: Path,
    lost_surface_mass: float = 1e-3,
    image_price: float = 0.05,
    picture: Path | None = None,
    json: Path | None = None,
) -> None:
    """Find the smallest gate that decides as a frozen one does; measured on rays it never saw.

    Smaller gates are taught, from small to large, until one holds. Where the file lies in the
    folder of its run, the run's field, as it was at the moment of freezing and as it is now, says
    what a dropped candidate was worth; without one the loss is measured against what the original
    keeps.

    Args:
        file: An occupancy.safetensors, best where its run left it, or a folder of runs: the newest.
        data: The scene that it was learned on.
        out: File for the smaller occupancy.
        lost_surface_mass: Largest share of the weight near surfaces that it may lose, the
            original's loss included; without a run, of the original's decisions.
        image_price: Largest loss of PSNR in dB, the original's included.
        picture: File for a picture of the gates that were tried.
        json: File for the gates that were tried and the one that was chosen, as JSON; each is
            written when it was tried, so that a search that is stopped leaves those.
    """
    from leco_plugin.capacity.choice import draw_gates, summary
    from leco_plugin.capacity.references import Bounds
    from leco_plugin.capacity.shrink import shrink as find_smaller

    check_place("--json", json)
    check_picture("--picture", picture)
    file, bounds = occupancy_of(file), Bounds(lost_surface_mass, image_price)
    check_apart({"--out": out, "--picture": picture, "--json": json}, file, data)
    results = find_smaller(file, data, out, bounds, keep=lambda known: write_report(json, known))
    print("\n".join(summary(results, out)))
    write_report(json, results)
    if picture is not None:
        print(f"drew {draw_gates(results, picture)}")


def _check_apart(written: Mapping[str, Path | None], file: Path, data: Path | None) -> None:
    """`check_apart` of an occupancy and its scene `data`; None is that of the run it lies in."""
    if data is None and any(written.values()):
        from leco_plugin.scenes.coloured_points import description_of_run

        data = description_of_run(file)
    check_apart(written, file, data)


def _draw(occupancy: Occupancy, picture: Path, description: Path | None, dark: bool) -> None:
    """Draws an occupancy as a picture and as a page."""
    from leco_plugin.chart.theme import DARK, LIGHT
    from leco_plugin.evaluation.inspection import scene_colours
    from leco_plugin.evaluation.occupancy_page import write_page
    from leco_plugin.evaluation.occupancy_picture import draw

    colours = scene_colours(occupancy, description)
    print(f"drew {draw(occupancy, picture, colours=colours, theme=DARK if dark else LIGHT)}")
    page = write_page(occupancy, picture.with_suffix(PAGE), colours)
    print(f"drew {page}, to look around in with a browser")
    if colours is None:
        why = "no coloured sparse points are known (--data SCENE)"
        print(f"without the colours of photographs: {why}")


def _said(value: bool | float | str) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return str(value) if isinstance(value, str | int) else f"{value:.4g}"
