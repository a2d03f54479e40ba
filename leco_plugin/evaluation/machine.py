"""What a measurement was made on: the parts of a machine that figures depend on, and no more."""

from __future__ import annotations

import datetime
import hashlib
import os
import platform
from pathlib import Path
from typing import Any

PACKAGE = Path(__file__).resolve().parents[1]


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


def describe_code() -> dict[str, Any]:
    """Version of this package, the commit if it is run from a checkout, and a digest of its files,
    which also tells what was changed since that commit. To be asked before a measurement."""
    import subprocess

    from leco_plugin import __version__

    here = Path(__file__).resolve().parent
    command = ["git", "-C", str(here), "rev-parse", "--short=12", "HEAD"]
    try:
        asked = subprocess.run(command, capture_output=True, text=True, check=False)
        # an installed package may lie inside another project's checkout
        commit = asked.stdout.strip() if (here.parents[1] / ".git").exists() else ""
    except OSError:
        commit = ""
    return {"version": __version__, "commit": commit or None, "sources": digest_of_sources(PACKAGE)}


def made_by(code: dict[str, Any]) -> dict[str, Any]:
    """What a stored figure says of its making: the code as it was loaded, and today's date.

    Args:
        code: `describe_code()`, asked before anything was measured.
    """
    return {"code": code, "date": datetime.date.today().isoformat()}


def digest_of_sources(*folders: Path) -> str:
    """What tells the Python files of folders, by name and content, from others."""
    digest = hashlib.sha256()
    for folder in folders:
        for path in sorted(folder.rglob("*.py")):
            digest.update(path.relative_to(folder).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()[:12]


def usable_cores() -> int:
    """Cores that this process may run on, which in a container can be fewer than there are."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def processor_name() -> str:
    """The processor's model where the system tells it, else its architecture."""
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()
