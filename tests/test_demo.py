"""Claims about `leco demo --quick`, in a few seconds."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import ticking_demo
from forked_commands import ForkedCommands
from PIL import Image
from ticking_demo import SECONDS, STEPS

from leco_plugin.occupancy import Occupancy

OCCUPANCY = {
    *("params", "bytes", "train_seconds", "empty_fraction", "lost_mass", "threshold"),
    *("lost_surface_mass", "image_price_db", "kept_surface_recall", "calibrated_threshold"),
}
RUN = {
    *("method", "sampler", "seed", "steps", "train_seconds", "psnr", "ssim", "lpips"),
    *("image_psnr", "flip"),
    *("samples_per_ray", "field_queries_per_ray", "render_seconds_per_image"),
    *("peak_memory_bytes", "curve"),
}


@pytest.mark.parametrize(("can_forget", "peak"), [(True, 7), (False, None)])
def test_a_run_has_the_peak_of_its_own_memory_or_none(
    monkeypatch: pytest.MonkeyPatch, can_forget: bool, peak: int | None
) -> None:
    """The kernel's mark is of the whole process, in which the demo makes two runs."""
    from leco_plugin import demo
    from leco_plugin.evaluation.timed_run import TimedRun

    made = TimedRun("a", "b", 0, peak_memory_bytes=7, peak_process_bytes=7)
    order: list[str] = []
    monkeypatch.setattr(demo, "forget_peaks", lambda: order.append("forget") or can_forget)
    monkeypatch.setattr(demo, "timed_run", lambda *_, **__: order.append("run") or (made, None))
    run, _ = demo.run_with_peaks(None, demo.Budget(1.0), sampler="b")
    assert order == ["forget", "run"]
    assert (run.peak_memory_bytes, run.peak_process_bytes) == (peak, peak)


def test_the_never_frozen_run_skips_nothing_as_in_charts() -> None:
    from leco_plugin import demo
    from leco_plugin.chart.contender import config_of
    from leco_plugin.chart.methods import NEVER_FROZEN

    guided = demo._config(Path("city"), Path("out"), 75.0)
    ours = demo.never_frozen(guided, 123).pipeline.model
    theirs = config_of(NEVER_FROZEN, Path("city"), Path("out")).pipeline.model
    assert (ours.schedule.learn_steps, ours.schedule.learn_share) == (123, 0.0)
    assert guided.pipeline.model.schedule.freeze and not ours.schedule.freeze
    assert replace(ours, schedule=theirs.schedule) == theirs


@pytest.mark.parametrize(("seconds", "share"), [(75.0, 0.5), (150.0, 1.0), (600.0, 1.0)])
def test_a_short_demo_learns_for_fewer_steps_and_a_long_one_for_no_more(
    seconds: float, share: float
) -> None:
    from leco_plugin import demo
    from leco_plugin.method_configs import leco_occupancy

    usual, made = leco_occupancy.config, demo._config(Path("city"), Path("out"), seconds)
    steps, learned = (each.pipeline.model.schedule.learn_steps for each in (usual, made))
    assert learned == share * steps


@pytest.mark.slow
@pytest.mark.xdist_group("commands")
def test_the_demo_reports_both_runs_in_the_agreed_form(
    command: ForkedCommands, tmp_path: Path
) -> None:
    """Its clock counts steps: no machine is too slow. `test_clock.py` tests the real one."""
    from leco_plugin.demo import summary

    asked = ["demo", "--quick", "--seconds", SECONDS, "--out", tmp_path]
    command("python", ticking_demo.__file__, *asked)
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["format"] == 1 and report["scene"]["blocks"] == 1
    assert {"date", "commit", "sources"} <= report["made"].keys()
    assert report["made"]["command"] == "leco demo --quick --seconds 0.3"
    assert {"machine", "scene", "occupancy", "runs"} <= report.keys()
    assert report["occupancy"].keys() >= OCCUPANCY
    methods = [(run["method"], run["sampler"]) for run in report["runs"]]
    assert methods == [
        ("leco-occupancy", "learned-occupancy"),
        ("leco-occupancy-never-frozen", "dense"),
    ]
    guided, other = report["runs"]
    for run in (guided, other):
        assert run.keys() >= RUN
        assert run["train_seconds"] >= SECONDS
        assert 0.5 * STEPS <= run["steps"] <= STEPS
        assert run["curve"][-1][0] == pytest.approx(run["train_seconds"], abs=0.01)
    assert guided["freeze_seconds"] is not None and other["freeze_seconds"] is None

    file = tmp_path / "occupancy.safetensors"
    assert report["occupancy"]["bytes"] == file.stat().st_size
    assert report["occupancy"]["params"] == Occupancy.load(file).num_params
    assert report["seconds_in_all"] > sum(run["train_seconds"] for run in report["runs"])
    for name in ("chart.png", "picture.png"):
        assert np.asarray(Image.open(tmp_path / name)).std() > 10
    assert any("leco-occupancy-never-frozen" in line for line in summary(report))
    assert "mean nothing" in summary(report)[-2]
    report["scene"]["blocks"] = 3
    assert "mean nothing" not in "".join(summary(report))
    assert summary(report)[-1] == f"all of it took {report['seconds_in_all'] / 60:.1f} minutes"
