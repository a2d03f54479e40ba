"""The command `leco`. What a subcommand needs is imported inside it, so that help comes at once."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any

import tyro

BAD_INPUT, FAILURE = 2, 1


def city(out: Path, blocks: int = 3, seed: int = 0, json: Path | None = None) -> None:
    """Write the procedural city as a nerfstudio scene, with its exact geometry.

    Args:
        out: Folder to write. If it holds just this city, nothing is done.
        blocks: The city covers blocks x blocks blocks.
        seed: Another seed, another city.
        json: File for what was written, as JSON.
    """
    from leco_plugin.scenes.city import CityConfig
    from leco_plugin.scenes.city_folder import read_transforms, write_city

    folder = write_city(CityConfig(blocks, seed), out)
    transforms = read_transforms(folder)
    facts = {
        "format": 1,
        "blocks": blocks,
        "seed": seed,
        "images": len(transforms["frames"]),
        "test_images": len(transforms["test_filenames"]),
        "width": transforms["w"],
        "height": transforms["h"],
    }
    print(f"{folder}: {facts['images']} pictures, {facts['test_images']} of them for testing")
    print(f"train on it with: ns-train leco-occupancy --data {folder}")
    _write_json(json, facts)


def inspect(
    file: Annotated[Path, tyro.conf.Positional],
    picture: Path | None = None,
    json: Path | None = None,
) -> None:
    """Say what an occupancy is: sizes, threshold, price and gain; and draw it.

    Args:
        file: An occupancy.safetensors, as a run of leco-occupancy leaves it in its folder.
        picture: File for a picture: slices of o(x) with the cameras, and the kept points.
        json: File for the same as JSON.
    """
    from leco_plugin.evaluation.inspection import describe
    from leco_plugin.occupancy import Occupancy

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
            print(
                f"{name.replace('_', ' ')}: {value if isinstance(value, str) else f'{value:.4g}'}"
            )
    if picture is not None:
        from leco_plugin.evaluation.occupancy_picture import draw

        picture.parent.mkdir(parents=True, exist_ok=True)
        print(f"drew {draw(occupancy, picture)}")
    _write_json(json, facts)


def swap(
    method: Annotated[str, tyro.conf.Positional],
    occupancy: Path,
    arguments: Annotated[tuple[str, ...], tyro.conf.Positional] = (),
    sampler: str = "learned-occupancy",
    json: Path | None = None,
) -> None:
    """Train any registered nerfstudio method with its sampler swapped for a learned occupancy.

    The run folder opens with every ns-* command as it is.

    Args:
        method: As ns-train knows it: instant-ngp, nerfacto, or of another plugin.
        occupancy: An occupancy.safetensors, or the folder of a run that left one.
        arguments: After --, what ns-train would be given for this method: -- --data DIR ...
        sampler: Of this package or of another, in place of the method's own.
        json: File for the folder of the run, as JSON.
    """
    from leco_plugin.swap import swap as train_swapped

    _check_json(json)
    folder = train_swapped(method, occupancy, arguments, sampler)
    print(f"{method}, guided: {folder}")
    facts = {"format": 1, "method": method, "sampler": sampler, "folder": str(folder)}
    _write_json(json, facts)


def demo(out: Path = Path("runs/demo"), seconds: float = 110.0, json: Path | None = None) -> None:
    """Learn the occupancy of a small city, go on guided, and compare with never freezing.

    Writes report.json, chart.png, picture.png and occupancy.safetensors. Under six minutes on two
    CPU cores.

    Args:
        out: Folder for everything.
        seconds: Training time of each of the two runs.
        json: Another file for the report.
    """
    import warnings

    # what nerfstudio and torch think of each other is nothing that a user can act on
    warnings.filterwarnings("ignore", module=r"nerfstudio|torch")
    from leco_plugin.demo import run_demo, summary

    _check_json(json)
    report = run_demo(out, seconds)
    print("\n".join(summary(report)))
    print(f"see report.json, chart.png and picture.png in {out}")
    _write_json(json, report)


def check(name: Annotated[str, tyro.conf.Positional], json: Path | None = None) -> None:
    """Hold a sampler to the rules that hosts rely on, one line a rule.

    Args:
        name: A registered sampler, of this package or of another.
        json: File for the verdicts as JSON.
    """
    from leco_plugin.conformance.checking import check_sampler

    verdicts = []
    for verdict in check_sampler(name):
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
    "swap": swap,
    "demo": demo,
    "check": check,
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs `leco`: 0, or one line on stderr and 2 for bad input, 1 for a failure."""
    try:
        tyro.extras.subcommand_cli_from_dict(
            COMMANDS,
            prog="leco",
            description="Learned occupancy for nerfstudio: what is empty is skipped.",
            args=arguments,
        )
    except (ValueError, OSError) as error:  # InputError is both a ValueError and a SystemExit
        return _complain(error, BAD_INPUT)
    except (RuntimeError, FloatingPointError, ImportError) as error:
        return _complain(error, FAILURE)
    except KeyboardInterrupt:
        return 130
    return 0


def _complain(error: BaseException, status: int) -> int:
    message = " ".join(str(error).split()) or type(error).__name__
    print(f"leco: {message}", file=sys.stderr)
    return status


def _listed(values: Sequence[float]) -> str:
    return "(" + ", ".join(f"{value:.4g}" for value in values) + ")"


def _check_json(path: Path | None) -> None:
    """Before work that takes minutes, whether its report has a place."""
    if path is not None and path.is_dir():
        raise ValueError(f"--json {path} is a folder; give a file")


def _write_json(path: Path | None, value: Any) -> None:
    if path is not None:
        from leco_plugin.evaluation.json_file import write_json

        write_json(path, value)
