"""The whole way through nerfstudio's own commands: train, resume, evaluate, render, export, view.

They can reach no network and find no LPIPS weights, as on a machine that has just been set up. The
first one is a process of its own; the others are forks, for each process takes some six seconds to
import nerfstudio.
"""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import subprocess
import sys
import urllib.request
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import telling_viewer
import torch
import trimesh
from bare_machine import variables
from forked_commands import ForkedCommands
from PIL import Image

from leco_plugin.learning.history import GateHistory, as_learned
from leco_plugin.occupancy import Occupancy

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("commands")]

METHOD = "leco-occupancy"

# As few steps and as small a gate as still pass through every phase: each command asks the gate
# about a few million places before it renders.
STEPS = 30
TINY = [
    f"--max-num-iterations={STEPS}",
    "--pipeline.datamanager.train-num-rays-per-batch=256",
    "--pipeline.datamanager.eval-num-rays-per-batch=256",
    "--pipeline.model.calibration.rays=512",
    "--pipeline.model.schedule.steps-per-record=5",
    "--pipeline.model.sizes.candidates=64",
    "--pipeline.model.sizes.learn-candidates=32",
    "--pipeline.model.sizes.field.encoding.log2-table=12",
    "--pipeline.model.sizes.gate.encoding.octaves=1",
    "--pipeline.model.sizes.gate.layers=1",
    "--pipeline.model.sizes.gate.width=8",
]

OUTPUTS = {"rgb", "depth", "accumulation", "occupancy", "expert", "samples_per_ray"}

Runner = Callable[..., str]


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Of a process without network, without downloaded weights, on one core."""
    return variables(tmp_path_factory.mktemp("environment"))


def path_of(name: str) -> str:
    """Path of one of nerfstudio's commands in the environment that runs the tests."""
    return str(Path(sys.executable).with_name(name))


@pytest.fixture(scope="module")
def alone(environment: dict[str, str], tmp_path_factory: pytest.TempPathFactory) -> Runner:
    """Runs a command of its own to its end, and returns what it printed."""
    folder = tmp_path_factory.mktemp("working_directory")

    def run(name: str, *arguments: object) -> str:
        finished = subprocess.run(
            [path_of(name), *map(str, arguments)],
            env=environment,
            cwd=folder,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=120,
        )
        printed = finished.stdout
        assert finished.returncode == 0, f"{name} failed:\n{printed[-4000:]}"
        assert "Downloading" not in printed
        return printed

    return run


@pytest.fixture(scope="module")
def run(command: ForkedCommands) -> Runner:
    """Runs a command in a fork to its end, and returns what it printed."""

    def run(name: str, *arguments: object) -> str:
        printed = command(name, *arguments)
        assert "Downloading" not in printed
        return printed

    return run


def train(run: Runner, output: Path, scene: Path, *arguments: object) -> str:
    return run(
        *("ns-train", METHOD, "--data", scene, *TINY, *arguments, "--vis", "tensorboard"),
        *("--output-dir", output, "--experiment-name", "tiny", "--timestamp", "run"),
    )


def checkpoints(folder: Path) -> list[int]:
    """Steps of the checkpoints in a run's folder."""
    found = (folder / "nerfstudio_models").iterdir()
    return sorted(int(re.fullmatch(r"step-(\d{9})\.ckpt", path.name)[1]) for path in found)


@pytest.fixture(scope="module")
def trained(alone: Runner, tiny_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a finished run."""
    output = tmp_path_factory.mktemp("outputs")
    train(alone, output, tiny_scene)
    return output / "tiny" / METHOD / "run"


def test_training_leaves_a_config_a_checkpoint_and_the_occupancy(trained: Path) -> None:
    assert (trained / "config.yml").is_file()
    assert checkpoints(trained) == [STEPS - 1]
    occupancy = Occupancy.load(trained / "occupancy.safetensors")
    asked = occupancy.query(torch.rand(10, 3) - 0.5)
    assert ((asked >= 0) & (asked <= 1)).all()
    history = GateHistory.load(
        trained / "occupancy_history.safetensors", as_learned(occupancy).gate
    )
    assert history.steps[0] == 0 and len(history) >= 3
    for name, value in occupancy.gate.state_dict().items():
        assert torch.equal(history.weights(-1)[name], value)


def test_resuming_goes_on_at_the_next_step(
    trained: Path, run: Runner, tiny_scene: Path, tmp_path: Path
) -> None:
    train(run, tmp_path, tiny_scene, "--load-dir", trained / "nerfstudio_models")
    # max-num-iterations counts the steps of this process, not those of the run
    assert checkpoints(tmp_path / "tiny" / METHOD / "run") == [2 * STEPS - 1]


def test_ns_eval_writes_figures_that_are_json(trained: Path, run: Runner, tmp_path: Path) -> None:
    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} is no JSON")

    result = tmp_path / "eval.json"
    printed = run("ns-eval", "--load-config", trained / "config.yml", "--output-path", result)
    figures = json.loads(result.read_text(), parse_constant=refuse)["results"]
    assert figures["psnr"] > 5
    assert -1 <= figures["ssim"] <= 1
    assert not any("lpips" in name for name in figures)
    assert printed.count("LPIPS is left out") == 1


def test_ns_render_dataset_draws_every_output(trained: Path, run: Runner, tmp_path: Path) -> None:
    run("ns-render", "dataset", "--load-config", trained / "config.yml", "--output-path", tmp_path)
    drawn = {folder.name: sorted(folder.iterdir()) for folder in (tmp_path / "test").iterdir()}
    assert drawn.keys() >= OUTPUTS | {"gt-rgb"}
    for name in OUTPUTS:
        assert len(drawn[name]) == 2
        with Image.open(drawn[name][0]) as image:
            assert image.size == (32, 32)


def test_ns_render_interpolate_draws_frames(trained: Path, run: Runner, tmp_path: Path) -> None:
    run(
        *("ns-render", "interpolate", "--load-config", trained / "config.yml"),
        *("--output-path", tmp_path / "path", "--output-format", "images"),
        *("--interpolation-steps", 2, "--rendered-output-names", "rgb", "depth"),
    )
    frames = sorted((tmp_path / "path").iterdir())
    assert len(frames) == 2
    with Image.open(frames[0]) as frame:
        assert frame.size == (64, 32)


def test_ns_export_writes_a_point_cloud(trained: Path, run: Runner, tmp_path: Path) -> None:
    try:
        import open3d  # noqa: F401
    except ImportError as error:
        pytest.skip(f"ns-export imports open3d: {error} (on Debian: apt-get install libusb-1.0-0)")
    run(
        *("ns-export", "pointcloud", "--load-config", trained / "config.yml"),
        *("--output-dir", tmp_path, "--num-points", 500, "--num-rays-per-batch", 512),
        *("--normal-method", "open3d"),
    )
    cloud = trimesh.load(tmp_path / "point_cloud.ply")
    assert len(cloud.vertices) > 100
    assert np.isfinite(cloud.vertices).all()


def test_ns_viewer_loads_the_run_and_answers(trained: Path, command: ForkedCommands) -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    arguments = ["--load-config", trained / "config.yml", "--viewer.websocket-port", port]
    direct = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    viewer = command.start("python", telling_viewer.__file__, *arguments)
    try:
        # The page is there before the scene is; a viewer that cannot set it up ends before.
        viewer.until(lambda: telling_viewer.READY in viewer.log.read_text())
        with direct.open(f"http://127.0.0.1:{port}", timeout=60) as page:
            assert page.status == 200
        assert "Done loading checkpoint" in viewer.log.read_text()
    finally:
        os.kill(viewer.process, signal.SIGKILL)
        viewer.wait()
