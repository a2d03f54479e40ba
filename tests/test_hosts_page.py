"""The code in docs/hosts.md runs as it stands there."""

from __future__ import annotations

import re
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from nerfstudio.configs.method_configs import all_methods
from nerfstudio.plugins.types import MethodSpecification

from leco_plugin.hosts.guided import GuidedModelConfig
from leco_plugin.method_configs import best_device

PAGE = (Path(__file__).resolve().parent.parent / "docs" / "hosts.md").read_text()
BLOCKS = dict(re.findall(r"```python\n# my_package/(\w+)\.py\n(.*?)```", PAGE, re.DOTALL))


@pytest.fixture
def my_package(monkeypatch: pytest.MonkeyPatch) -> MethodSpecification:
    """What the page takes for granted; returns the method in it."""
    package, methods = ModuleType("my_package"), ModuleType("my_package.methods")
    config = replace(all_methods["instant-ngp"], method_name="my-method")
    method = MethodSpecification(config, description="mine")
    vars(methods)["my_method"] = method
    for module in (package, methods):
        monkeypatch.setitem(sys.modules, module.__name__, module)
    return method


def run(name: str) -> dict[str, Any]:
    """What a module of the page defines."""
    found: dict[str, Any] = {}
    exec(compile(BLOCKS[name], name, "exec"), found)
    return found


def test_the_page_was_read() -> None:
    assert set(BLOCKS) == {"guided"}


def test_a_method_that_is_registered_as_the_page_says_learns_first(
    my_package: MethodSpecification,
) -> None:
    config: Any = run("guided")["leco_my_method"].config
    mine: Any = my_package.config
    assert config.method_name == "leco-my-method"
    assert isinstance(config.pipeline.model, GuidedModelConfig)
    assert config.pipeline.model.occupancy.path is None
    assert config.pipeline.model.host == mine.pipeline.model  # which is as it was
    assert mine.method_name == "my-method" and mine.machine.device_type == "cuda"
    assert config.machine.device_type == best_device()
    assert config.pipeline.datamanager != mine.pipeline.datamanager
