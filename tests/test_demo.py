"""Claims about `leco demo --quick`, in a few seconds."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from leco_plugin.occupancy import Occupancy

SECONDS = 3.0
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


@pytest.mark.slow
def test_the_demo_reports_both_runs_in_the_agreed_form(tmp_path: Path) -> None:
    from leco_plugin.demo import summary

    # a process of its own: nerfstudio's trainer warns of much that is an error in tests
    command = "import sys; from leco_plugin.cli import main; sys.exit(main(sys.argv[1:]))"
    asked = ["demo", "--quick", "--seconds", str(SECONDS), "--out", str(tmp_path)]
    arguments = [sys.executable, "-c", command, *asked]
    done = subprocess.run(arguments, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["format"] == 1 and report["scene"]["blocks"] == 1
    assert {"date", "commit", "sources"} <= report["made"].keys()
    assert report["made"]["command"] == "leco demo --quick"
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
        assert run["curve"][-1][0] == pytest.approx(run["train_seconds"], abs=0.01)
    assert guided["freeze_seconds"] is not None and other["freeze_seconds"] is None

    file = tmp_path / "occupancy.safetensors"
    assert report["occupancy"]["bytes"] == file.stat().st_size
    assert report["occupancy"]["params"] == Occupancy.load(file).num_params
    assert report["seconds_in_all"] > sum(run["train_seconds"] for run in report["runs"])
    for name in ("chart.png", "picture.png"):
        assert np.asarray(Image.open(tmp_path / name)).std() > 10
    assert any("leco-occupancy-never-frozen" in line for line in summary(report))
    assert summary(report)[-1] == f"all of it took {report['seconds_in_all'] / 60:.1f} minutes"
