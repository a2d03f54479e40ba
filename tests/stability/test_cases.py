"""Claims about the cases, the runs that they need, and how long these take."""

from __future__ import annotations

from pathlib import Path

import pytest

from leco_plugin.chart.contender import config_of
from leco_plugin.scenes.input_error import InputError
from leco_plugin.stability.cases import CASES, cases_named
from leco_plugin.stability.plan import (
    A_RUN,
    FULL,
    QUICK,
    SAMPLERS,
    Run,
    capture_of,
    core_seconds,
    entries_of,
    runs_of,
    samplers_named,
    scenes_of,
)
from leco_plugin.stability.worker import with_fixed_batches

WANTED = {
    *("poles-and-wires", "glass", "fog", "all-empty", "all-full", "far-terrain", "outline"),
    *("indoors", "bounds-too-small", "bounds-too-large", "six-views", "exposure", "pose-noise"),
    *("moving", "resolutions", "far-origin", "ratio-too-low", "ratio-too-high"),
    *("lambda-g-high", "lambda-g-low", "lambda-d-high", "lambda-d-low"),
    *("learning-rate", "few-rays", "bf16", "fp16", "ten-seeds", "homogeneous"),
}
ALL = entries_of(list(CASES.values()), list(SAMPLERS.values()), (0,), FULL)


def test_every_case_that_was_asked_for_is_there_with_a_reason() -> None:
    assert not WANTED - CASES.keys()
    assert all(len(case.why) > 20 and len(case.title) < 30 for case in CASES.values())
    assert len({case.title for case in CASES.values()}) == len(CASES)


@pytest.mark.parametrize("name", sorted(CASES))
def test_every_run_of_a_case_can_be_configured(name: str) -> None:
    for entry in ALL:
        if entry.case.name == name:
            config = with_fixed_batches(config_of(entry.contender, Path("scene"), Path("runs")))
            assert type(config.pipeline).__name__ == "VanillaPipelineConfig"


def test_settings_arrive_where_they_belong() -> None:
    def config(case: str, sampler: str):  # type: ignore[no-untyped-def]
        (entry,) = [e for e in ALL if (e.case.name, e.sampler.name) == (case, sampler)]
        return with_fixed_batches(config_of(entry.contender, Path("scene"), Path("runs")))

    assert config("few-rays", "dense").pipeline.datamanager.train_num_rays_per_batch == 32
    assert config("few-rays", "learned").pipeline.model.occupancy.rays == 32
    assert config("learning-rate", "grid-128").optimizers["fields"]["optimizer"].lr == 0.1
    assert config("bounds-too-small", "dense").pipeline.datamanager.dataparser.scene_scale == 0.25
    assert config("fp16", "learned").pipeline.model.occupancy.learning.precision == "float16"
    for case, sampler, resolution, levels in (
        ("far-terrain", "grid-128", 128, 2),
        ("poles-and-wires", "grid-256", 256, 1),
    ):
        options = config(case, sampler).pipeline.model.occupancy.options
        assert options == {"resolution": resolution, "levels": levels}
    homogeneous = config("homogeneous", "learned").pipeline.model.occupancy.learning
    experts = homogeneous.sizes.field.experts
    assert experts.empty_layers == experts.layers
    assert homogeneous.gate_loss.density == 0.0 and homogeneous.gate_loss.empty_ratio is None
    assert homogeneous.calibration.recheck_rays == 0  # a host that is watched heals itself


def test_what_a_case_does_not_touch_is_run_once() -> None:
    runs = runs_of(ALL)
    keys = [(run.scene, run.job.name) for run in runs]
    assert len(set(keys)) == len(keys)
    dense = [key for key in keys if key[0] == "yard" and "-dense-" in key[1]]
    both, with_bounds = ("yard", "learning-rate", "few-rays"), ("too-small", "too-large")
    assert len(dense) == 2 * len(both) + len(with_bounds)


def test_a_host_without_bounds_is_not_counted_where_they_are_wrong() -> None:
    for name in ("bounds-too-small", "bounds-too-large"):
        compared = {entry.sampler.name for entry in ALL if entry.case.name == name}
        assert compared >= {"learned", "grid-128", "dense"}
        assert not compared & {"proposal-networks", "dense-proposal"}


def test_all_cells_get_their_first_seed_before_any_gets_its_second() -> None:
    entries = entries_of(
        cases_named(("glass", "fog")), samplers_named(("grid-128",)), (7, 3), QUICK
    )
    seeds = [run.job.seed for run in runs_of(entries)]
    assert seeds == [7] * 4 + [3] * 4


def test_samplers_that_stand_beside_may_have_fewer_seeds() -> None:
    chosen = cases_named(("glass", "ten-seeds"))
    entries = entries_of(chosen, samplers_named(()), (0, 1, 2), QUICK, beside=(0,))
    seeds = {(one.case.name, one.sampler.name): len(one.seeds) for one in entries}
    assert seeds["glass", "learned"] == seeds["glass", "dense"] == 3
    assert seeds["glass", "grid-128"] == seeds["glass", "dense-proposal"] == 1
    assert seeds["ten-seeds", "learned"] == 10
    assert seeds["ten-seeds", "dense"] == 3
    assert ("ten-seeds", "grid-128") not in seeds, "it would be the run of the yard once more"


def test_a_seed_beside_that_is_no_seed_is_refused_in_a_line() -> None:
    with pytest.raises(InputError, match=r"^--seeds-beside 7 is none of --seeds: add it there$"):
        entries_of(cases_named(("glass",)), samplers_named(()), (0, 1), QUICK, beside=(0, 7))


def test_references_join_by_themselves() -> None:
    assert [one.name for one in samplers_named(("grid-128",))] == ["grid-128", "dense"]
    assert [one.name for one in samplers_named(())] == list(SAMPLERS)


def test_cases_with_the_same_pictures_share_them() -> None:
    scenes = scenes_of(list(CASES.values()), FULL)
    for case in CASES.values():
        assert scenes[case.scene][1] == capture_of(case, FULL)
    assert capture_of(CASES["six-views"], QUICK).views == 6
    assert capture_of(CASES["yard"], QUICK).views < capture_of(CASES["yard"], FULL).views


def runs(cases: tuple[str, ...], samplers: tuple[str, ...]) -> list[Run]:
    return runs_of(entries_of(cases_named(cases), samplers_named(samplers), (0,), FULL))


def test_a_run_takes_as_long_as_those_of_its_sampler_or_as_any() -> None:
    wanted = runs(("yard",), ("grid-128",))
    stored = [
        {"sampler": name, "processor_seconds": seconds}
        for name, seconds in (("grid-128", 5.0), ("grid-128", 7.0), ("dense", 1.0))
    ]
    assert core_seconds(wanted, stored) == pytest.approx(6.0 + 1.0)  # the dense reference joins
    assert core_seconds(wanted, stored[:2]) == pytest.approx(6.0 + 7.0)
    assert core_seconds(wanted, []) == 2 * A_RUN
