"""Fixtures that more than one test file uses, and the markers that skip what this machine lacks."""

from __future__ import annotations

import multiprocessing.forkserver
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import checkout  # noqa: F401
import pytest
import quick_imports  # noqa: F401
import quick_seeds  # noqa: F401
import tiny_scene as tiny_scene_writer
import torch

if TYPE_CHECKING:
    from forked_commands import ForkedCommands


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


@pytest.fixture
def scene(tiny_scene: Path, tmp_path: Path) -> Path:
    """The tiny scene, for one test to change.

    Not in `tests/scenes`: pytest 9.1 forgets fixtures of a folder when a file of `tests` is named
    between two of its files (pytest-dev/pytest#14971).
    """
    return Path(shutil.copytree(tiny_scene, tmp_path / "scene"))


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


@pytest.fixture(scope="session")
def command(elsewhere: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[ForkedCommands]:
    """Commands on a machine that has just been set up, and on which `elsewhere` is installed.

    Tests that use it share the group `commands`, so that one process imports nerfstudio for all.
    """
    from bare_machine import variables
    from forked_commands import ForkedCommands

    environment = variables(tmp_path_factory.mktemp("environment"))
    paths = [str(elsewhere), *filter(None, [environment.get("PYTHONPATH")])]
    environment["PYTHONPATH"] = os.pathsep.join(paths)
    with ForkedCommands(environment, tmp_path_factory.mktemp("working_directory")) as command:
        yield command


@pytest.fixture(scope="session")
def forks() -> None:
    """The server of `multiprocessing` whose forks find all imported that they run.

    A process has only one, with the modules that its first user names. Tests that use it share the
    group `forks`, so that nerfstudio is imported once for all. A fork has two threads.
    """
    ours = ["mortal_training", "data_parallel_training"]
    context = multiprocessing.get_context("forkserver")
    models = ["leco_plugin.hosts.guided", "nerfstudio.models.instant_ngp"]  # what ranks build
    context.set_forkserver_preload(
        ["quick_imports", "quick_seeds", *ours, "leco_plugin.conformance.cases", *models]
    )
    paths = [str(Path(__file__).parent), *filter(None, [os.environ.get("PYTHONPATH")])]
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", os.pathsep.join(paths))
        patch.setenv("PYTHONWARNINGS", "ignore")
        patch.setenv("OMP_NUM_THREADS", "2")
        multiprocessing.forkserver.ensure_running()


@pytest.fixture(scope="session", autouse=True)
def small_cells() -> Iterator[None]:
    """Cell caches of the default size, which take seconds to build, are a sixteenth of it.

    What is tested of cells names a size of its own, and a command has those of its user.
    """
    from leco_plugin.samplers import estimator

    def build(occupancy: Any, budget: int, **options: Any) -> Any:
        if budget == 1 << 20:
            budget, options = 1 << 16, {"check_points": 1 << 16, **options}
        return build_cache(occupancy, budget=budget, **options)

    build_cache = estimator.build_cache
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(estimator, "build_cache", build)
        yield


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
def printed(capsys: pytest.CaptureFixture[str]) -> Callable[[], str]:
    """Gives what was printed since it was asked last, as one line of words."""
    return lambda: " ".join("".join(capsys.readouterr()).split())


@pytest.fixture
def refused(capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Runs `leco` with arguments that it refuses; returns the one line that it then says."""
    from leco_plugin import cli

    def line(*arguments: object) -> str:
        capsys.readouterr()
        assert cli.main([str(argument) for argument in arguments]) == 2, arguments
        error = capsys.readouterr().err
        assert error.startswith("leco: ") and error.count("\n") == 1, error
        return error

    return line


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
