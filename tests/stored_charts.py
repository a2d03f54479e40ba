"""Modules of the benchmarks that read stored charts, in a folder in which none is stored yet."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parent.parent


def reading(name: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """A module, fresh, that finds charts in `charts` of a folder, titles and notes beside it."""
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    for one in {"chart_sections", name}:
        monkeypatch.delitem(sys.modules, one, raising=False)
    charts = importlib.import_module("chart_sections")
    monkeypatch.setattr(charts, "RESULTS", folder)
    monkeypatch.setattr(charts, "CHARTS", folder / "charts")
    (folder / "charts.json").write_text("{}")
    (folder / "charts").mkdir()
    return importlib.import_module(name)
