"""Guided hosts through whole runs: swapped or learned first, trained, resumed, evaluated, rendered.

The hosts are two of nerfstudio, and those of a package that this one knows by entry points alone.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
import yaml
from ball_occupancy import ball_of_the_tiny_scene
from forked_commands import ForkedCommands
from PIL import Image
from small_hosts import NERFACTO, NGP, QUICK, SMALL, SWITCH_NERF, sizes

from leco_plugin.hosts.guided import GuidedModelConfig
from leco_plugin.occupancy import Occupancy
from leco_plugin.studio.checkpoints import allow_checkpoint_globals
from leco_plugin.studio.trainer import AtomicTrainer

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("commands")]

NAME = "occupancy.safetensors"
STEPS = 6
HOSTS = ["elsewhere-packed", "elsewhere-proposal", "switch-nerf", "nerfacto", "instant-ngp"]
A_SEAM_AND_OURS = pytest.mark.parametrize(
    "swapped", [*HOSTS[:3], pytest.param(HOSTS[3], marks=pytest.mark.long)], indirect=True
)
"""One host of each seam, and ours. `nerfacto` has the second one's seam, and a process that reads
images, which takes ten seconds to start. pytest needs the first of `HOSTS`, in order, to share the
runs."""
LEARNING = [
    "calibration.rays=256",
    "sizes.candidates=32",
    "sizes.learn-candidates=16",
    "sizes.field.encoding.log2-table=10",
    "sizes.gate.encoding.octaves=1",
    "sizes.gate.layers=1",
    "sizes.gate.width=8",
]
METHODS = {
    "leco-ngp": sizes(NGP, "pipeline.model.host"),
    "leco-nerfacto": [
        *sizes(NERFACTO, "pipeline.model.host"),
        "--pipeline.datamanager.train-num-rays-per-batch=128",
    ],
    "leco-switch-nerf": [
        *sizes(SWITCH_NERF, "pipeline.model.host"),
        "--pipeline.datamanager.train-num-rays-per-batch=128",
    ],
}


@dataclass
class Runs:
    """Commands and a folder for what they leave."""

    command: ForkedCommands
    scene: Path
    outputs: Path

    def arguments(self, name: str, steps: int = STEPS) -> list[str]:
        """Of a training run of the tiny scene whose folder has this name."""
        return [
            *("--data", str(self.scene), *QUICK, f"--max-num-iterations={steps}"),
            *("--output-dir", str(self.outputs), "--experiment-name", "tiny", "--timestamp", name),
        ]

    def folder(self, method: str, name: str) -> Path:
        return self.outputs / "tiny" / method / name

    def swap(self, method: str, occupancy: Path, *options: object, name: str = "run") -> Path:
        """Trains with the sampler swapped; returns the folder of the run."""
        arguments = [*self.arguments(name), *SMALL[method]]
        self.command("leco", "swap", method, "--occupancy", occupancy, *options, "--", *arguments)
        return self.folder(method, name)

    def evaluate(self, folder: Path) -> dict[str, float]:
        """What ns-eval finds, without a flag but the run's own config."""
        result = folder / "eval.json"
        self.command("ns-eval", "--load-config", folder / "config.yml", "--output-path", result)
        figures: dict[str, float] = json.loads(result.read_text(), parse_constant=refuse)["results"]
        return figures


def refuse(constant: str) -> None:
    raise AssertionError(f"{constant} is no JSON")


@pytest.fixture(scope="module")
def runs(
    command: ForkedCommands,
    elsewhere: Path,
    tiny_scene: Path,
    tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[Runs]:
    allow_checkpoint_globals()
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(elsewhere)
        yield Runs(command, tiny_scene, tmp_path_factory.mktemp("outputs"))


def checkpoint(folder: Path) -> dict[str, Any]:
    """The only checkpoint of a run."""
    (path,) = (folder / "nerfstudio_models").iterdir()
    loaded: dict[str, Any] = torch.load(path)
    return loaded


def gate_of(folder: Path) -> dict[str, torch.Tensor]:
    """The frozen occupancy in a run's checkpoint."""
    prefix = "_model.leco_guide.occupancy."
    state = checkpoint(folder)["pipeline"]
    return {name.removeprefix(prefix): state[name] for name in state if name.startswith(prefix)}


def assert_same(found: dict[str, torch.Tensor], expected: dict[str, torch.Tensor]) -> None:
    assert found.keys() == expected.keys()
    assert all(torch.equal(found[name], expected[name]) for name in expected)


def last_line(printed: str) -> str:
    """What a command that refused its input said; it has neither trained nor raised."""
    assert "Traceback" not in printed and "Training Finished" not in printed, printed[-4000:]
    return printed.strip().splitlines()[-1]


@pytest.fixture(scope="module", params=HOSTS)
def swapped(
    request: pytest.FixtureRequest, runs: Runs, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """Folder of a run with a swapped sampler, whose occupancy has been deleted since."""
    file = tmp_path_factory.mktemp("occupancy") / NAME
    ball_of_the_tiny_scene().save(file)
    report = file.with_name("swap.json")
    folder = runs.swap(request.param, file, "--json", report)
    facts = json.loads(report.read_text())
    assert facts.pop("format") == 1
    assert facts == {
        "method": request.param,
        "sampler": "learned-occupancy",
        "options": {},
        "codes": "small",
        "folder": str(folder),
    }
    file.unlink()
    return folder


def test_swapping_leaves_a_run_that_is_guided(swapped: Path) -> None:
    config = yaml.load((swapped / "config.yml").read_text(), Loader=yaml.Loader)
    assert isinstance(config.pipeline.model, GuidedModelConfig)
    assert config._target is AtomicTrainer
    assert checkpoint(swapped)["step"] == STEPS - 1
    left = Occupancy.load(swapped / NAME)
    assert_same(dict(left.state_dict()), dict(ball_of_the_tiny_scene().state_dict()))
    assert_same(gate_of(swapped), dict(left.state_dict()))
    stored = checkpoint(swapped)["pipeline"]["_model.leco_guide._extra_state"]
    assert stored["report"] == left.report


def test_ns_eval_opens_it(swapped: Path, runs: Runs) -> None:
    figures = runs.evaluate(swapped)
    assert figures["psnr"] > 3.0
    assert not any("lpips" in name for name in figures)


@A_SEAM_AND_OURS
def test_ns_render_draws_every_output(swapped: Path, runs: Runs, tmp_path: Path) -> None:
    config = swapped / "config.yml"
    runs.command("ns-render", "dataset", "--load-config", config, "--output-path", tmp_path)
    drawn = {folder.name: sorted(folder.iterdir()) for folder in (tmp_path / "test").iterdir()}
    assert drawn.keys() >= {"rgb", "depth", "accumulation", "gt-rgb"}
    for images in drawn.values():
        assert len(images) == 2
        with Image.open(images[0]) as image:
            assert image.size == (32, 32)


@A_SEAM_AND_OURS
def test_it_is_resumed_from_its_checkpoint_alone(swapped: Path, runs: Runs, tmp_path: Path) -> None:
    config = yaml.load((swapped / "config.yml").read_text(), Loader=yaml.Loader)
    config.load_dir, config.timestamp = swapped / "nerfstudio_models", "resumed"
    (tmp_path / "config.yml").write_text(yaml.dump(config))
    method = swapped.parent.name
    runs.command("ns-train", method, "--load-config", tmp_path / "config.yml")
    resumed = runs.folder(method, "resumed")
    before, after = checkpoint(swapped), checkpoint(resumed)
    assert after["step"] == 2 * STEPS - 1
    assert_same(gate_of(resumed), gate_of(swapped))
    assert Occupancy.load(resumed / NAME).report == Occupancy.load(swapped / NAME).report
    for group, state in before["optimizers"].items():
        old, new = (s["state"].values() for s in (state, after["optimizers"][group]))
        steps = [(int(a["step"]), int(b["step"])) for a, b in zip(old, new, strict=True)]
        assert steps and all(resumed > first for first, resumed in steps)


def test_swapping_again_resumes_a_run(runs: Runs, tmp_path: Path) -> None:
    ball_of_the_tiny_scene().save(tmp_path / NAME)
    first = runs.swap("elsewhere-packed", tmp_path, name="first")
    arguments = [*runs.arguments("second"), "--load-dir", str(first / "nerfstudio_models")]
    runs.command("leco", "swap", "elsewhere-packed", "--occupancy", first, "--", *arguments)
    second = checkpoint(runs.folder("elsewhere-packed", "second"))
    assert second["step"] == 2 * STEPS - 1
    assert int(second["pipeline"]["rays_per_batch"]) >= 64


def test_a_host_without_a_known_seam_is_swapped_by_its_own_adapter(
    runs: Runs, tmp_path: Path
) -> None:
    ball_of_the_tiny_scene().save(tmp_path / NAME)
    folder = runs.swap("elsewhere-places", tmp_path)
    assert runs.evaluate(folder)["psnr"] > 3.0


def test_the_sampler_may_be_another_packages_too(runs: Runs, tmp_path: Path) -> None:
    ball_of_the_tiny_scene().save(tmp_path / NAME)
    folder = runs.swap("elsewhere-packed", tmp_path, "--sampler", "every-second", name="thinned")
    config = yaml.load((folder / "config.yml").read_text(), Loader=yaml.Loader)
    assert config.pipeline.model.occupancy.sampler == "every-second"
    assert runs.evaluate(folder)["psnr"] > 3.0
    refused = runs.command(
        *("leco", "swap", "elsewhere-proposal", "--occupancy", tmp_path),
        *("--sampler", "every-second", "--", *runs.arguments("refused")),
        status=2,
    )
    assert "sampler 'every-second' has nothing for proposal hosts" in last_line(refused)


def test_what_leco_occupancy_leaves_guides_a_host_in_other_coordinates(runs: Runs) -> None:
    runs.command(
        *("ns-train", "leco-occupancy", *runs.arguments("learned", steps=24)),
        *(f"--pipeline.model.{flag}" for flag in LEARNING),
        "--pipeline.datamanager.train-num-rays-per-batch=128",
    )
    learned = runs.folder("leco-occupancy", "learned")
    arguments = [*runs.arguments("smaller"), "nerfstudio-data", "--scale-factor", "0.5"]
    runs.command("leco", "swap", "elsewhere-packed", "--occupancy", learned, "--", *arguments)
    folder = runs.folder("elsewhere-packed", "smaller")
    frame = checkpoint(folder)["pipeline"]["_model.leco_guide.frame"]
    torch.testing.assert_close(frame, 2.0 * torch.eye(3, 4))
    assert runs.evaluate(folder)["psnr"] > 3.0


@pytest.fixture(scope="module", params=METHODS)
def learned_first(request: pytest.FixtureRequest, runs: Runs) -> tuple[Path, str]:
    """Folder of a run that was given no occupancy, with a viewer, and what it printed."""
    method = request.param
    printed = runs.command(
        *("ns-train", method, *runs.arguments("learns"), "--vis=viewer+tensorboard"),
        *METHODS[method],
        *(f"--pipeline.model.occupancy.learning.{flag}" for flag in LEARNING),
        *("--pipeline.model.occupancy.rays=128", "--pipeline.model.occupancy.seconds=1"),
    )
    return runs.folder(method, "learns"), printed


def test_without_a_path_the_occupancy_is_learned_first(
    learned_first: tuple[Path, str], runs: Runs
) -> None:
    folder, printed = learned_first
    assert "occupancy learned in" in printed
    left = Occupancy.load(folder / NAME)
    assert 0.0 < left.report["train_seconds"] < 20.0
    assert_same(gate_of(folder), dict(left.state_dict()))
    assert runs.evaluate(folder)["psnr"] > 3.0


@pytest.mark.parametrize(
    "learned_first",
    ["leco-ngp", pytest.param("leco-nerfacto", marks=pytest.mark.long)],
    indirect=True,
)
def test_ns_export_writes_a_point_cloud(
    learned_first: tuple[Path, str], runs: Runs, tmp_path: Path
) -> None:
    """Not of `leco-switch-nerf`: after so few steps nothing is opaque, and ns-export never ends."""
    try:
        import open3d  # noqa: F401
    except ImportError as error:
        pytest.skip(f"ns-export imports open3d: {error} (on Debian: apt-get install libusb-1.0-0)")
    folder, _ = learned_first
    runs.command(
        *("ns-export", "pointcloud", "--load-config", folder / "config.yml"),
        *("--output-dir", tmp_path, "--num-points", 200, "--num-rays-per-batch", 256),
        *("--normal-method", "open3d", "--remove-outliers", "False"),
    )
    cloud = trimesh.load(tmp_path / "point_cloud.ply")
    assert len(cloud.vertices) >= 200
    assert np.isfinite(cloud.vertices).all()


def test_a_path_may_be_relative_and_a_folder(runs: Runs) -> None:
    (runs.command.folder / "some-run").mkdir()
    ball = ball_of_the_tiny_scene()
    ball.save(runs.command.folder / "some-run" / NAME)
    for method, path in [("leco-ngp", Path("some-run") / NAME), ("leco-nerfacto", "some-run")]:
        runs.command(
            *("ns-train", method, *runs.arguments("relative", steps=2), *METHODS[method]),
            f"--pipeline.model.occupancy.path={path}",
        )
        assert_same(gate_of(runs.folder(method, "relative")), dict(ball.state_dict()))


def another_scene(path: Path) -> None:
    occupancy = ball_of_the_tiny_scene([[1, 0, 0, 50.0], [0, 1, 0, 50.0], [0, 0, 1, 50.0]])
    occupancy.report = {"frame": torch.eye(3, 4).tolist()}
    occupancy.save(path)


def damaged(path: Path) -> None:
    ball_of_the_tiny_scene().save(path)
    path.write_bytes(path.read_bytes()[:-100])


BAD: dict[str, tuple[Callable[[Path], Any], str]] = {
    "missing": (lambda path: None, "there is no occupancy"),
    "damaged": (damaged, "or not a whole one"),
    "another scene": (another_scene, "keeps nothing on the rays of these cameras"),
}


@pytest.mark.parametrize("bad", BAD)
def test_an_occupancy_that_cannot_guide_ends_training_with_one_line(
    runs: Runs, bad: str, tmp_path: Path
) -> None:
    write, message = BAD[bad]
    write(tmp_path / NAME)
    method = "leco-nerfacto" if bad == "damaged" else "leco-ngp"
    printed = runs.command(
        *("ns-train", method, *runs.arguments("refused"), *METHODS[method]),
        f"--pipeline.model.occupancy.path={tmp_path / NAME}",
        status=1,
    )
    assert message in last_line(printed)
    assert not (runs.folder(method, "refused") / "nerfstudio_models").exists()


@pytest.mark.parametrize(
    ("method", "option", "value"),
    [
        ("leco-occupancy", "gate-loss.empty-ratio", "1.5"),
        ("leco-ngp", "occupancy.learning.calibration.rays", "0"),
    ],
)
def test_an_option_that_cannot_work_ends_training_before_the_data_are_read(
    runs: Runs, method: str, option: str, value: str, tmp_path: Path
) -> None:
    arguments = (f"--pipeline.model.{option}={value}", "--data", tmp_path / "none")
    printed = runs.command("ns-train", method, *arguments, status=2)
    assert f"is {value}; it must be" in printed
    assert "Traceback" not in printed and "there is no such folder" not in printed


def test_a_scene_that_the_occupancy_does_not_know_ends_a_swap(runs: Runs, tmp_path: Path) -> None:
    another_scene(tmp_path / NAME)
    printed = runs.command(
        *("leco", "swap", "elsewhere-packed", "--occupancy", tmp_path / NAME, "--"),
        *runs.arguments("refused"),
        status=2,
    )
    assert last_line(printed).startswith("leco: the occupancy keeps nothing")


def test_a_swapped_config_says_what_it_misses_when_it_is_trained_anew(
    runs: Runs, tmp_path: Path
) -> None:
    ball_of_the_tiny_scene().save(tmp_path / NAME)
    folder = runs.swap("elsewhere-places", tmp_path, name="anew")
    (tmp_path / NAME).unlink()
    shutil.rmtree(folder / "nerfstudio_models")
    arguments = ("elsewhere-places", "--load-config", folder / "config.yml")
    printed = runs.command("ns-train", *arguments, status=1)
    assert f"there is no occupancy {tmp_path / NAME}" in last_line(printed)


def test_a_method_without_a_seam_is_told_what_was_looked_for(runs: Runs, tmp_path: Path) -> None:
    ball_of_the_tiny_scene().save(tmp_path / NAME)
    printed = runs.command(
        *("leco", "swap", "vanilla-nerf", "--occupancy", tmp_path / NAME, "--"),
        *(*runs.arguments("refused"), "nerfstudio-data"),
        status=2,
    )
    said = last_line(printed)
    assert said.startswith("leco: ") and "has no sampler that could be swapped" in said
    for looked_for in ("OccGridEstimator", "ProposalNetworkSampler", "places of nerf-elsewhere"):
        assert looked_for in said
    assert "HostAdapter" in said and "leco_plugin.hosts" in said
