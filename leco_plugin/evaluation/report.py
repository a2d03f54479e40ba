"""Reports on disk: strict JSON with the machine and the code that measured."""

from __future__ import annotations

import datetime
import hashlib
import json
import math
import os
import platform
import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from leco_plugin.scenes.input_error import InputError

PACKAGE = Path(__file__).resolve().parents[1]


def read_object(file: Path, else_say: str) -> dict[str, Any]:
    """The JSON object in a file; of a damaged one an `InputError` says its name and `else_say`."""
    try:
        found = json.loads(file.read_text())
    except ValueError:  # no JSON, or no text
        found = None
    if not isinstance(found, dict):
        raise InputError(f"{file} {else_say}")
    return found


def finite_or_null(values: dict[str, Any]) -> dict[str, Any]:
    """The values with None in place of NaN and infinity, which are no JSON."""
    return {
        name: None if isinstance(value, float) and not math.isfinite(value) else value
        for name, value in values.items()
    }


def describe_machine() -> dict[str, Any]:
    """Processor, cores, threads, device and versions: JSON values, without names or paths."""
    import torch

    return {
        "cpu": processor_name(),
        "cores": usable_cores(),
        "threads": torch.get_num_threads(),
        "device": torch.cuda.get_device_name() if torch.cuda.is_available() else "cpu",
        "system": platform.system(),
        "python": platform.python_version(),
        "torch": torch.__version__,
    }


def describe_cores(machine: Mapping[str, Any]) -> str:
    """The CPU cores that a run used, in words: as many as its threads, if there are
    so many."""
    cores = min(machine["cores"], machine["threads"])
    return "one CPU core" if cores == 1 else f"{cores} CPU cores"


def describe_code() -> dict[str, Any]:
    """Version of this package, the commit if it is run from a checkout, and a digest of its files,
    which shows uncommitted changes. To be called before a measurement."""
    from leco_plugin import __version__

    command = ["git", "-C", str(PACKAGE), "rev-parse", "--short=12", "HEAD"]
    try:
        asked = subprocess.run(command, capture_output=True, text=True, check=False)
        # an installed package may lie inside another project's checkout
        commit = asked.stdout.strip() if (PACKAGE.parent / ".git").exists() else ""
    except OSError:
        commit = ""
    return {"version": __version__, "commit": commit or None, "sources": digest_of_sources(PACKAGE)}


def made_by(code: dict[str, Any]) -> dict[str, Any]:
    """What made a stored figure, and today's date. `code` is from before the measurement."""
    return {"code": code, "date": datetime.date.today().isoformat()}


def digest_of_sources(*folders: Path) -> str:
    """A digest of the names and contents of the Python files in folders."""
    digest = hashlib.sha256()
    for folder in folders:
        for path in sorted(folder.rglob("*.py")):
            digest.update(path.relative_to(folder).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()[:12]


def usable_cores() -> int:
    """Cores that this process may use, which in a container can be fewer than there are."""
    return len(os.sched_getaffinity(0))


def processor_name() -> str:
    """The processor's model where the system tells it, else its architecture; and the widest vector
    instructions that torch uses on it. Where models are masked, these alone tell a core from one
    that takes twice the time."""
    import torch

    name = platform.processor() or platform.machine()
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                name = line.partition(":")[2].strip()
                break
    except OSError:
        pass
    return f"{name} ({torch.backends.cpu.get_cpu_capability()})"
