"""The GPU suite: `PYTHONPATH=. python benchmarks/gpu.py`, at most ten minutes, with a CUDA device.

Correctness first, then times with device events, and the card's own ceilings in the same run. A
part that is in the results file already is not run again, so that a run that was cut off goes on.
`--dry-run` does all of it at tiny sizes on any machine, and stores nothing in the results folder.
"""

from __future__ import annotations

import argparse
import datetime
import json
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import torch
from gpu_parts import PARTS, Scale

from leco_plugin.evaluation.json_file import write_json
from leco_plugin.evaluation.machine import describe_code, describe_machine

RESULTS = Path(__file__).resolve().parent / "results"
LIMIT = 600.0
"""Seconds after which no further part is begun."""


def driver() -> str | None:
    """Version of the card's driver, where its tool tells."""
    if shutil.which("nvidia-smi") is None:
        return None
    command = ["nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"]
    answered = subprocess.run(command, capture_output=True, text=True, check=False)
    return next(iter(answered.stdout.split()), None)


def results_path() -> Path:
    """Where this card's results of today belong."""
    name = re.sub(r"[^a-z0-9]+", "-", torch.cuda.get_device_name().lower()).strip("-")
    return RESULTS / f"gpu-{name}-{datetime.date.today():%Y%m%d}.json"


def run(scale: Scale, out: Path | None) -> dict[str, Any]:
    """All parts that `out` does not hold yet; it is renewed after each."""
    stored = json.loads(out.read_text()) if out is not None and out.exists() else {"parts": {}}
    about = {**describe_machine(), "driver": driver(), "cuda": torch.version.cuda}
    results = {"format": 1, "machine": about, "code": describe_code(), "parts": stored["parts"]}
    started = time.perf_counter()
    for name, part in PARTS.items():
        if name in results["parts"]:
            continue
        if time.perf_counter() - started > LIMIT:
            print(f"{name} is left for the next run: ten minutes are over", file=sys.stderr)
            break
        results["parts"][name] = part(scale)
        for figure in results["parts"][name].get("figures", []):
            sign = "<=" if figure["at_most"] else ">="
            verdict = "reached" if figure["reached"] else "NOT REACHED"
            print(f"{figure['name']}: {figure['value']:.3g} ({sign} {figure['bar']}) {verdict}")
        if out is not None:
            write_json(out, results)
    return results


def main(arguments: list[str] | None = None) -> int:
    """The command; exits 2 where there is no CUDA device."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--dry-run", action="store_true", help="tiny sizes, any machine")
    parser.add_argument("--out", type=Path, help="results file")
    options = parser.parse_args(arguments)
    if options.dry_run:
        device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        run(Scale(device).dry(), options.out)
        print("dry run: every part ran; its figures mean nothing")
        return 0
    if not torch.cuda.is_available():
        print("no CUDA device here: nothing is measured; try --dry-run", file=sys.stderr)
        return 2
    run(Scale(torch.device("cuda")), options.out or results_path())
    return 0


if __name__ == "__main__":
    sys.exit(main())
