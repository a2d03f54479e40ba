"""The GPU suite: `python benchmarks/gpu.py`, at most ten minutes, with a CUDA device.

Correctness first, then times with device events, and the card's own ceilings in the same run. A
part that is in the results file already is not run again, so that a run that was cut off goes on.
`--dry-run` does all of it at tiny sizes on any machine, and stores nothing in the results folder.
"""

from __future__ import annotations

import argparse
import datetime
import importlib.metadata
import json
import logging
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import checkout  # noqa: F401
import torch
from gpu_parts import Disagreement, correctness, experts, gate_throughput
from gpu_sampling import sampling
from gpu_scale import Scale
from gpu_training import train_dense, train_guided

from leco_plugin.evaluation.report import (
    describe_code,
    describe_machine,
    digest_of_sources,
)
from leco_plugin.scenes.whole_files import write_json

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "benchmarks" / "results"
LIMIT = 600.0
"""Seconds that a run may take."""


class Part(NamedTuple):
    """One thing that the suite measures."""

    measure: Callable[[Scale, dict[str, Any]], dict[str, Any]]
    """From the scale and the parts before it to JSON values."""
    seconds: float
    """What it may take; it is not begun with less time left."""


PARTS = {
    "correctness": Part(correctness, 120.0),
    "gate": Part(gate_throughput, 40.0),
    "sampling": Part(sampling, 70.0),
    "experts": Part(experts, 20.0),
    "learned": Part(train_guided, 170.0),
    "dense": Part(train_dense, 170.0),
}
"""In the order in which they run."""


def driver() -> str | None:
    """Version of the card's driver, where its tool tells."""
    if shutil.which("nvidia-smi") is None:
        return None
    command = ["nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"]
    answered = subprocess.run(command, capture_output=True, text=True, check=False)
    found = answered.stdout.split() if answered.returncode == 0 else []
    return next(iter(found), None)


def machine() -> dict[str, Any]:
    """What figures depend on: the computer, its card and driver, and what compiles for the card."""
    found = {**describe_machine(), "driver": driver(), "cuda": torch.version.cuda}
    try:
        found["triton"] = importlib.metadata.version("triton")
    except importlib.metadata.PackageNotFoundError:
        found["triton"] = None
    return found


def code() -> dict[str, Any]:
    """What was measured: a commit does not tell of a kernel that was changed since."""
    folders = (ROOT / "benchmarks", ROOT / "leco_plugin")
    return {**describe_code(), "sources": digest_of_sources(*folders)}


def results_path() -> Path:
    """Where this card's results belong: beside those of today, or where a run was cut off."""
    name = re.sub(r"[^a-z0-9]+", "-", torch.cuda.get_device_name().lower()).strip("-")
    earlier = [path for path in RESULTS.glob(f"gpu-{name}-*.json") if is_unfinished(path)]
    today = RESULTS / f"gpu-{name}-{datetime.date.today():%Y%m%d}.json"
    return max(earlier, default=today)


def is_unfinished(path: Path) -> bool:
    """Whether a file holds some parts only, of the code that is here."""
    try:
        stored = json.loads(path.read_text())
        return stored["code"] == code() and set(stored["parts"]) < set(PARTS)
    except (ValueError, KeyError, TypeError):
        return False


def run(scale: Scale, out: Path | None, dry: bool) -> dict[str, Any]:
    """All parts that `out` does not hold yet; it is renewed after each.

    Raises:
        Disagreement: a kernel answers otherwise than its twin.
    """
    results: dict[str, Any] = {"format": 1, "dry": dry, "date": f"{datetime.date.today()}"}
    results |= {"machine": machine(), "code": code(), "parts": {}}
    parts = results["parts"] = stored_parts(out, results)
    started = time.perf_counter()
    for name, part in PARTS.items():
        if name in parts:
            print(f"{name}: measured before")
            continue
        if not dry and time.perf_counter() - started > LIMIT - part.seconds:
            print(
                f"{name} is left for the next run, for the ten minutes are over: "
                "the same command goes on from here",
                file=sys.stderr,
            )
            break
        print(f"{name} ...", flush=True)
        begun = time.perf_counter()
        parts[name] = measured = measure(part, scale, parts)
        measured["wall_seconds"] = round(time.perf_counter() - begun, 1)
        tell(name, measured, dry)
        if out is not None:
            write_json(out, results)
    return results


def measure(part: Part, scale: Scale, before: dict[str, Any]) -> dict[str, Any]:
    """What a part finds, or that the card has too little memory for it."""
    try:
        return part.measure(scale, before)
    except torch.cuda.OutOfMemoryError as error:
        return {"left_out": next(iter(str(error).splitlines()), "out of memory")}


def tell(name: str, measured: dict[str, Any], dry: bool) -> None:
    """Prints what a part has found; of a dry run only that it ran."""
    if reason := measured.get("left_out"):
        print(f"{name}: LEFT OUT, {reason}")
        return
    print(f"{name}: {measured['wall_seconds']} s")
    if dry:
        return
    for figure in measured.get("figures", []):
        sign = "<=" if figure["at_most"] else ">="
        verdict = "reached" if figure["reached"] else "NOT REACHED"
        print(f"  {figure['name']}: {figure['value']:.3g} ({sign} {figure['bar']}) {verdict}")
    missing = [kernel for kernel, runs in measured.get("running", {}).items() if not runs]
    if missing:
        print(f"  torch answered in place of the fused {'; '.join(missing)}")


def stored_parts(out: Path | None, results: dict[str, Any]) -> dict[str, Any]:
    """Parts of an earlier run that was cut off, if it ran the same code on the same machine."""
    if out is None or not out.exists():
        return {}
    try:
        stored = json.loads(out.read_text())
        if all(stored[name] == results[name] for name in ("format", "dry", "machine", "code")):
            return dict(stored["parts"])
        print(f"{out.name} is of another machine or other code: everything is measured anew")
    except (ValueError, KeyError, TypeError):
        print(f"{out.name} holds no results: everything is measured anew")
    return {}


def main(arguments: list[str] | None = None) -> int:
    """The command; exits 1 where a kernel is wrong, 2 where nothing can be measured."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--dry-run", action="store_true", help="tiny sizes, any machine")
    parser.add_argument(
        "--out", type=Path, help="results file; without it one of this card in benchmarks/results"
    )
    options = parser.parse_args(arguments)
    logging.basicConfig(format="  %(message)s")
    logging.getLogger("leco_plugin").setLevel(logging.INFO)  # why torch answers is among it
    if options.dry_run:
        device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        if options.out is not None and options.out.resolve().is_relative_to(RESULTS):
            parser.error("a dry run leaves nothing among the results: give another --out")
        return run_suite(Scale(device).dry(), options.out, dry=True)
    if not torch.cuda.is_available():
        print(
            f"no CUDA device here for torch {torch.__version__}: nothing is measured; --dry-run "
            "runs on any machine",
            file=sys.stderr,
        )
        return 2
    if options.out is None and driver() is None:
        print(
            "nvidia-smi does not tell the driver's version, without which results are not shown: "
            "nothing is measured; put it on the PATH, or measure for yourself with --out FILE",
            file=sys.stderr,
        )
        return 2
    return run_suite(Scale(torch.device("cuda")), options.out or results_path(), dry=False)


def run_suite(scale: Scale, out: Path | None, dry: bool) -> int:
    """Runs the suite, and says where its results are and what becomes of them."""
    try:
        results = run(scale, out, dry)
    except Disagreement as error:
        print(f"{error}: figures of a wrong kernel are not measured", file=sys.stderr)
        return 1
    where = "" if out is None else f"; they are in {out}"
    if dry:
        print(f"dry run: every part ran; its figures mean nothing{where}")
    elif len(results["parts"]) == len(PARTS):
        print(f"all parts are measured{where}; docs/gpu.md says how to add them to the results")
    return 0


if __name__ == "__main__":
    sys.exit(main())
