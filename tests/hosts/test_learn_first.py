"""An occupancy learned inside another method's run."""

from __future__ import annotations

from dataclasses import replace

import pytest
import tiny_scene
from nerfstudio.data.datamanagers.base_datamanager import VanillaDataManagerConfig
from nerfstudio.pipelines.base_pipeline import VanillaPipelineConfig

from leco_plugin.hosts.guided_start import OccupancyConfig
from leco_plugin.hosts.learn_first import FEWEST_STEPS, keep_within, learn_occupancy
from leco_plugin.learning.run import Progress
from leco_plugin.learning.schedule import MOST_EXTENSIONS, ScheduleConfig
from leco_plugin.models.leco_config import LecoModelConfig
from leco_plugin.models.sizing.sizes import SMALL
from leco_plugin.occupancy import Occupancy
from leco_plugin.scenes.input_error import InputError
from leco_plugin.scenes.photographs import LecoPhotographsDataParserConfig


@pytest.fixture(scope="module")
def pipeline(tmp_path_factory: pytest.TempPathFactory):
    folder = tiny_scene.write(tmp_path_factory.mktemp("scene"))
    data = VanillaDataManagerConfig(
        dataparser=LecoPhotographsDataParserConfig(data=folder), train_num_rays_per_batch=77
    )
    return VanillaPipelineConfig(datamanager=data, model=LecoModelConfig()).setup(device="cpu")


def config(steps: int) -> LecoModelConfig:
    return LecoModelConfig(schedule=ScheduleConfig(learn_steps=steps))


def test_it_is_frozen_and_calibrated_and_the_batch_is_as_before(pipeline):
    occupancy = learn_occupancy(config(8), pipeline, rays=64)
    assert isinstance(occupancy, Occupancy)
    assert occupancy.report["step"] == 7
    assert occupancy.report["frame"] is not None
    assert pipeline.datamanager.train_pixel_sampler.num_rays_per_batch == 77
    assert not any(p.requires_grad for p in occupancy.parameters())


def test_a_budget_sets_the_number_of_steps(pipeline, monkeypatch: pytest.MonkeyPatch):
    clock = iter(range(10_000))
    monkeypatch.setattr("leco_plugin.hosts.learn_first.seconds_now", lambda: next(clock))
    # training asks the clock twice a step, and once in front of the steps
    occupancy = learn_occupancy(config(5000), pipeline, rays=32, seconds=1.0)
    assert occupancy.report["step"] == FEWEST_STEPS - 1


def test_steps_that_become_slower_do_not_outlast_the_budget(
    pipeline, monkeypatch: pytest.MonkeyPatch
):
    taken = 0

    def clock() -> float:
        """A step of the first thirty takes a second, one of the later ones ten."""
        return float(min(taken, 30) + 10 * max(0, taken - 30))

    def next_train(self, step: int):
        nonlocal taken
        taken = step + 1
        return give(step)

    give = pipeline.datamanager.next_train
    monkeypatch.setattr(type(pipeline.datamanager), "next_train", next_train)
    monkeypatch.setattr("leco_plugin.hosts.learn_first.seconds_now", clock)
    occupancy = learn_occupancy(config(5000), pipeline, rays=32, seconds=75.0)
    assert occupancy.report["step"] == 34  # the 35th ends at 80 s


def test_time_that_other_processes_take_shortens_nothing(pipeline, monkeypatch: pytest.MonkeyPatch):
    wall = iter(range(0, 10**9, 1000))
    for clock in ("monotonic", "perf_counter"):
        monkeypatch.setattr(f"time.{clock}", lambda: float(next(wall)))
    monkeypatch.setattr("torch.get_num_threads", lambda: 1)
    occupancy = learn_occupancy(config(30), pipeline, rays=32, seconds=500.0)
    assert occupancy.report["step"] >= 29


BUDGETS = {"seconds": [0.0, -3.0, float("nan"), float("inf")], "rays": [0, -1], "rate": [0.0, -1.0]}


@pytest.mark.parametrize(("name", "value"), [(n, v) for n, vs in BUDGETS.items() for v in vs])
def test_nothing_to_learn_with_is_refused_in_a_line(pipeline, name: str, value: float):
    with pytest.raises(InputError, match=r"an occupancy is learned|must be positive") as error:
        learn_occupancy(config(8), pipeline, **{"rays": 32, name: value})
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "never", [{"schedule": ScheduleConfig(freeze=False)}, {"homogeneous": True}], ids=str
)
def test_what_would_learn_for_ever_is_refused(pipeline, never):
    with pytest.raises(InputError, match=r"for ever.*leco-occupancy"):
        learn_occupancy(replace(config(8), **never), pipeline, rays=32)


def test_sizes_that_cannot_be_are_named_as_options_of_the_host(pipeline):
    impossible = replace(config(8), sizes=replace(SMALL, candidates=0))
    option = "--pipeline.model.occupancy.learning.sizes.candidates is 0"
    with pytest.raises(InputError, match=f"^{option}, below 1$"):
        learn_occupancy(impossible, pipeline, rays=32)


def test_each_method_has_learning_sizes_of_its_own():
    one, other = OccupancyConfig(), OccupancyConfig()
    one.learning.schedule = replace(one.learning.schedule, learn_steps=3)
    assert other.learning.schedule.learn_steps != 3


@pytest.mark.parametrize(
    ("more", "steps", "further"),
    [(90.7, 100, 0), (0.0, FEWEST_STEPS, 0), (190.0, 200, 0), (240.0, 200, 1), (900.0, 200, 2)],
)
def test_learning_takes_the_steps_that_fit_but_never_more_than_are_wanted(more, steps, further):
    progress = Progress(learn_steps=200, configured=200)
    keep_within(progress, more, done=10)
    assert progress.learn_steps == steps
    assert progress.extensions == MOST_EXTENSIONS - further
