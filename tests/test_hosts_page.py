"""The code in docs/hosts.md runs as it stands there."""

from __future__ import annotations

import re
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from ball_occupancy import CENTRE, ball
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.configs.method_configs import all_methods
from nerfstudio.model_components.ray_samplers import UniformSampler
from nerfstudio.plugins.types import MethodSpecification
from torch import nn

from leco_plugin.hosts import seams
from leco_plugin.hosts.guide import Guide
from leco_plugin.hosts.guided import GuidedModelConfig
from leco_plugin.method_configs import best_device

PAGE = (Path(__file__).resolve().parent.parent / "docs" / "hosts.md").read_text()
BLOCKS = dict(re.findall(r"```python\n# my_package/(\w+)\.py\n(.*?)```", PAGE, re.DOTALL))


class MyModel(nn.Module):
    """A model that samples in a way that only its adapter knows."""

    def __init__(self) -> None:
        super().__init__()
        self.my_sampler = UniformSampler(num_samples=64)

    def get_param_groups(self) -> dict[str, list[nn.Parameter]]:
        return {}


@pytest.fixture
def my_package(monkeypatch: pytest.MonkeyPatch) -> MethodSpecification:
    """What the page takes for granted; returns the method in it."""
    package, methods, model = (ModuleType(f"my_package{of}") for of in ("", ".methods", ".model"))
    config = replace(all_methods["instant-ngp"], method_name="my-method")
    method = MethodSpecification(config, description="mine")
    vars(methods)["my_method"], vars(model)["MyModel"] = method, MyModel
    for module in (package, methods, model):
        monkeypatch.setitem(sys.modules, module.__name__, module)
    return method


def run(name: str) -> dict[str, Any]:
    """What a module of the page defines."""
    found: dict[str, Any] = {}
    exec(compile(BLOCKS[name], name, "exec"), found)
    return found


def test_the_page_was_read() -> None:
    assert set(BLOCKS) == {"guided", "adapter"}


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


def test_the_adapter_of_the_page_samples_where_the_occupancy_is(
    my_package: MethodSpecification, monkeypatch: pytest.MonkeyPatch
) -> None:
    adapter = run("adapter")["ADAPTER"]
    monkeypatch.setattr(seams, "foreign_entries", lambda *_: {"my-model": adapter})
    guide, host = Guide(options={"cache_bytes": 0}), MyModel()
    guide.set_occupancy(ball())
    assert seams.swap_sampler(host, guide) == "my-model"
    origins = torch.tensor(CENTRE)[None] - torch.tensor([[0.0, 0.0, 4.0]])
    rays = RayBundle(
        origins=origins,
        directions=torch.tensor([[0.0, 0.0, 1.0]]),
        pixel_area=torch.ones(1, 1),
        nears=torch.zeros(1, 1),
        fars=torch.full((1, 1), 8.0),
    )
    samples = host.eval().my_sampler(rays)
    away = (samples.frustums.get_positions() - torch.tensor(CENTRE)).norm(dim=-1)
    assert away.shape == (1, 64) and (away < 1.3).float().mean() > 0.9
