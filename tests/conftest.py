"""Fixtures that more than one test file uses, and the markers that skip what this machine lacks."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import tiny_scene as tiny_scene_writer
import torch


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    without_scenes = pytest.mark.skip(reason="LECO_SCENES does not name a folder of real scenes")
    without_gpu = pytest.mark.skip(reason="there is no CUDA device")
    for item in items:
        if (
            item.get_closest_marker("scenes")
            and not Path(os.environ.get("LECO_SCENES", "/nowhere")).is_dir()
        ):
            item.add_marker(without_scenes)
        if item.get_closest_marker("gpu") and not torch.cuda.is_available():
            item.add_marker(without_gpu)


@pytest.fixture(scope="session")
def tiny_scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a scene of nine 32 x 32 images in nerfstudio's format."""
    return tiny_scene_writer.write(tmp_path_factory.mktemp("tiny_scene") / "ball")


@pytest.fixture(scope="session")
def known_run(tiny_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a run of `leco-occupancy`: its frozen gate is the ball, its field is opaque."""
    from ball_occupancy import THEIR_MARCH, ball_of_the_tiny_scene
    from tiny_run import tiny_trainer

    from leco_plugin.scenes.frames import frame_of

    outputs, gate = tmp_path_factory.mktemp("outputs"), ball_of_the_tiny_scene().gate.config
    torch.manual_seed(0)  # what a shrunk gate loses of an untrained field is anything
    trainer = tiny_trainer(tiny_scene, outputs, gate, candidates=64)
    mixture, frame = trainer.pipeline.model.mixture, frame_of(trainer.pipeline.datamanager)
    assert frame is not None
    known = ball_of_the_tiny_scene(frame)
    mixture.gate.load_state_dict(known.gate.state_dict())
    mixture.region.space.load_state_dict(known.space.state_dict())
    with torch.no_grad():
        mixture.field.density_head.bias.fill_(6.0)
    march = zip(
        (mixture.region.near, mixture.region.far, mixture.steps, mixture.cones),
        THEIR_MARCH.values(),
        strict=True,
    )
    for buffer, value in march:
        buffer.fill_(value)
    mixture.freeze(known.threshold, THEIR_MARCH | {"lost_surface_mass": 1e-4})
    mixture.occupancy().save(trainer.base_dir / "occupancy.safetensors")
    trainer.save_checkpoint(0)
    return Path(trainer.base_dir)


@pytest.fixture(scope="session")
def elsewhere(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder in which the package of `tests/elsewhere` is installed, entry points and all."""
    folder = tmp_path_factory.mktemp("elsewhere")
    source, site = folder / "source", folder / "site"
    shutil.copytree(Path(__file__).parent / "elsewhere", source)  # setuptools builds in place
    arguments = ["--no-deps", "--no-build-isolation", "--no-index", "--target", str(site)]
    command = [sys.executable, "-m", "pip", "install", "--disable-pip-version-check", "--quiet"]
    done = subprocess.run(
        [*command, *arguments, str(source)], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    return site


@pytest.fixture
def without_cache(monkeypatch: pytest.MonkeyPatch) -> None:
    """A cell cache takes seconds to build, and is tested where it lives."""

    def refuse(*_: object, **__: object) -> None:
        raise ValueError("no cache in this test")

    monkeypatch.setattr("leco_plugin.samplers.estimator.build_cache", refuse)


@pytest.fixture
def guide() -> Any:
    """A host's guide with the ball for its occupancy."""
    from ball_occupancy import ball

    from leco_plugin.hosts.guide import Guide  # samplers are tested without nerfstudio, too

    made = Guide()
    made.set_occupancy(ball())
    return made


@pytest.fixture
def run_script(tmp_path: Path) -> Callable[..., str]:
    """Runs a script of `benchmarks` to its end, in a folder of the test; returns what it said."""
    root = Path(__file__).resolve().parent.parent

    def run(name: str, *arguments: object) -> str:
        script = ["-W", "ignore", str(root / "benchmarks" / name), *map(str, arguments)]
        done = subprocess.run(
            [sys.executable, *script],
            env=os.environ | {"PYTHONPATH": str(root)},
            cwd=tmp_path,
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    return run


@pytest.fixture(scope="session")
def scenes() -> Path:
    """Folder of real scenes; for tests marked `scenes`."""
    return Path(os.environ["LECO_SCENES"])
