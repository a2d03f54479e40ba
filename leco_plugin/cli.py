"""The command `leco`: main, and the subcommands that make a scene or train on one.

Each subcommand imports what it needs inside, so that help comes at once.
"""

from __future__ import annotations

import atexit
import gc
import io
import os
import shlex
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from inspect import signature
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Literal

import tyro

from leco_plugin.cli_experiments import capacity, chart, check, stability
from leco_plugin.cli_occupancy import export, inspect, shrink
from leco_plugin.names import is_like, options_in, unknown_name
from leco_plugin.scenes.input_error import one_line
from leco_plugin.scenes.whole_files import check_report, write_report

BAD_INPUT, FAILURE, STOPPED, UNREAD = 2, 1, 130, 141
"""Statuses; the last two are those of a shell after SIGINT and SIGPIPE."""
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

    A killed run resumes when the same command is typed again.

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
    check_report(json, out)
    from leco_plugin.scenes.city.city import City, CityConfig
    from leco_plugin.scenes.city.folder import CaptureConfig, count_pictures, write_city

    config = CityConfig(blocks, seed, block_size, sky=sky, far_terrain=far_terrain)
    capture = CaptureConfig(width, height, aerial_per_block=aerial_per_block)
    if aerial_only:
        capture = replace(capture, street_per_block=0.0)
    folder = write_city(config, out, capture, layout=format)
    images, test_images = count_pictures(folder)
    facts = {"format": 1, "layout": format, **asdict(config), "images": images}
    facts |= {"test_images": test_images, "width": width, "height": height}
    print(f"{folder}: {images} pictures, {test_images} of them for testing")
    if images - test_images < FEW_PICTURES:
        print("those are few: with --aerial-per-block 40, PSNR differs less from seed to seed")
    command = _training(folder)
    if format == "mega-nerf":  # which has no sparse points to say where the ground is
        roof = City(config).roof
        levels = f"--ray-altitude-range {-1.3 * roof:.0f} {0.5 * roof:.0f}"
        command = f"{_training(folder, 'mega-nerf')} {levels}"
    print(f"train on it with: {command}")
    write_report(json, facts)


def poses(
    photos: Annotated[Path, tyro.conf.Positional],
    out: Path,
    lens: Literal["perspective", "fisheye"] = "perspective",
    size: int = 1600,
    threads: int = 0,
    json: Path | None = None,
) -> None:
    """Find where photographs were taken, and write them as a scene to train on.

    Runs COLMAP on the CPU, by pycolmap, which the extra `poses` installs. The scene is upright,
    and in metres where EXIF has GPS. A killed run resumes when the same command is typed again.

    Args:
        photos: Folder of the photographs, with those below it. They are only read.
        out: Folder of the scene: copies of the photographs, transforms.json, sparse points, and
            poses.json, which says which photographs were placed.
        lens: Kind of all lenses.
        size: Longest side in pixels at which features are looked for.
        threads: Of the CPU. 0 takes all.
        json: Another file for poses.json.
    """
    check_report(json, out)
    from leco_plugin.scenes.poses.command import make_scene, summary

    report = make_scene(photos, out, lens, size, threads)
    print("\n".join(summary(report)))
    print(f"train on it with: {_training(out)}")
    write_report(json, report)


def rays(
    records: Annotated[Path, tyro.conf.Positional],
    out: Path,
    json: Path | None = None,
) -> None:
    """Write Block-NeRF's records, which have a ray for each pixel, as a scene to train on.

    Fits a lens to the rays of each camera and a pose to those of each picture, and says how far
    they are off. Moving things, which the records of validation pictures mark, are not left out. A
    killed run resumes when the same command is typed again.

    Args:
        records: Folder of the records, *train.tfrecord* and *validation.tfrecord*, compressed with
            gzip. The latter are for testing.
        out: Folder of the scene: pictures and transforms.json.
        json: File for what was fitted, as JSON.
    """
    check_report(json, out)
    from leco_plugin.scenes.block_nerf import make_scene, summary

    report = make_scene(records, out)
    print("\n".join(summary(report)))
    print(f"find its surfaces with: {shlex.join(['leco', 'points', str(out)])}")
    print(f"train on it with: {_training(out)}")
    write_report(json, report)


def points(
    data: Annotated[Path, tyro.conf.Positional],
    size: int = 1600,
    threads: int = 0,
    json: Path | None = None,
) -> None:
    """Give a scene that has poses and no sparse points some, which say where its surfaces lie.

    Runs COLMAP on the CPU, by pycolmap, which the extra `poses` installs, from the poses and
    lenses of the scene, which stay as they are. Writes leco_points.ply into the scene and names it
    in transforms.json. The file as it was stays beside it as transforms.before_points.json. Of
    another file, NAME.json, all that is written begins with its name.

    Args:
        data: Scene in nerfstudio's format. Its photographs are only read; those for tests are not.
        size: Longest side in pixels at which features are looked for.
        threads: Of the CPU. 0 takes all.
        json: File for what was found, as JSON.
    """
    check_report(json, data)
    from leco_plugin.scenes.poses.points import find_points

    report = find_points(data, size, threads)
    if report["done"]:
        print(f"{report['points']} points of {report['photographs']} photographs: {report['file']}")
        print(f"train on it with: {_training(data)}")
    else:
        print(f"{data} has {report['points']} sparse points already: nothing is done")
    write_report(json, report)


def swap(
    method: Annotated[str, tyro.conf.Positional],
    occupancy: Path | None = None,
    arguments: Annotated[tuple[str, ...], tyro.conf.Positional] = (),
    sampler: str = "learned-occupancy",
    options: Mapping[str, int | float] = MappingProxyType({}),
    codes: Literal["small", "own"] = "small",
    other_scene: bool = False,
    learn_seconds: float | None = None,
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
        other_scene: Train also where the occupancy is of another scene, as far as its cameras say.
        learn_seconds: Time, about, that learning an occupancy may take; it comes before the
            method's own steps. By default 200 steps, 2,000 on a GPU, and more where the gate has
            not settled.
        json: File for the folder of the run, as JSON.
    """
    from nerfstudio.scripts.train import main as train

    from leco_plugin.hosts.guided_start import occupancy_file
    from leco_plugin.swap import swapped_config

    check_report(json, occupancy and occupancy_file(occupancy))
    config = swapped_config(
        method, occupancy, arguments, sampler, options, codes, other_scene, learn_seconds
    )
    train(config)
    folder = config.get_base_dir()
    print(f"{method}, guided: {folder}")
    facts = {"method": method, "sampler": sampler, "options": dict(options), "codes": codes}
    write_report(json, {"format": 1, **facts, "folder": str(folder)})


def demo(
    out: Path | None = None,
    seconds: float | None = None,
    quick: bool = False,
    json: Path | None = None,
) -> None:
    """Learn the occupancy of a small city, go on guided, and compare with never freezing.

    Writes report.json, chart.png, picture.png and occupancy.safetensors. About five minutes on two
    CPU cores.

    Args:
        out: Folder for everything. By default runs/demo, or runs/demo-quick.
        seconds: Training time of each of the two runs. By default 130, or 15 if quick.
        quick: One block in small pictures: shows that an installation works. Its figures mean
            nothing.
        json: Another file for the report.
    """
    began = time.monotonic()
    from leco_plugin.demo import run_demo, summary

    out = out or Path("runs/demo-quick" if quick else "runs/demo")
    check_report(json, out)
    report = run_demo(out, seconds, quick, began)
    print("\n".join(summary(report)))
    print(f"see report.json, chart.png and picture.png in {out}")
    write_report(json, report)


def _training(data: Path, *reader: str) -> str:
    """The command that trains on a scene."""
    return shlex.join(["ns-train", "leco-occupancy", *reader, "--data", str(data)])


LISTED = (
    *(city, poses, rays, points, inspect, export, shrink, capacity),
    *(swap, demo, chart, stability, check),
)
COMMANDS: dict[str, Callable[..., None]] = {command.__name__: command for command in LISTED}


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs `leco`: 0, or one line on stderr and 2 for bad input, 1 for a failure. A command line
    that says nothing which could be run is a SystemExit of 2, as tyro has it."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    about = "Learned occupancy for nerfstudio: what is empty is skipped."
    atexit.register(gc.freeze)  # else a command searches all that it imported for cycles: seconds
    if isinstance(sys.stdout, io.TextIOWrapper):  # names of files need not be UTF-8
        sys.stdout.reconfigure(errors="backslashreplace")
    if given and given[0][:1] != "-" and given[0] not in COMMANDS:
        sys.exit(_complain(ValueError(unknown_name("command", given[0], COMMANDS)), BAD_INPUT))
    if given[:1] == ["swap"] and _is_meant_for_training(given[1:]):
        print(SEPARATE, file=sys.stderr)
        sys.exit(BAD_INPUT)
    try:
        with _plain_warnings():
            tyro.extras.subcommand_cli_from_dict(
                COMMANDS, prog="leco", description=about, args=given
            )
        sys.stdout.flush()
    except BrokenPipeError:  # nobody reads on, as behind `| head`; nor what is still to be written
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return UNREAD
    except (ValueError, OSError) as error:
        return _complain(error, BAD_INPUT)
    except (RuntimeError, FloatingPointError, ImportError) as error:
        return _complain(error, FAILURE)
    except KeyboardInterrupt:
        print("leco: stopped; what had been stored stays", file=sys.stderr)
        return STOPPED
    return 0


def _is_meant_for_training(words: Sequence[str]) -> bool:
    """Whether words after `leco swap` hold an option of ns-train before any `--`: one that neither
    is an option of `leco swap` nor resembles one."""
    own = ["--help"]
    for name in signature(swap).parameters:
        option = name.replace("_", "-")
        own += [f"--{option}", f"--no-{option}"]
    before = words[: words.index("--")] if "--" in words else words
    return any(not is_like(option, own) for option in options_in(before))


@contextmanager
def _plain_warnings() -> Iterator[None]:
    """While it lasts, a warning is one line, without its place in the code."""
    before = warnings.formatwarning
    warnings.formatwarning = lambda message, *_, **__: f"leco: {' '.join(str(message).split())}\n"
    try:
        with warnings.catch_warnings():
            # what nerfstudio and torch think of each other is nothing that a user can act on
            warnings.filterwarnings("ignore", module=r"nerfstudio|torch")
            yield
    finally:
        warnings.formatwarning = before


def _complain(error: BaseException, status: int) -> int:
    print(f"leco: {one_line(error) or type(error).__name__}", file=sys.stderr)
    return status
