"""Claims about one run of a chart: what it leaves, and what a crash half-way leaves."""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from small_learner import small_mixture

from leco_plugin.chart import worker
from leco_plugin.chart.contender import Contender, Protocol
from leco_plugin.chart.methods import SUITES
from leco_plugin.chart.runner import FAILURE, JOB, PROGRESS, RESULT
from leco_plugin.chart.worker import main, run_job, train_job
from leco_plugin.evaluation import equal_loss, timed_run
from leco_plugin.learning.freezing import leave_field
from leco_plugin.models.gate import Gate, GateConfig
from leco_plugin.models.leco import LecoModel

SMALL = {
    "sizes.field.encoding.levels": 2,
    "sizes.field.encoding.log2_table": 8,
    "sizes.candidates": 32,
    "calibration.rays": 64,
    "schedule.learn_steps": 3,
}
ONE = Contender("LeCO", "leco-occupancy", "learned-occupancy", SMALL)
SHORT = Protocol(steps=6, images=1, curve_points=2)


@pytest.fixture(autouse=True)
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing reads the standard input; few rays are evaluated."""
    monkeypatch.setattr(worker, "die_with_parent", lambda: None)
    monkeypatch.setattr(timed_run, "CURVE_RAYS", 64)
    monkeypatch.setattr(equal_loss, "TAUGHT_RAYS", 256)
    monkeypatch.setattr(equal_loss, "VOLUME_POINTS", 4096)


def job(folder: Path, scene: Path, contender: Contender = ONE) -> Path:
    values = {"contender": asdict(contender), "seed": 3, "data": str(scene)}
    (folder / JOB).write_text(json.dumps({**values, "protocol": asdict(SHORT)}))
    return folder


def test_a_job_comes_to_the_run_as_it_was_written(tiny_scene: Path, tmp_path: Path) -> None:
    def run(contender: Contender, seed: int, data: Path, protocol: Protocol, *rest: Any) -> Any:
        show: Callable[[float], None] = rest[1]
        show(0.5)
        return {"same": contender == ONE and protocol == SHORT, "seed": seed, "data": str(data)}

    assert main(job(tmp_path, tiny_scene), run) == 0
    found = json.loads((tmp_path / RESULT).read_text())
    assert found.pop("wall_seconds") >= 0.0
    assert {"version", "commit", "sources"} == found.pop("code").keys()
    assert found == {"same": True, "seed": 3, "data": str(tiny_scene)}
    assert (tmp_path / PROGRESS).read_text() == "0.500"


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (ValueError("the gate calls\n all space empty"), "the gate calls all space empty"),
        (ZeroDivisionError("division by zero"), "ZeroDivisionError: division by zero"),
        (SystemExit(3), "SystemExit: 3"),
        (MemoryError(), "MemoryError: "),
    ],
)
def test_whatever_a_method_raises_is_a_reason_in_a_line(
    tiny_scene: Path,
    tmp_path: Path,
    error: BaseException,
    reason: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def run(*arguments: Any) -> Any:
        raise error

    assert main(job(tmp_path, tiny_scene), run) == 1
    assert json.loads((tmp_path / FAILURE).read_text()) == {"reason": reason}
    assert not (tmp_path / RESULT).exists() and "Traceback" in capsys.readouterr().err


def test_a_method_that_crashes_half_way_has_its_own_reason(
    tiny_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from leco_plugin.models.leco import LecoModel

    steps: list[int] = []
    losses = LecoModel.get_loss_dict

    def get_loss_dict(self: LecoModel, *arguments: Any) -> Any:
        steps.append(1)
        if len(steps) == 3:
            raise RuntimeError("the third step\nwas one too many")
        return losses(self, *arguments)

    monkeypatch.setattr(LecoModel, "get_loss_dict", get_loss_dict)
    monkeypatch.setattr("sys.stderr", io.StringIO())
    assert main(job(tmp_path, tiny_scene)) == 1
    reason = json.loads((tmp_path / FAILURE).read_text())["reason"]
    assert reason == "RuntimeError: the third step was one too many"


def test_gate_and_grids_are_measured_on_the_field_of_the_moment_of_freezing(
    tiny_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[dict[str, torch.Tensor]] = []

    def at_equal_loss(mixture: Any, manager: Any, grids: tuple[int, ...]) -> dict[str, Any]:
        asked.append(
            {k: v.clone() for k, v in mixture.field.state_dict().items() if "extra" not in k}
        )
        return {"grids": list(grids)}

    monkeypatch.setattr(equal_loss, "at_equal_loss", at_equal_loss)
    one = replace(ONE, grids=(8, 16))
    result, trainer = train_job(one, 3, tiny_scene, SHORT, tmp_path)
    assert result["occupancy"]["at_equal_loss"] == {"grids": [8, 16]}
    trained = trainer.pipeline.model.mixture.field.state_dict()
    (then,) = asked
    assert any(not torch.equal(value, trained[name]) for name, value in then.items())
    assert result["steps"] == 6 and (tmp_path / "occupancy.safetensors").exists()


def test_the_seed_of_a_job_is_that_of_its_run(
    tiny_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def started(*_: Any, seed: int, **__: Any) -> None:
        raise RuntimeError(f"seed {seed}")

    monkeypatch.setattr(timed_run, "timed_run", started)
    with pytest.raises(RuntimeError, match="seed 7"):
        run_job(ONE, 7, tiny_scene, SHORT, tmp_path)


def test_a_whole_run_has_its_figures(tiny_scene: Path, tmp_path: Path) -> None:
    shares: list[float] = []
    one = replace(ONE, grids=(8,))
    found = run_job(one, 0, tiny_scene, SHORT, tmp_path, shares.append)
    assert json.loads(json.dumps(found)) == found and shares[-1] == 1.0
    kept = found["occupancy"]["at_equal_loss"]
    assert 0.0 < kept["kept_reached_volume"] <= 1.0 and 0.0 < kept["reached_volume"] <= 1.0
    assert kept["grids"][0]["bytes"] == 64


def test_small_gates_are_taught_by_the_field_as_it_was_and_stand_beside(
    tiny_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from leco_plugin.capacity import measuring

    at_equal_loss = equal_loss.at_equal_loss

    monkeypatch.setattr(measuring, "STEPS", 20)
    monkeypatch.setattr(measuring, "TAUGHT_RAYS", 256)
    alone: list[dict[str, Any]] = []
    tables: list[torch.Tensor] = []

    def compared(mixture: Any, manager: Any, *rest: Any, **others: Any) -> dict[str, Any]:
        tables.append(torch.cat([p.detach().flatten() for p in mixture.field.parameters()]))
        torch.manual_seed(7)
        alone.append(at_equal_loss(mixture, manager, *rest))
        torch.manual_seed(7)
        return at_equal_loss(mixture, manager, *rest, **others)

    monkeypatch.setattr(equal_loss, "at_equal_loss", compared)
    one = replace(ONE, taught=True)
    result, trainer = train_job(one, 3, tiny_scene, SHORT, tmp_path)
    found = result["occupancy"]["at_equal_loss"]
    taught, others = found.pop("taught"), found.pop("others")
    assert found == alone[0]  # the gate's own row knows nothing of them
    grids = [f"taught grid {cells}³" for cells in (32, 64, 128, 256)]
    assert [row["name"] for row in others] == grids
    assert all(0 <= row["bytes"] < size**3 / 4 for row, size in zip(others, (32, 64, 128, 256)))
    assert all(0.0 < row["kept_reached_volume"] <= 1.0 and row["learned_first"] for row in others)
    assert {row["name"]: row["bytes"] for row in taught} == {
        "MLP": 4932,
        "hash grid": 16804,
        "TensoRF planes": 27476,
        "K-planes": 26428,
    }
    assert all(0.0 < row["kept_reached_volume"] <= 1.0 and row["seconds"] > 0.0 for row in taught)
    now = torch.cat(
        [p.detach().flatten() for p in trainer.pipeline.model.mixture.field.parameters()]
    )
    assert not torch.equal(tables[0], now)
    assert json.loads(json.dumps(result)) == result


def test_a_restarted_run_has_no_field_to_measure(tiny_scene: Path, tmp_path: Path) -> None:
    one = replace(ONE, changes={**SMALL, "schedule.restart": True})
    found = run_job(one, 0, tiny_scene, SHORT, tmp_path)
    assert found["occupancy"]["at_equal_loss"] is None and found["steps"] == 6


def test_learning_time_is_held_to_whenever_it_is_over(
    tiny_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(timed_run, "TIMED_STEPS", 10**6)  # no forecast from the first steps
    one = replace(ONE, changes={**SMALL, "schedule.learn_steps": 200})
    protocol = Protocol(steps=30, images=1, curve_points=2, learn_seconds=0.01)
    record = run_job(one, 3, tiny_scene, protocol, tmp_path)
    assert record["freeze_seconds"] is not None
    assert record["freeze_seconds"] < record["train_seconds"]


SMALLEST: dict[str, Any] = {
    "sizes.learn_candidates": 8,
    "sizes.candidates": 16,
    "calibration.rays": 64,
    "schedule.learn_steps": 3,
}
CONTENDERS = {one.alone().key: one for found in SUITES.values() for one in found.contenders}
BY_DEFAULT = {one.alone().key for one in SUITES["losses"].contenders}
"""The others take a minute of one core, and run only when long tests are asked for."""


def smaller(one: Contender) -> Contender:
    """The same comparison in sizes that train in a moment, the scene's own choices kept."""
    small = SMALLEST
    if one.method != "leco-occupancy":
        small = {f"occupancy.learning.{path}": value for path, value in SMALLEST.items()}
    changes = {**small, **one.changes}
    if "host.sizes.grid_resolution" in changes:
        changes["host.sizes.grid_resolution"] = 8
    return replace(one, changes=changes, grids=(8,) if one.grids else ())


@pytest.mark.parametrize(
    "one",
    [
        pytest.param(one, id=one.name, marks=() if key in BY_DEFAULT else pytest.mark.long)
        for key, one in CONTENDERS.items()
    ],
)
def test_every_contender_can_be_trained(one: Contender, tiny_scene: Path, tmp_path: Path) -> None:
    short = Protocol(steps=6, images=1, curve_points=1)
    run = run_job(smaller(one), 0, tiny_scene, short, tmp_path)
    assert run["steps"] == 6 and run["psnr"] > 0.0
    assert (run["occupancy"] is not None) == one.sampler.startswith("learned-occupancy")


def test_at_freezing_the_large_gate_is_measured(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    model, trainer = a_frozen_run(tmp_path)
    mixture = model.mixture
    small, head = Gate(GateConfig(width=8, layers=1)), mixture.gate.head.bias.detach().clone()
    color = next(mixture.field.color.parameters())
    shown = color.detach().clone()
    mixture.sharpen(small, 0.3, {})
    mixture.field.experts.drop(1)
    with torch.no_grad():
        color.add_(1.0)

    def compared(model: Any, *_: Any) -> dict[str, Any]:
        then = model.mixture
        assert then.small is None and torch.equal(then.gate.head.bias, head)
        assert torch.equal(next(then.field.color.parameters()), shown)
        assert torch.equal(then.field.experts.left, mixture.field.experts.left)
        return {"grids": [], "drawn": float(torch.rand(()))}

    monkeypatch.setattr(worker, "compare_at_freezing", compared)
    torch.manual_seed(3)
    drawn = float(torch.rand(()))
    torch.manual_seed(3)
    assert worker._at_freezing(trainer, ONE) == {"grids": [], "drawn": drawn}
    assert model.mixture is mixture and mixture.small is small and torch.equal(color, shown + 1.0)


def test_a_run_whose_rays_see_no_surface_is_whole(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def compared(*_: Any) -> dict[str, Any]:
        raise ValueError("no surface is seen")

    model, trainer = a_frozen_run(tmp_path)
    mixture = model.mixture
    monkeypatch.setattr(worker, "compare_at_freezing", compared)
    assert worker._at_freezing(trainer, ONE) is None and model.mixture is mixture
    assert capsys.readouterr().out == "no surface is seen\n"


def a_frozen_run(folder: Path) -> tuple[Any, Any]:
    """A model that has left its field in a folder, and its trainer."""
    mixture = small_mixture()
    mixture.freeze(0.2, {})
    leave_field(mixture, folder)
    model: Any = LecoModel.__new__(LecoModel)
    torch.nn.Module.__init__(model)
    model.mixture = mixture
    model.config = SimpleNamespace(schedule=SimpleNamespace(restart=False))
    return model, SimpleNamespace(
        base_dir=folder, pipeline=SimpleNamespace(model=model, datamanager=None)
    )
