"""What the GPU suite does without a GPU; run by `test_gpu_suite.py`, which counts its lines."""

from __future__ import annotations

import importlib
import importlib.metadata
import json
import runpy
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import gpu
import gpu_counts
import gpu_parts
import gpu_sampling
import gpu_scale
import gpu_training
import pytest
import torch
from gpu_scale import Scale
from sampling_scene import rays_into

from leco_plugin.occupancy import Occupancy
from leco_plugin.samplers import nerfacc_cpu
from leco_plugin.samplers.estimator import LearnedOccupancyEstimator
from leco_plugin.samplers.kernels import fused
from leco_plugin.samplers.marching import March, Rays, march, number

CPU = torch.device("cpu")
DRY = Scale(CPU).dry()


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The results of one dry run."""
    out = tmp_path_factory.mktemp("dry") / "gpu.json"
    assert gpu.main(["--dry-run", "--out", str(out)]) == 0
    yield out
    nerfacc_cpu.uninstall()


@pytest.fixture
def quick(monkeypatch) -> list[str]:
    """A suite of two parts that take no time; the names of those that ran."""
    ran: list[str] = []

    def part(name: str, figures: list[dict[str, object]]) -> gpu.Part:
        def measure(scale: Scale, before: dict[str, object]) -> dict[str, object]:
            ran.append(name)
            return {"figures": figures, "running": {"gate": False, "march": True}}

        return gpu.Part(measure, 10.0)

    reached = {"name": "speed", "value": 3.0, "bar": 2.5, "at_most": False, "reached": True}
    missed = {"name": "memory", "value": 0.7, "bar": 0.5, "at_most": True, "reached": False}
    monkeypatch.setattr(
        gpu, "PARTS", {"one": part("one", [reached, missed]), "two": part("two", [])}
    )
    return ran


def test_a_dry_run_does_every_part(stored: Path) -> None:
    results = json.loads(stored.read_text())
    assert list(results["parts"]) == list(gpu.PARTS) and results["dry"]
    assert results["machine"]["torch"] == torch.__version__
    assert {"driver", "cuda", "device"} <= set(results["machine"])
    assert set(results["code"]) == {"version", "commit", "sources"}
    parts = results["parts"]
    assert "small gate" in parts["correctness"]["running"]
    assert parts["gate"]["running"].keys() == {"small gate", "large gate", "paper gate"}
    assert parts["sampling"]["running"].keys() == {"march, box", "march, unbounded"}
    for name in ("gate", "sampling", "experts", "dense"):
        assert parts[name]["figures"], name
    learned, dense = parts["learned"], parts["dense"]
    assert learned["guided_step"]["peak_bytes"] > 0 and learned["psnr"] > 0.0
    assert dense["seconds"] >= sum(learned["seconds"].values())  # equal time
    names = [figure["name"] for figure in dense["figures"]]
    assert "steps per second: guided / dense" in names and "peak memory: guided / dense" in names


def test_a_grid_keeps_as_much_as_the_gate(stored: Path) -> None:
    kept = json.loads(stored.read_text())["parts"]["sampling"]["kept"]
    for space in ("box", "unbounded"):
        wanted = kept[f"learned, {space}"]
        for name, count in kept.items():
            if name.endswith(space) and "torch grid" in name:
                assert abs(count - wanted) <= 0.25 * wanted  # cells of the dry run are coarse


def test_nothing_is_measured_twice(stored: Path, capsys) -> None:
    before = stored.read_text()
    assert gpu.main(["--dry-run", "--out", str(stored)]) == 0
    assert json.loads(stored.read_text()) == json.loads(before)
    said = capsys.readouterr().out
    assert said.count("measured before") == len(gpu.PARTS) and str(stored) in said


def test_results_of_other_code_or_of_another_machine_are_not_gone_on_with(
    quick: list[str], tmp_path: Path, capsys
) -> None:
    out = tmp_path / "gpu.json"
    gpu.run(DRY, out, dry=True)
    for name in ("code", "machine", "dry"):
        out.write_text(json.dumps({**json.loads(out.read_text()), name: "other"}))
        quick.clear()
        gpu.run(DRY, out, dry=True)
        assert quick == ["one", "two"]
    assert capsys.readouterr().out.count("everything is measured anew") == 3
    out.write_text("{")
    gpu.run(DRY, out, dry=True)
    assert "holds no results" in capsys.readouterr().out


def test_no_part_begins_that_would_pass_the_ten_minutes(
    quick: list[str], monkeypatch, capsys
) -> None:
    monkeypatch.setattr(gpu, "LIMIT", 5.0)
    gpu.run(DRY, None, dry=False)
    assert quick == [] and "is left for the next run" in capsys.readouterr().err


def test_all_parts_fit_into_ten_minutes() -> None:
    assert sum(part.seconds for part in gpu.PARTS.values()) <= gpu.LIMIT == 600.0


def test_a_dry_run_gives_no_verdicts(quick: list[str], capsys) -> None:
    assert gpu.main(["--dry-run"]) == 0
    said = capsys.readouterr().out
    assert "one ..." in said and "two: " in said and "mean nothing" in said
    assert "reached" not in said.lower() and "torch answered" not in said


def test_the_end_says_where_the_results_are(quick: list[str], tmp_path: Path, capsys) -> None:
    out = tmp_path / "gpu.json"
    assert gpu.run_suite(DRY, out, dry=False) == 0
    assert f"all parts are measured; they are in {out}" in capsys.readouterr().out
    stored = json.loads(out.read_text())
    assert set(stored["parts"]["one"]) == {"figures", "running", "wall_seconds"}
    assert len(stored["date"]) == len("2026-01-01")


def full(*_: object) -> None:
    raise torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 2 GiB.\nmore")


def test_a_part_that_does_not_fit_a_card_is_left_out(
    quick: list[str], monkeypatch, tmp_path: Path, capsys
) -> None:
    monkeypatch.setitem(gpu.PARTS, "one", gpu.Part(full, 10.0))
    results = gpu.run(DRY, tmp_path / "gpu.json", dry=False)
    assert quick == ["two"]
    assert results["parts"]["one"]["left_out"] == "CUDA out of memory. Tried to allocate 2 GiB."
    assert "one: LEFT OUT, CUDA out of memory" in capsys.readouterr().out
    assert "left_out" in gpu_training.train_dense(DRY, {"learned": results["parts"]["one"]})


def test_a_small_card_decides_about_fewer_positions(monkeypatch) -> None:
    occupancy = gpu_parts.random_occupancy(gpu_parts.gates()["small"], CPU)
    monkeypatch.setattr(gpu_parts, "FEWEST", 100)
    monkeypatch.setattr(Occupancy, "query", lambda _, places: full() if len(places) > 200 else None)
    assert len(gpu_parts.places_that_fit(occupancy, DRY)) == 128
    monkeypatch.setattr(Occupancy, "query", full)
    with pytest.raises(torch.cuda.OutOfMemoryError):
        gpu_parts.places_that_fit(occupancy, DRY)


def test_figures_of_a_twin_are_said_to_be_its_own(quick: list[str], capsys) -> None:
    gpu.run(DRY, None, dry=False)
    said = capsys.readouterr().out
    assert "torch answered in place of the fused gate" in said
    assert "speed: 3 (>= 2.5) reached" in said and "memory: 0.7 (<= 0.5) NOT REACHED" in said


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU to be measured")
def test_without_a_gpu_nothing_is_measured_and_nothing_written(quick: list[str], capsys) -> None:
    before = sorted(gpu.RESULTS.rglob("*"))
    assert gpu.main([]) == 2 and "no CUDA device here" in capsys.readouterr().err
    assert quick == [] and sorted(gpu.RESULTS.rglob("*")) == before


def test_without_the_drivers_version_nothing_is_measured(
    quick: list[str], monkeypatch, tmp_path: Path, capsys
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(gpu, "driver", lambda: None)
    monkeypatch.setattr(gpu, "machine", dict)
    assert gpu.main([]) == 2 and quick == []
    assert "put it on the PATH" in capsys.readouterr().err
    assert gpu.main(["--out", str(tmp_path / "gpu.json")]) == 0 and quick == ["one", "two"]


def test_a_wrong_kernel_ends_the_run_in_one_line(monkeypatch, capsys) -> None:
    def wrong(*_: object) -> None:
        raise gpu_parts.Disagreement("the fused gate is wrong")

    monkeypatch.setattr(gpu, "PARTS", {"correctness": gpu.Part(wrong, 10.0)})
    assert gpu.main(["--dry-run"]) == 1
    assert capsys.readouterr().err.startswith("the fused gate is wrong: figures of")


def test_a_machine_without_triton_says_so(monkeypatch) -> None:
    def absent(name: str) -> str:
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(importlib.metadata, "version", absent)
    assert gpu.machine()["triton"] is None


@pytest.mark.parametrize("name", ["gpu-card-20260101.json", "charts/gpu.json", "../results/a"])
def test_a_dry_run_leaves_nothing_among_the_results(name: str, quick: list[str]) -> None:
    with pytest.raises(SystemExit):
        gpu.main(["--dry-run", "--out", str(gpu.RESULTS / name)])
    assert quick == []


def test_a_kernel_that_was_changed_is_other_code(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(gpu, "ROOT", tmp_path)
    kernel = tmp_path / "leco_plugin" / "samplers" / "gate_kernel.py"
    kernel.parent.mkdir(parents=True)
    found = []
    for text in ("one", "two", "one"):
        kernel.write_text(text)
        found.append(gpu.code())
    assert found[0] == found[2] != found[1]


def test_a_file_is_named_after_the_card_and_the_day(monkeypatch) -> None:
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda: "NVIDIA H100 80GB HBM3")
    assert gpu.results_path().name.startswith("gpu-nvidia-h100-80gb-hbm3-2")


def test_the_driver_is_what_its_tool_says(monkeypatch) -> None:
    monkeypatch.setattr(shutil, "which", lambda name: None)
    assert gpu.driver() is None
    monkeypatch.setattr(shutil, "which", lambda name: name)
    answer = SimpleNamespace(stdout="570.86.15\n570.86.15\n", returncode=0)
    monkeypatch.setattr(subprocess, "run", lambda *_, **__: answer)
    assert gpu.driver() == "570.86.15"
    answer.stdout, answer.returncode = "NVIDIA-SMI has failed", 9
    assert gpu.driver() is None


def test_a_wrong_gate_ends_the_run(monkeypatch) -> None:
    def wrong(occupancy: object, positions: torch.Tensor) -> torch.Tensor | None:
        return None if fused._off else torch.ones(len(positions), dtype=torch.bool)

    monkeypatch.setattr(fused, "decide", wrong)
    with pytest.raises(gpu_parts.Disagreement, match="the fused gate is wrong"):
        gpu_parts.correctness(DRY, {})


def test_a_wrong_march_ends_the_run(monkeypatch) -> None:
    def wrong(*_: object) -> tuple[torch.Tensor, ...] | None:
        return None if fused._off else (torch.tensor([0]), torch.zeros(1), torch.ones(1))

    monkeypatch.setattr(fused, "march", wrong)
    with pytest.raises(gpu_parts.Disagreement, match="the fused march is wrong"):
        gpu_parts.correctness(DRY, {})


@pytest.mark.parametrize(
    ("missing", "named", "compared"),
    [("nerfacc", "nerfacc", "torch grid"), ("leco_plugin.samplers.grid", "grids", None)],
)
def test_without_nerfacc_what_is_left_is_compared(
    missing: str, named: str, compared: str | None, monkeypatch, capsys
) -> None:
    importlib.import_module("leco_plugin.samplers.grid")  # needs nerfacc while it is imported
    monkeypatch.setitem(sys.modules, missing, None)
    names = [figure["name"] for figure in gpu_sampling.sampling(DRY, {})["figures"]]
    assert f"no comparison with {named}" in capsys.readouterr().out
    assert not any("nerfacc" in name for name in names)
    assert any("torch grid" in name for name in names) == (compared is not None)


def test_a_gate_that_no_kernel_takes_is_said_to_be_answered_by_torch(monkeypatch) -> None:
    def decided(occupancy: Occupancy, positions: torch.Tensor) -> torch.Tensor | None:
        fits = occupancy.gate.config.width <= 128 and not fused._off
        return occupancy.query(positions) >= occupancy.threshold_value if fits else None

    monkeypatch.setattr(fused, "decide", decided)
    running = gpu_parts.gate_throughput(DRY, {})["running"]
    assert running == {"small gate": True, "large gate": True, "paper gate": False}


def test_a_guided_run_skips(stored: Path) -> None:
    scene = gpu_training.take_photographs(DRY.city, DRY.capture, CPU)
    run = gpu_training.Run(scene, DRY, homogeneous=False)
    rays = run.rays_of(scene.test)
    everything = run.intervals_of(rays, 16, jittered=False)
    run.freeze()
    assert run.estimator is not None
    run.estimator.occupancy.threshold_value.fill_(1.0)
    kept = run.intervals_of(rays, 16, jittered=False)
    assert len(kept.t_starts) == len(rays.origins) < len(everything.t_starts)  # backdrops only


def test_the_floors_on_paper_are_printed(capsys) -> None:
    runpy.run_path(str(gpu.RESULTS.parent / "gpu_paper.py"), run_name="__main__")
    assert "| paper | 305,152 | H100 SXM |" in capsys.readouterr().out


def test_the_counts_on_paper_are_printed(monkeypatch, capsys) -> None:
    small = replace(DRY, cache_bytes=1 << 20)
    monkeypatch.setattr(gpu_scale, "Scale", lambda device: small)
    runpy.run_path(str(gpu.RESULTS.parent / "gpu_counts.py"), run_name="__main__")
    assert capsys.readouterr().out.startswith(f"Counted(rays={DRY.rays}, candidates=")


@pytest.mark.parametrize("cone_angle", [0.0, 0.01])
def test_stretches_are_those_in_which_the_twin_leaves_candidates_open(cone_angle: float) -> None:
    *_, (_, occupancy, _) = gpu_sampling.scenes(DRY)
    cache = LearnedOccupancyEstimator(occupancy, tolerance=1.0).cache
    assert cache is not None
    origins, directions = rays_into(occupancy.space, 20)
    rays = Rays(origins, directions, torch.zeros(20), torch.linspace(0.0, 4.0, 20))
    rule = March(0.02, cone_angle)
    ray_indices, t_starts, t_ends = march(rays, rule)
    middles = ((t_starts + t_ends) * 0.5)[:, None]
    _, left_open = cache.decide(origins[ray_indices] + directions[ray_indices] * middles)
    before = (
        torch.bincount(ray_indices, minlength=20)
        .cumsum(0)
        .roll(1)
        .index_fill_(0, torch.tensor([0]), 0)
    )
    numbers = torch.arange(len(ray_indices)) - before[ray_indices]
    stretches = ray_indices * 1000 + numbers.div(gpu_counts.STEPS, rounding_mode="floor")
    begun, near, asked = gpu_counts.stretches(cache, number(rays, rule))
    assert begun == len(stretches.unique()) >= near >= asked > 0
    assert asked == len(stretches[left_open].unique())


def test_stretches_are_as_long_as_the_kernels() -> None:
    pytest.importorskip("triton")
    from leco_plugin.samplers.kernels.march_kernel import STEPS

    assert gpu_counts.STEPS == STEPS


def test_the_suite_is_a_command(monkeypatch, quick: list[str]) -> None:
    monkeypatch.setattr(sys, "argv", ["gpu.py", "--help"])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(gpu.RESULTS.parent / "gpu.py"), run_name="__main__")
    assert ended.value.code == 0


def test_a_run_that_was_cut_off_at_midnight_goes_on_in_its_own_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(gpu, "RESULTS", tmp_path)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda: "NVIDIA Some Card")
    today = gpu.results_path()
    assert today.name.startswith("gpu-nvidia-some-card-")
    yesterdays = tmp_path / "gpu-nvidia-some-card-20010101.json"
    contents = {"code": gpu.code(), "parts": {next(iter(gpu.PARTS)): {}}}
    yesterdays.write_text(json.dumps(contents))
    assert gpu.results_path() == yesterdays
    for other in ({"code": {}}, {"parts": dict.fromkeys(gpu.PARTS)}):
        yesterdays.write_text(json.dumps(contents | other))
        assert gpu.results_path() == today
    yesterdays.write_text("cut")
    assert gpu.results_path() == today
