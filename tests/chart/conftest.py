"""What all tests of this room share: nerfstudio's methods, and what is said of the code."""

from __future__ import annotations

import functools
import importlib
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest

from leco_plugin.chart import chart
from leco_plugin.evaluation.report import describe_code

# While they are imported, nerfstudio lists the whole stack 26 times, which takes seconds below
# pytest's hundred frames. A thread begins with a short stack.
with ThreadPoolExecutor(1) as pool:
    pool.submit(importlib.import_module, "nerfstudio.configs.method_configs").result()

known_code = functools.cache(describe_code)


@pytest.fixture(autouse=True)
def code_is_read_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """A chart reads every file of the package for each run that names no code."""

    def code() -> dict[str, Any]:
        return dict(known_code())

    monkeypatch.setattr(chart, "describe_code", code)
