"""Options of the model that cannot work are refused when they are given, in one line."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
import tyro

from leco_plugin.learning.calibration import CalibrationConfig
from leco_plugin.learning.merging import MergingConfig
from leco_plugin.learning.schedule import ScheduleConfig
from leco_plugin.learning.sharpening import SharpeningConfig
from leco_plugin.models.gate import GateConfig
from leco_plugin.models.leco_config import LecoModelConfig
from leco_plugin.models.objective import GateLossConfig
from leco_plugin.models.sizing.sizes import SMALL, check, with_size
from leco_plugin.models.switch.field import LEAST, SwitchNerfModelConfig
from leco_plugin.scenes.input_error import InputError

NO_NUMBERS = (math.nan, math.inf)
REFUSED: dict[tuple[Any, str], tuple[Any, ...]] = {
    (ScheduleConfig(), "learn_steps"): (0, -1),
    (ScheduleConfig(), "steps_per_record"): (-1,),
    **{
        (ScheduleConfig(), name): (-0.1, 1.1, math.nan)
        for name in ("settled", "earliest", "ramp_from", "ramp_to", "agreement")
    },
    (CalibrationConfig(), "rays"): (0, -1),
    (CalibrationConfig(), "rays_at_once"): (0, -1),
    (CalibrationConfig(), "recheck_rays"): (-1,),
    (CalibrationConfig(), "steps_per_recheck"): (0, -1),
    (CalibrationConfig(), "lost_surface_mass"): (-1e-6, *NO_NUMBERS),
    (CalibrationConfig(), "image_price_db"): (-1e-6, *NO_NUMBERS),
    (MergingConfig(), "rays"): (0, -1),
    (MergingConfig(), "image_price_db"): (math.nan,),
}
REFUSED_OF_THE_GATE: dict[str, tuple[float, ...]] = {
    **dict.fromkeys(("contribution", "agreement", "balance"), (-1e-6, *NO_NUMBERS)),
    **dict.fromkeys(("imbalance", "density"), (-1e-6, *NO_NUMBERS)),
    **dict.fromkeys(("weight_at_full", "emphasis"), (0.0, -1.0, *NO_NUMBERS)),
    **dict.fromkeys(("empty_below", "empty_ratio"), (0.0, 1.0, 1.5, -0.5, math.nan)),
}
REFUSED_OF_THE_MODEL: dict[str, tuple[float, ...]] = {
    "look_everywhere": (-0.1, 1.1, math.nan),
    "likely_above": (-0.1, 1.0, math.nan),
    "distortion_after": (-0.1, *NO_NUMBERS),
}
REFUSED_OF_SWITCH_NERF: dict[str, tuple[float, ...]] = {
    "capacity_factor": (0.0, -1.0, *NO_NUMBERS),
    **dict.fromkeys(("balance", "sigma_noise"), (-1e-6, *NO_NUMBERS)),
    "early_stop_eps": (-0.1, 1.0, math.nan),
    "grid_levels": (0,),
}
ALLOWED: dict[Any, dict[str, Any]] = {
    CalibrationConfig(): {"recheck_rays": 0, "lost_surface_mass": 0.0, "image_price_db": 0.0},
    MergingConfig(): {"image_price_db": -0.01, "rays": 1},
}


def name_of(field: str) -> str:
    """As it is given on the command line."""
    return field.replace("_", "-")


@pytest.mark.parametrize(
    ("config", "field", "value"),
    [
        *((config, field, value) for (config, field), some in REFUSED.items() for value in some),
        *(
            (GateLossConfig(), f, value)
            for f, some in REFUSED_OF_THE_GATE.items()
            for value in some
        ),
        *((LecoModelConfig(), f, v) for f, some in REFUSED_OF_THE_MODEL.items() for v in some),
        *(
            (SwitchNerfModelConfig(), f, value)
            for f, some in REFUSED_OF_SWITCH_NERF.items()
            for value in some
        ),
    ],
)
def test_a_value_that_cannot_work_is_named_with_what_would(
    config: Any, field: str, value: float
) -> None:
    with pytest.raises(InputError, match=f"{name_of(field)} is {value}; it ") as refused:
        replace(config, **{field: value})
    assert "\n" not in str(refused.value)


def test_the_ends_of_what_works_are_allowed() -> None:
    for config, values in ALLOWED.items():
        for field, value in values.items():
            assert getattr(replace(config, **{field: value}), field) == value
    assert GateLossConfig(empty_ratio=None, density=0.0).empty_ratio is None
    assert LecoModelConfig(look_everywhere=1.0, likely_above=0.0).look_everywhere == 1.0
    assert LecoModelConfig(likely_above=0.2, look_everywhere=0.0).likely_above == 0.2


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("gate-loss.empty-ratio", "1.5"),
        ("calibration.rays-at-once", "0"),
        ("merging.rays", "0"),
        ("likely-above", "1.5"),
    ],
)
def test_on_the_command_line_it_ends_with_status_2(
    option: str, value: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as end:
        tyro.cli(LecoModelConfig, args=[f"--{option}", value])
    assert end.value.code == 2
    said = capsys.readouterr().err
    assert f"{option} is {value}; it must be" in " ".join(said.replace("│", " ").split())
    assert "Traceback" not in said


@pytest.mark.parametrize("name", ["width", "layers", "scene_experts"])
@pytest.mark.parametrize("size", [0, -1])
def test_a_small_gate_that_cannot_be_built_is_refused_before_the_run(name: str, size: int) -> None:
    with pytest.raises(InputError, match=f"sharpening.gate: the gate's {name} is {size}, not in 1"):
        SharpeningConfig(gate=GateConfig(**{name: size}))


def test_what_homogeneous_experts_learn_has_no_history() -> None:
    with pytest.raises(InputError, match=r"steps-per-record .* homogeneous learns none"):
        LecoModelConfig(homogeneous=True, schedule=ScheduleConfig(steps_per_record=10))


@pytest.mark.parametrize("batch", [0.0, 0.05, -1.0, *NO_NUMBERS])
def test_batches_of_no_rays_are_refused(batch: float) -> None:
    with pytest.raises(ValueError, match=r"sizes\.guided-batch is .*at least 0\.125"):
        check(replace(SMALL, guided_batch=batch))


@pytest.mark.parametrize(
    ("name", "size"), [("appearance_dim", -1), ("direction_octaves", -1), ("color_width", 0)]
)
def test_a_field_that_cannot_be_built_is_refused(name: str, size: int) -> None:
    with pytest.raises(ValueError, match=f"the field's {name} is {size}, below"):
        check(replace(SMALL, field=replace(SMALL.field, **{name: size})))


@pytest.mark.parametrize("skip", [-1, 2, 9])
def test_a_layer_that_an_expert_does_not_have_cannot_see_its_input_again(skip: int) -> None:
    sizes = with_size(SMALL, "field.experts.skip", skip)
    with pytest.raises(ValueError, match=f"experts.skip is {skip}, and .* layers 0 to 1: "):
        check(sizes)
    with pytest.raises(InputError, match=f"field.skip is {skip}; it must be None or .* 0 to 0"):
        one = with_size(SwitchNerfModelConfig().sizes, "field.layers", 1)
        SwitchNerfModelConfig(sizes=with_size(one, "field.skip", skip))


@pytest.mark.parametrize("path", LEAST)
def test_a_switch_nerf_of_sizes_that_cannot_be_built_is_refused(path: str) -> None:
    sizes = with_size(SwitchNerfModelConfig().sizes, path, LEAST[path] - 1)
    with pytest.raises(InputError, match=f"sizes.{name_of(path)} is .*; it must be at least"):
        SwitchNerfModelConfig(sizes=sizes)


def test_an_empty_expert_without_layers_is_refused() -> None:
    with pytest.raises(ValueError, match="the field's empty_layers is 0, not in 1"):
        check(with_size(SMALL, "field.experts.empty_layers", 0))
