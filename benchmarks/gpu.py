"""The GPU suite: `PYTHONPATH=. python benchmarks/gpu.py`, at most ten minutes, with a CUDA device.

Correctness first, then times with device events, and the card's own ceilings in the same run. A
part that is in the results file already is not run again, so that a run that was cut off goes on.
`--dry-run` does all of it at tiny sizes on any machine, and stores nothing in the results folder.
"""

from __future__ import annotations

import argparse
import datetime
import hashlib
import json
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import torch
from gpu_parts import correctness, experts, gate_throughput
from gpu_sampling import sampling
from gpu_scale import Scale
from gpu_training import dense, learned

from leco_plugin.evaluation.json_file import write_json
from leco_plugin.evaluation.machine import describe_code, describe_machine

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
    "learned": Part(learned, 170.0),
    "dense": Part(dense, 170.0),
}
"""In the order in which they run."""


def driver() -> str | None:
    """Version of the card's driver, where its tool tells."""
    if shutil.which("nvidia-smi") is None:
        return None
    command = ["nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"]
    answered = subprocess.run(command, capture_output=True, text=True, check=False)
    return next(iter(answered.stdout.split()), None)


def code() -> dict[str, Any]:
    """What was measured: a commit does not tell of a kernel that was changed since."""
    digest = hashlib.sha256()
    for folder in ("benchmarks", "leco_plugin"):
        for path in sorted((ROOT / folder).rglob("*.py")):
            digest.update(path.read_bytes())
    return {**describe_code(), "sources": digest.hexdigest()[:12]}


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
    """All parts that `out` does not hold yet; it is renewed after each."""
    about = {**describe_machine(), "driver": driver(), "cuda": torch.version.cuda}
    results = {"format": 1, "dry": dry, "machine": about, "code": code(), "parts": {}}
    results["parts"] = stored_parts(out, results)
    started = time.perf_counter()
    for name, part in PARTS.items():
        if name in results["parts"]:
            continue
        if not dry and time.perf_counter() - started > LIMIT - part.seconds:
            print(f"{name} is left for the next run: the ten minutes are over", file=sys.stderr)
            break
        results["parts"][name] = measured = part.measure(scale, results["parts"])
        for figure in measured.get("figures", []):
            sign = "<=" if figure["at_most"] else ">="
            verdict = "reached" if figure["reached"] else "NOT REACHED"
            print(f"{figure['name']}: {figure['value']:.3g} ({sign} {figure['bar']}) {verdict}")
        missing = [kernel for kernel, runs in measured.get("running", {}).items() if not runs]
        if missing and not dry:
            print(f"{name}: torch answered in place of the fused {', '.join(missing)}")
        if out is not None:
            write_json(out, results)
    return results


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
    """The command; exits 2 where there is no CUDA device."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--dry-run", action="store_true", help="tiny sizes, any machine")
    parser.add_argument("--out", type=Path, help="results file")
    options = parser.parse_args(arguments)
    if options.dry_run:
        device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        if options.out is not None and options.out.resolve().is_relative_to(RESULTS):
            parser.error("a dry run leaves nothing among the results: give another --out")
        run(Scale(device).dry(), options.out, dry=True)
        print("dry run: every part ran; its figures mean nothing")
        return 0
    if not torch.cuda.is_available():
        print("no CUDA device here: nothing is measured; try --dry-run", file=sys.stderr)
        return 2
    run(Scale(torch.device("cuda")), options.out or results_path(), dry=False)  # CUDA only
    return 0  # CUDA only


if __name__ == "__main__":
    sys.exit(main())
