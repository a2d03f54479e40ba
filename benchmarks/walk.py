"""The walk of the tutorial, typed for you: `python benchmarks/walk.py PHOTOS FOLDER`.

From a folder of photographs to poses, a model, a film, figures, a picture and files for others.
What each command prints lies in FOLDER; README and pages quote it from `results/walk.json`.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import checkout  # noqa: F401
from page_parts import RESULTS, between

from leco_plugin.evaluation.report import describe_code, describe_machine, made_by
from leco_plugin.occupancy import CAMERAS_THAT_VOUCH, Occupancy
from leco_plugin.scenes.whole_files import write_json

WALK = RESULTS / "walk.json"
COMMANDS = {
    "poses": "leco poses photos --out SCENE",
    "train": "ns-train leco-occupancy --data SCENE --viewer.quit-on-train-completion True",
    "film": "ns-render interpolate --load-config RUN/config.yml --output-path film "
    "--output-format images --downscale-factor 4",
    "inspect": "leco inspect RUN --picture occupancy.png",
    "eval": "ns-eval --load-config RUN/config.yml --output-path eval.json",
    "export": "leco export RUN --out export",
}
"""As the tutorial has them; a walk ends the viewer with the training."""
SHOWN = ("poses", "train", "export")
"""Commands whose lines pages quote; the others print paths of the machine."""
NOISE = re.compile(r"/|\s+warnings\.|\[|=|finding |comparing |placing |real|user|sys|\s*$")
"""Lines of progress, of other packages, and of the shell."""
REAL = re.compile(r"^real (\d+)", re.MULTILINE)
"""The seconds of a command, at the end of its log."""
PROGRESS, SHOWN_AT = re.compile(r"Training: (\d+)%"), 25
"""Of lines on the training the one nearest to this share is shown."""
QUOTED = ("are placed", "finished:")
"""What README shows of it."""
VOUCHED = re.compile(r"(\d+) photographs that taught it nothing")


def walk(photos: Path, folder: Path) -> None:
    """Types all commands in a folder, where each leaves what it prints and its seconds."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "photos").symlink_to(photos.resolve())
    for name, command in COMMANDS.items():
        runs = sorted(folder.glob("outputs/SCENE/leco-occupancy/*/config.yml"))
        typed = command.replace("RUN", str(runs[-1].parent.relative_to(folder)) if runs else "RUN")
        print(typed, flush=True)
        began = time.monotonic()
        with (folder / f"{name}.log").open("w") as log:
            ended = subprocess.run(typed.split(), cwd=folder, stdout=log, stderr=log)
            print(f"real {time.monotonic() - began:.0f}", file=log)
        if ended.returncode:
            raise SystemExit(f"{typed} ended with {ended.returncode}: see {folder / name}.log")


def report_of(folder: Path, known: dict[str, Any]) -> dict[str, Any]:
    """What a walk printed, how long it took, and what its occupancy says; `known` is of before."""
    run = sorted(folder.glob("outputs/SCENE/leco-occupancy/*/occupancy.safetensors"))[-1]
    said = Occupancy.load(run).report
    results = json.loads((folder / "eval.json").read_text())["results"]
    logs = {name: (folder / f"{name}.log").read_text() for name in COMMANDS}
    return {
        "format": 1,
        "machine": describe_machine(),
        **made_by(describe_code()),
        "seconds": {name: int(REAL.findall(log)[-1]) for name, log in logs.items()},
        "lines": {name: lines_of(logs[name]) for name in SHOWN},
        "costs": {
            "empty_fraction": said["empty_fraction"],
            "lost_surface_mass": said["lost_surface_mass"],
            "worst_surface_mass": said[CAMERAS_THAT_VOUCH]["worst_surface_mass"],
        },
        "eval": {name: results[name] for name in ("psnr", "ssim", "flip")},
        "other_runs": known.get("other_runs", []),
    }


def lines_of(log: str) -> list[str]:
    """What a command of ours printed, with one line on its progress."""
    lines = [line for line in log.splitlines() if not NOISE.match(line)]
    shares = {line: int(found[1]) for line in lines if (found := PROGRESS.match(line))}
    shown = min(shares, key=lambda line: abs(shares[line] - SHOWN_AT), default=None)
    lines = [line for line in lines if line not in shares or line == shown]
    return lines[: lines.index("next:")] if "next:" in lines else lines


def block(lines: list[str]) -> str:
    """Lines as a page shows them."""
    return "\n".join(["```", *lines, "```"])


def marks(name: str) -> tuple[str, str]:
    """Between which a page shows a part of the walk."""
    return f"<!-- {name} of the walk: generated -->", f"<!-- end of {name} -->"


def quote(report: dict[str, Any]) -> str:
    """README's part: some lines, and what skipping costs."""
    lines = [line for part in report["lines"].values() for line in part]
    chosen = [line for line in lines if any(some in line for some in QUOTED)]
    costs, others = report["costs"], report["other_runs"]
    minutes = sum(report["seconds"][name] for name in ("poses", "train", "film")) / 60.0
    vouched = [found[1] for line in lines if (found := VOUCHED.match(line))]
    photographs = " ".join([*vouched[-1:], "photographs"])
    worst = [one["worst_surface_mass"] for one in (costs, *others)]
    return "\n".join(
        [
            block(chosen),
            "",
            f"All three took {minutes:.0f} minutes on two CPU cores. At the end "
            f"{costs['empty_fraction']:.0%} of all places on rays are skipped. The gates of this "
            f"run hide {costs['lost_surface_mass']:.2%} of the surfaces in held-out pixels. Of "
            f"{photographs} that taught them nothing, the worst lost {worst[0]:.2%}"
            + "".join(f" ({other:.2%} in another run)" for other in worst[1:])
            + ".",
        ]
    )


def with_walk(text: str, names: tuple[str, ...]) -> str:
    """A page with its parts of the walk renewed."""
    report = json.loads(WALK.read_text())
    for name in names:
        if name == "lines":
            body = quote(report)
        elif name == "learned":
            body = block([s for s in report["lines"]["train"] if s.startswith("occupancy learned")])
        else:
            body = block(report["lines"][name])
        text = between(text, marks(name), body)
    return text


if __name__ == "__main__":
    given = [Path(one) for one in sys.argv[1:]]
    if len(given) != 2:
        raise SystemExit(__doc__)
    walk(*given)
    before = json.loads(WALK.read_text()) if WALK.exists() else {}
    write_json(WALK, report_of(given[1], before))
