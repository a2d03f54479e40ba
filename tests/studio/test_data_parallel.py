"""Claims about who is started as a process of a data-parallel run; `tests/test_data_parallel.py`
runs them.
"""

from __future__ import annotations

import copy
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
import yaml
from ball_occupancy import ball
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.scripts import train as ns_train
from torch import nn

from leco_plugin import host_configs, method_configs
from leco_plugin.scenes.input_error import InputError
from leco_plugin.studio.processes import DataParallelTrainerConfig, WithoutDevices, process
from leco_plugin.studio.trainer import AtomicTrainer
from leco_plugin.swap import registered, swapped_config, with_sampler_swapped


@pytest.fixture(autouse=True)
def own(monkeypatch: pytest.MonkeyPatch) -> None:
    """Has a launch of nerfstudio return what it would start."""
    monkeypatch.setattr(ns_train, "launch", lambda **_: ns_train._distributed_worker)


def started(made: DataParallelTrainerConfig) -> Any:
    """What a launch starts; after it nerfstudio's launcher is as it was."""
    before = ns_train.launch, ns_train._distributed_worker
    made.set_timestamp()
    assert ns_train._distributed_worker is before[1]
    found = ns_train.launch(config=made, device_type=made.machine.device_type)
    assert (ns_train.launch, ns_train._distributed_worker) == before
    return found


def config(device: str, devices: int) -> DataParallelTrainerConfig:
    made = copy.deepcopy(method_configs.leco_occupancy.config)
    assert isinstance(made, DataParallelTrainerConfig)
    made.machine.device_type, made.machine.num_devices = device, devices  # type: ignore[assignment]
    return made


def test_several_processes_on_a_cpu_are_ours() -> None:
    made = config("cpu", 2)
    assert started(made) is process
    assert made.timestamp != "{timestamp}"


def test_so_are_those_of_several_machines() -> None:
    made = config("cpu", 1)
    made.machine.num_machines, made.machine.dist_url = 2, "tcp://host:1"
    assert started(made) is process


@pytest.mark.parametrize(("device", "devices"), [("cpu", 1), ("cuda", 1), ("cuda", 2)])
def test_all_others_are_left_to_nerfstudio(
    device: str, devices: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    assert started(config(device, devices)) is ns_train._distributed_worker


def test_a_launcher_that_is_run_as_a_script_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    script = SimpleNamespace(_distributed_worker=None)
    script.launch = own = lambda **_: script._distributed_worker
    monkeypatch.setitem(sys.modules, "__main__", script)
    config("cpu", 2).set_timestamp()
    assert script.launch(device_type="cpu") is process
    assert script.launch is own and script._distributed_worker is None


def test_a_launch_that_fails_leaves_nerfstudio_as_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(**_: Any) -> None:
        raise KeyError(3)

    monkeypatch.setattr(ns_train, "launch", fails)
    worker, made = ns_train._distributed_worker, config("cpu", 2)
    made.set_timestamp()
    made.set_timestamp()
    with pytest.raises(KeyError):
        ns_train.launch(config=made)
    assert ns_train.launch is fails and ns_train._distributed_worker is worker


def test_a_run_that_was_refused_leaves_no_process_to_one_on_cuda() -> None:
    config("cpu", 2).set_timestamp()  # and its folder cannot be written
    assert ns_train.launch(device_type="cuda") is ns_train._distributed_worker
    config("cpu", 2).set_timestamp()
    assert ns_train.launch(device_type="cpu") is process


def test_a_caller_may_name_a_device_for_a_module_on_a_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    given: dict[str, Any] = {}
    monkeypatch.setattr(
        nn.parallel.DistributedDataParallel,
        "__init__",
        lambda self, module, **options: given.update(module=module, **options),
    )
    model = nn.Linear(1, 1)
    WithoutDevices(model, device_ids=[1], find_unused_parameters=True)
    assert given == {"module": model, "find_unused_parameters": True}


def test_every_method_of_ours_can() -> None:
    configs = [
        value.config
        for module in (method_configs, host_configs)
        for name, value in vars(module).items()
        if hasattr(value, "config") and hasattr(value, "description")
    ]
    assert len(configs) >= 6
    assert all(type(made) is DataParallelTrainerConfig for made in configs)
    assert all(made._target is AtomicTrainer for made in configs)


def test_a_config_file_gives_it_back() -> None:
    made = yaml.load(yaml.dump(config("cpu", 2)), Loader=yaml.Loader)
    assert type(made) is DataParallelTrainerConfig
    assert made.machine.num_devices == 2


@pytest.fixture
def file(tmp_path: Path) -> Path:
    ball().save(tmp_path / "ball.safetensors")
    return tmp_path / "ball.safetensors"


def test_a_swapped_method_can(file: Path) -> None:
    made = swapped_config("instant-ngp-bounded", file, ["--machine.num-devices", "2"])
    assert type(made) is DataParallelTrainerConfig
    assert made._target is AtomicTrainer
    assert made.machine.num_devices == 2
    assert made.optimizers == registered("instant-ngp-bounded").optimizers


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ({"num_devices": 4}, r"num-devices is 4, and torch sees 1 CUDA devices"),
        ({"num_machines": 2}, r"num-machines is 2: give each --machine.dist-url tcp://HOST:PORT"),
        ({"machine_rank": 1}, r"machine-rank is 1; of 1 machines the ranks are 0 to 0"),
    ],
)
def test_what_cannot_be_started_is_refused_in_one_line(
    asked: dict[str, int], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    made = config("cuda", 1)
    vars(made.machine).update(asked)
    with pytest.raises(InputError, match=message) as refused:
        made.set_timestamp()
    assert "\n" not in str(refused.value)


class OthersConfig(TrainerConfig):
    """Of a package that has a config of its own."""


def test_a_config_of_another_kind_stays_what_it_is(file: Path) -> None:
    found = registered("nerfacto")
    other = OthersConfig(**vars(found))
    made = with_sampler_swapped(other, file)
    assert type(made) is OthersConfig
    assert made._target is AtomicTrainer
