"""What the GPU suite trains and builds, without a GPU; run like `gpu_suite_cases.py`."""

from __future__ import annotations

import os
from pathlib import Path

import gpu_nerfacc
import gpu_parts
import gpu_training
import torch
from gpu_scale import Scale

from leco_plugin.learning.calibration import CalibrationConfig
from leco_plugin.method_configs import leco_occupancy_paper
from leco_plugin.models.compute import grouped as grouped_trial
from leco_plugin.models.objective import GateLossConfig

CPU = torch.device("cpu")
DRY = Scale(CPU).dry()


def test_what_builds_kernels_is_given_up_after_a_while(monkeypatch) -> None:
    monkeypatch.setattr(gpu_nerfacc, "BUILD", "pass")
    assert gpu_nerfacc.trouble_with_kernels.__wrapped__() is None
    monkeypatch.setattr(gpu_nerfacc, "BUILD", "raise SystemExit(True)")
    assert gpu_nerfacc.trouble_with_kernels.__wrapped__() == "its kernels cannot be built"
    assert gpu_nerfacc.trouble_with(["sleep", "60"], 0.1) == "its kernels are not built after 0.1 s"


def test_a_deaf_build_is_ended_with_all_that_it_started(monkeypatch, tmp_path: Path) -> None:
    monkeypatch.setattr(gpu_nerfacc, "GRACE", 0.2)
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    deaf = ["sh", "-c", f"trap '' INT; sleep 60 > {pipe} & sleep 60"]
    with open(os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)) as heard:
        assert gpu_nerfacc.trouble_with(deaf, 1.0) == "its kernels are not built after 1 s"
        os.set_blocking(heard.fileno(), True)
        assert heard.read() == ""  # whoever could write is gone


def test_without_grouped_products_experts_are_timed_one_by_one(monkeypatch, capsys) -> None:
    monkeypatch.delattr(torch.nn.functional, "grouped_mm", raising=False)
    measured = gpu_parts.experts(DRY, {})
    assert list(measured["seconds"]) == list(measured["peak_bytes"]) == ["one by one"]
    assert measured["figures"] == [] and not measured["grouped is chosen"]
    assert "no grouped products: " in capsys.readouterr().out
    monkeypatch.setattr(grouped_trial, "is_right", lambda device: False)
    assert not gpu_parts.grouped_is_right(CPU)
    assert "no grouped products: they are wrong" in capsys.readouterr().out


def test_losses_are_weighted_as_in_the_method() -> None:
    model = leco_occupancy_paper.config.pipeline.model
    weights = gpu_training.Weights()._asdict()
    assert weights == {name: getattr(model, name) for name in weights}
    assert GateLossConfig() == model.gate_loss
    assert CalibrationConfig() == model.calibration
    optimizers = leco_occupancy_paper.config.optimizers.values()
    assert {group["optimizer"].lr for group in optimizers} == {gpu_training.RATE}
    assert model.sizes == Scale(CPU).sizes


def test_the_dense_host_ends_learning_when_the_guided_one_did(monkeypatch) -> None:
    trained: list[tuple[float, bool]] = []

    def train(run: gpu_training.Run, duration: float, candidates: int) -> float:
        trained.append((duration, run.learning))
        return duration

    monkeypatch.setattr(gpu_training.Run, "train", train)
    step = {"seconds": 1.0, "peak_bytes": 1}
    seconds = {"learning": 3.0, "freezing": 0.5, "guided": 2.0}
    learned = {"seconds": seconds, "guided_step": step, "psnr": 10.0}
    assert gpu_training.train_dense(DRY, {"learned": learned})["seconds"] == 5.5
    assert trained == [(3.0, True), (2.5, False)]


def test_a_frozen_run_has_ended_learning_and_says_what_answers() -> None:
    measured = gpu_training.train_guided(DRY, {})
    assert measured["running"] == {"gate": False, "march": False}
    scene = gpu_training.take_photographs(DRY.city, DRY.capture, CPU)
    run = gpu_training.Run(scene, DRY, homogeneous=False)
    assert run.learning
    run.freeze()
    assert not run.learning and run.ramped == 1.0
