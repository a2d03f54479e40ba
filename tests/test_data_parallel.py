"""Two processes on a CPU, started by nerfstudio's own launcher, train as one would.

Both are forks of a process that has imported nerfstudio: the launcher's own would import it anew.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import data_parallel_training as processes
import pytest
import torch
from nerfstudio.scripts import train as ns_train
from torch import Tensor

from leco_plugin.host_configs import leco_ngp
from leco_plugin.method_configs import leco_occupancy
from leco_plugin.models.encodings import EncodingConfig
from leco_plugin.models.field import FieldConfig
from leco_plugin.models.gate import Gate, GateConfig
from leco_plugin.models.leco_config import LecoModelConfig
from leco_plugin.models.sizing.sizes import Sizes
from leco_plugin.occupancy import Occupancy
from leco_plugin.samplers import estimator
from leco_plugin.scenes.input_error import TrainingStopped
from leco_plugin.space import Space
from leco_plugin.studio.checkpoints import allow_checkpoint_globals, newest_whole, step_of
from leco_plugin.studio.processes import DataParallelTrainerConfig

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("forks")]

STEPS, LEARN = 24, 12
HEALED_FREEZES_AT = 17
SIZES = Sizes(
    gate=GateConfig(EncodingConfig(octaves=1), width=8, layers=1, scene_experts=2),
    field=FieldConfig(EncodingConfig(kind="hash", log2_table=8)),
    learn_candidates=16,
    candidates=32,
)

Launch = Callable[..., list[dict[str, Any]]]


@pytest.fixture(scope="module")
def launch(forks: None) -> Iterator[Launch]:
    """Runs a function of `data_parallel_training` as two processes; returns what each one left."""
    allow_checkpoint_globals()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ns_train, "_distributed_worker", ns_train._distributed_worker)
        started: list[Any] = []

        def start_forks(*arguments: Any, **options: Any) -> Any:
            """torch's `spawn`, by another start method."""
            started.append(
                ns_train.mp.start_processes(*arguments, **options, start_method="forkserver")
            )
            return started[-1]

        patch.setattr(ns_train.mp, "spawn", start_forks)

        def launch(what: Callable[..., None], config: DataParallelTrainerConfig) -> list[Any]:
            patch.setattr(ns_train, "train_loop", what)
            try:
                ns_train.main(config)
                for process in started.pop().processes:
                    process.join(60)  # nerfstudio waits for one of them
            finally:
                for process in (process for context in started for process in context.processes):
                    process.kill()
                started.clear()
            folder = config.get_base_dir()
            return [torch.load(folder / f"process-{number}.pt") for number in range(2)]

        yield launch


def config_of(method: Any, scene: Path, folder: Path, name: str) -> Any:
    """A method in sizes for a test, as `--machine.num-devices 2 --machine.device-type cpu`."""
    made: Any = copy.deepcopy(method.config)
    made.machine.num_devices, made.machine.device_type = 2, "cpu"
    made.output_dir, made.experiment_name, made.timestamp = folder, "tiny", name
    made.vis, made.logging.local_writer.enable = "tensorboard", False
    made.steps_per_eval_image = 0
    made.max_num_iterations = STEPS
    made.pipeline.datamanager.data = scene
    made.pipeline.datamanager.train_num_rays_per_batch = 64
    model = made.pipeline.model
    learning = model if isinstance(model, LecoModelConfig) else model.occupancy.learning
    learning.sizes = SIZES
    learning.schedule = replace(learning.schedule, learn_steps=LEARN)
    learning.calibration = replace(learning.calibration, rays=128)
    # whatever it costs the image: one scene expert is left
    learning.merging = replace(learning.merging, image_price_db=1e3, rays=64)
    if learning is not model:
        model.occupancy.rays = 64
        model.host.log2_hashmap_size, model.host.max_res, model.host.cone_angle = 8, 32, 1 / 8
        model.host.grid_resolution, model.host.grid_levels = 16, 2
        made.pipeline.target_num_samples, made.pipeline.max_num_samples_per_ray = 2048, 32
        made.pipeline.fewest_rays = 8
    return made


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("outputs")


@pytest.fixture(scope="module")
def learned(launch: Launch, tiny_scene: Path, folder: Path) -> tuple[Any, list[dict[str, Any]]]:
    """A run of `leco-occupancy` whose gate is healed once: its config, and what was seen."""
    config = config_of(leco_occupancy, tiny_scene, folder, processes.HEALED)
    return config, launch(processes.run, config)


@pytest.fixture(scope="module")
def guided(launch: Launch, tiny_scene: Path, folder: Path) -> tuple[Any, list[dict[str, Any]]]:
    """A run of `leco-ngp` that learns its occupancy first: its config, and what was seen."""
    config = config_of(leco_ngp, tiny_scene, folder, "run")
    config.max_num_iterations = 6
    return config, launch(processes.run, config)


def losses(seen: dict[str, Any]) -> list[float]:
    return [loss for *_, loss in seen["steps"]]


def phases(seen: dict[str, Any]) -> list[Any]:
    """Step, rays, phase and weights of each step."""
    return [noted[:-1] for noted in seen["steps"]]


def assert_same_weights(seen: list[dict[str, Any]]) -> None:
    first, second = (processes.digest(process["state"]) for process in seen)
    assert first == second and len(first) > 10


def occupancy_in(state: dict[str, Tensor], prefix: str = "") -> dict[str, Tensor]:
    """What is of a gate, by its names in the gate."""
    start = f"{prefix}gate."
    return {name.removeprefix(start): state[name] for name in state if name.startswith(start)}


def test_two_processes_speak_gloo_and_share_the_cores(learned: Any) -> None:
    for process in learned[1]:
        assert process["backend"] == "gloo"
        assert process["threads"] == 1


def test_each_process_trains_on_rays_of_its_own_and_all_weights_stay_the_same(learned: Any) -> None:
    first, second = learned[1]
    assert losses(first) != losses(second)
    assert len(losses(first)) == STEPS
    assert_same_weights([first, second])


def test_every_phase_begins_at_the_same_step(learned: Any) -> None:
    first, second = learned[1]
    assert phases(first) == phases(second)
    frozen = [step for step, _, (_, frozen), *_ in first["steps"] if frozen]
    assert frozen == list(range(HEALED_FREEZES_AT + 1, STEPS))
    assert len({rays for _, rays, *_ in first["steps"]}) > 1
    looks = first["looks"]
    assert len(looks) == 2
    assert all(map(torch.equal, looks, second["looks"]))


def test_the_same_gate_is_frozen_and_stays_as_it_was_frozen(learned: Any) -> None:
    config, seen = learned
    occupancy = Occupancy.load(config.get_base_dir() / "occupancy.safetensors")
    for process in seen:
        state = process["state"]
        assert state["mixture._extra_state"]["report"] == occupancy.report
        assert float(state["mixture.threshold"]) == occupancy.threshold
        kept = occupancy_in(occupancy.state_dict())
        assert processes.digest(occupancy_in(state, "mixture.")) == processes.digest(kept)
        assert state["_extra_state"]["progress"]["recoveries"] == 1
        assert all(
            (gradient is None) == name.startswith("mixture.gate.")
            for name, gradient in process["gradients"].items()
            if name.startswith(("mixture.gate.", "mixture.field.density_head"))
        )


def test_all_processes_drop_the_experts_that_the_first_one_does_not_need(learned: Any) -> None:
    config, seen = learned
    first, second = (process["state"]["mixture.field.experts.left"] for process in seen)
    assert torch.equal(first, second) and first.tolist().count(True) == 1
    gone = [f"experts.{number}." for number, left in enumerate(first.tolist(), 1) if not left]
    for process in seen:
        names = [*process["state"], *process["gradients"]]
        assert not any(part in name for name in names for part in gone)
    assert "scene experts: 1 left" in (config.get_base_dir() / "process-0.log").read_text()


@pytest.mark.parametrize("method", ["learned", "guided"])
def test_one_process_writes_and_speaks(method: str, request: pytest.FixtureRequest) -> None:
    config, (first, second) = request.getfixturevalue(method)
    folder = config.get_base_dir()
    assert first["saved"] == [str(folder / "occupancy.safetensors")]
    assert second["saved"] == []
    assert len(list((folder / "nerfstudio_models").iterdir())) == 1
    assert "occupancy learned in" in (folder / "process-0.log").read_text()
    assert "leco]" not in (folder / "process-1.log").read_text()


def test_a_resumed_run_goes_on_in_both(learned: Any, launch: Launch) -> None:
    config = replace(learned[0], timestamp="resumed", max_num_iterations=2)
    config.load_dir = learned[0].get_checkpoint_dir()
    before = learned[1][0]["state"]
    first, second = launch(processes.run, config)
    assert phases(first) == phases(second)
    assert [step for step, *_ in first["steps"]] == [STEPS, STEPS + 1]
    assert_same_weights([first, second])
    gates = [processes.digest(occupancy_in(s, "mixture.")) for s in (first["state"], before)]
    assert gates[0] == gates[1] and gates[0]
    assert first["saved"] == [str(config.get_base_dir() / "occupancy.safetensors")]
    assert second["saved"] == []


def test_one_process_opens_what_two_have_left(learned: Any) -> None:
    config, (first, _) = learned
    (checkpoint,) = config.get_checkpoint_dir().iterdir()
    alone = config.pipeline.setup(device="cpu", test_mode="inference")
    alone.load_pipeline(torch.load(checkpoint)["pipeline"], STEPS - 1)
    assert processes.digest(alone.model.state_dict()) == processes.digest(first["state"])


def test_an_occupancy_is_learned_together_before_a_host_is_trained(guided: Any) -> None:
    config, (first, second) = guided
    occupancy = Occupancy.load(config.get_base_dir() / "occupancy.safetensors")
    for process in (first, second):
        state = process["state"]
        assert state["leco_guide._extra_state"]["report"] == occupancy.report
        found = {f"leco_guide.occupancy.{name}": v for name, v in occupancy.state_dict().items()}
        found = processes.digest(found)
        assert found.items() <= processes.digest(state).items()
    assert losses(first) != losses(second)
    assert_same_weights([first, second])


def test_dynamic_batches_have_as_many_rays_in_every_process(guided: Any) -> None:
    first, second = guided[1]
    assert phases(first) == phases(second)
    assert len({rays for _, rays, *_ in first["steps"]}) > 1


def test_a_process_that_is_lost_ends_the_run_in_one_line_and_nothing_saved_is_lost(
    launch: Launch, tiny_scene: Path, folder: Path
) -> None:
    config = config_of(leco_occupancy, tiny_scene, folder, "lost")
    config.steps_per_save = 4
    with pytest.raises(
        TrainingStopped, match=r"of 2 processes here was lost .*--load-dir"
    ) as caught:
        launch(processes.lose_one, config)
    assert "\n" not in str(caught.value)
    path, damaged = newest_whole(config.get_checkpoint_dir())
    assert step_of(path) == 8 and not damaged


def refuse(*_: object, **__: object) -> None:
    raise ValueError("no cache in this test")


@pytest.mark.parametrize("name", ["learning", "guided", "host"])
def test_a_step_of_two_processes_is_that_of_one_with_both_batches(
    name: str, launch: Launch, tiny_scene: Path, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    method = leco_ngp if name == "host" else leco_occupancy
    config = config_of(method, tiny_scene, folder, name)
    if name == "host":
        torch.manual_seed(0)
        space = Space("contraction", (0.0, 0.0, 0.0), 1.0)
        config.pipeline.model.occupancy.path = folder / "half.safetensors"
        Occupancy(Gate(SIZES.gate), space, 0.67).save(folder / "half.safetensors")
    else:
        # a product of means over a batch is not the mean of those over its parts
        config.pipeline.model.gate_loss.balance = 0.0
        config.pipeline.model.look_everywhere = 1.0
    first, second = launch(processes.step, config)
    monkeypatch.setattr(torch, "rand_like", processes.without_jitter)
    monkeypatch.setattr(estimator, "build_cache", refuse)
    alone = processes.backward(config, 0, 1)
    assert first["loss"] != second["loss"]
    assert 0.5 * (first["loss"] + second["loss"]) == pytest.approx(alone["loss"], rel=1e-5)
    largest = max(float(g.abs().max()) for g in alone["gradients"].values() if g is not None)
    moved = 0
    for parameter, expected in alone["gradients"].items():
        one, other = first["gradients"][parameter], second["gradients"][parameter]
        if expected is None:
            assert one is None and other is None, parameter
            continue
        assert torch.equal(one, other), parameter
        torch.testing.assert_close(one, expected, rtol=1e-3, atol=1e-5 * largest)
        moved += bool(expected.any())
    assert moved >= 4
    gate = first["gradients"].get("mixture.gate.head.weight")
    assert (gate is not None) == (name == "learning")


def test_what_is_agreed_upon_is_what_the_first_process_has(
    launch: Launch, tiny_scene: Path, folder: Path
) -> None:
    found = launch(processes.agree, config_of(leco_occupancy, tiny_scene, folder, "agree"))
    for number, process in enumerate(found):
        whole, half, turned, none = process["tensors"]
        assert bool(whole.all()) and float(half) == 0.5 and len(none) == 0
        assert turned.shape == (2, 3) and not bool(turned.any())
        assert process["mean"] == 0.5
        assert process["object"] == {"rank": 0}
        assert process["first"] == (number == 0)
