"""The code in docs/hosts.md runs as it stands there."""

from __future__ import annotations

import re
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
import torch
from ball_occupancy import ball
from nerfstudio.configs.method_configs import all_methods
from nerfstudio.plugins.types import MethodSpecification

from leco_plugin.hosts.guide import Guide
from leco_plugin.hosts.guided import GuidedModelConfig
from leco_plugin.method_configs import best_device
from leco_plugin.occupancy import Occupancy
from leco_plugin.space import Space

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
    assert set(BLOCKS) == {"guided", "adapter"}


def test_the_adapter_of_the_page_guides_a_host_in_an_unbounded_scene(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class MyModel(SimpleNamespace):
        """A host whose steps do not grow."""

    models: Any = ModuleType("my_package.models")
    models.MyModel = MyModel
    monkeypatch.setitem(sys.modules, "my_package", ModuleType("my_package"))
    monkeypatch.setitem(sys.modules, "my_package.models", models)
    adapter, guide = run("adapter")["ADAPTER"], Guide(options={"cache_bytes": 0})
    guide.set_occupancy(Occupancy(ball().gate, Space("contraction"), threshold=1e-9))
    host: Any = MyModel(scene_box=SimpleNamespace(aabb=torch.tensor([[-1.0] * 3, [1.0] * 3])))
    assert adapter.fits(host)
    adapter.swap(host, guide)
    along = torch.zeros(1, 3), torch.tensor([[0.0, 0.0, 1.0]])
    _, _, t_ends = host.my_grid.sampling(*along, render_step_size=0.125)
    assert float(t_ends.max()) == pytest.approx(1.0)


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
