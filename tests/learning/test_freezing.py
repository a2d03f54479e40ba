"""Claims about the moment of freezing: the advice that it gives, and the state that it leaves."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from small_learner import SMALLEST, small_mixture

from leco_plugin.learning import freezing
from leco_plugin.learning.calibration import Measured
from leco_plugin.learning.freezing import (
    FIELD_FILE,
    advice_on,
    carry_over,
    field_at_freezing,
    leave_field,
)
from leco_plugin.models.mixture import Mixture


@pytest.mark.parametrize(
    ("threshold", "skipped", "recoveries", "said"),
    [
        (0.0, 0.0, 0, "no threshold"),
        (0.04, 0.004, 0, "hardly anything is skipped, which is right for a scene full of fog"),
        (0.04, 0.004, 1, "hardly anything is skipped; its gate collapsed once before; it learned"),
        (0.0, 0.0, 2, "no threshold keeps the price within its bounds, so nothing is skipped; its"),
        (0.3, 0.8, 1, None),
        (0.3, 0.05, 0, None),
        (0.3, 0.049, 0, "hardly anything is skipped"),
    ],
)
def test_what_skips_next_to_nothing_comes_with_advice(threshold, skipped, recoveries, said) -> None:
    advice = advice_on(Measured(threshold, 1e-4, 1e-3, 0.01, skipped), 150, recoveries)
    assert (advice is None) == (said is None)
    if advice is not None:  # where that option is differs between methods
        assert advice.startswith(said)
        assert "it learned for 150 steps, and more usually help" in advice
        assert "--pipeline.model of leco-occupancy" in advice
        assert "--pipeline.model.occupancy.learning of guided methods" in advice


@pytest.fixture
def mixture() -> Mixture:
    torch.manual_seed(0)
    experts = replace(SMALLEST.field.experts, scene_experts=4)
    gate = replace(SMALLEST.gate, scene_experts=4)
    made = small_mixture(
        replace(SMALLEST, gate=gate, field=replace(SMALLEST.field, experts=experts))
    )
    made.freeze(0.5, {"step": 7})
    return made


def densities(mixture: Mixture) -> torch.Tensor:
    torch.manual_seed(1)
    mapped, routes = 2.0 * torch.rand(50, 3) - 1.0, torch.randint(2, (50,))
    with torch.no_grad():
        return mixture.field.density(mapped, routes, torch.ones(50))[0]


def go_on(mixture: Mixture) -> None:
    """What guided training does to a mixture: another field, one expert fewer, the same gate."""
    with torch.no_grad():
        for parameter in mixture.field.parameters():
            parameter.add_(0.1)
    mixture.field.experts.drop(3)
    mixture.threshold.fill_(0.25)


def test_it_is_the_field_that_the_gate_was_calibrated_on(mixture: Mixture, tmp_path: Path) -> None:
    before = densities(mixture)
    leave_field(mixture, tmp_path)
    go_on(mixture)
    now = densities(mixture)
    frozen = field_at_freezing(mixture, tmp_path)
    assert frozen is not None and not frozen.training
    assert torch.equal(densities(frozen), before) and not torch.equal(now, before)
    assert (
        torch.equal(densities(mixture), now)
        and mixture.field.experts.remaining_experts() is not None
    )
    assert frozen.field.experts.remaining_experts() is None and frozen.report == {"step": 7}


def test_a_run_without_one_has_none(mixture: Mixture, tmp_path: Path) -> None:
    assert field_at_freezing(mixture, tmp_path) is None


def test_a_damaged_or_foreign_field_is_refused(mixture: Mixture, tmp_path: Path) -> None:
    leave_field(mixture, tmp_path)
    path = tmp_path / FIELD_FILE
    whole = path.read_bytes()
    for damaged in (b"", whole[: len(whole) // 2], b"no archive"):
        path.write_bytes(damaged)
        with pytest.raises(ValueError, match="cannot be used") as error:
            field_at_freezing(mixture, tmp_path)
        assert "\n" not in str(error.value)
    path.write_bytes(whole)
    with torch.no_grad():
        mixture.gate.head.bias.add_(1.0)
    with pytest.raises(ValueError, match="another gate"):
        field_at_freezing(mixture, tmp_path)


@pytest.mark.parametrize("what", ["checkpoint", "folder", "here"])
@pytest.mark.parametrize("models", ["nerfstudio_models", "models/of_this"])
def test_a_resumed_run_takes_it_along(
    what: str, models: str, mixture: Mixture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    leave_field(mixture, first)
    (first / "config.yml").touch()
    checkpoint = first / models / "step-000000009.ckpt"
    checkpoint.parent.mkdir(parents=True)
    checkpoint.write_bytes(b"")
    monkeypatch.chdir(checkpoint.parent)
    given = {"checkpoint": checkpoint, "folder": checkpoint.parent, "here": Path()}
    carry_over(given[what], second)
    assert (second / FIELD_FILE).read_bytes() == (first / FIELD_FILE).read_bytes()
    (second / FIELD_FILE).write_bytes(b"its own")
    carry_over(checkpoint, second)
    assert (second / FIELD_FILE).read_bytes() == b"its own"
    carry_over(tmp_path / "none" / "step-000000009.ckpt", tmp_path / "third")
    assert not (tmp_path / "third").exists()


def test_a_full_disk_costs_the_file_and_not_the_run(
    mixture: Mixture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    lines: list[str] = []
    monkeypatch.setattr(freezing, "write_whole", full)
    monkeypatch.setattr(freezing, "say", lines.append)
    leave_field(mixture, tmp_path)
    assert len(lines) == 1 and "could not be written" in lines[0]
