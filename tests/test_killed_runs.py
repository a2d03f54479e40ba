"""A run that is killed at any moment and resumed ends as if nobody had killed it.

Real processes of `ns-train`, killed with SIGKILL in the middle of what they do, and resumed with
nerfstudio's own `--load-dir` from the newest checkpoint that they left.
"""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch
from mortal_training import FREEZES_AT, HEALED_FREEZES_AT, run

from leco_plugin.occupancy import Occupancy
from leco_plugin.studio.checkpoints import allow_checkpoint_globals

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("forks")]

STEPS = 24
TINY = [
    "--steps-per-save=3",
    "--steps-per-eval-image=0",
    "--vis=tensorboard",
    "--logging.local-writer.enable=False",
    "--pipeline.datamanager.train-num-rays-per-batch=128",
    "--pipeline.model.calibration.rays=256",
    "--pipeline.model.sizes.candidates=32",
    "--pipeline.model.sizes.learn-candidates=16",
    "--pipeline.model.sizes.field.encoding.log2-table=10",
    "--pipeline.model.sizes.gate.encoding.octaves=1",
    "--pipeline.model.sizes.gate.layers=1",
    "--pipeline.model.sizes.gate.width=8",
]

MODEL = "_model."
MIXTURE = f"{MODEL}mixture."
GATE = f"{MIXTURE}gate."


@dataclass
class Runs:
    """Runs of one scene in one folder."""

    scene: Path
    outputs: Path

    def folder(self, name: str) -> Path:
        return self.outputs / "tiny" / "leco-occupancy" / name

    def train(self, name: str, steps: int, *arguments: str, **mortality: Any) -> int:
        """Trains for so many steps; returns the process's exit code."""
        log = self.outputs / f"{name}.log"
        process = multiprocessing.get_context("forkserver").Process(
            target=run,
            args=(
                [
                    *("leco-occupancy", "--data", str(self.scene), *TINY, *arguments),
                    *("--output-dir", str(self.outputs), "--experiment-name", "tiny"),
                    *("--timestamp", name, "--max-num-iterations", str(steps)),
                ],
                log,
            ),
            kwargs=mortality,
        )
        process.start()
        process.join(120)
        code = process.exitcode
        process.kill()
        if code not in (0, -signal.SIGKILL) and not mortality.keys() & {"spoiled", "interrupted"}:
            pytest.fail(log.read_text()[-4000:])
        return code

    def kill(self, name: str, moment: str, **mortality: Any) -> dict[str, Any]:
        """Has a run die; returns its newest checkpoint."""
        assert self.train(name, STEPS, moment=moment, **mortality) == -signal.SIGKILL
        return newest(self.folder(name))

    def resume(self, name: str, step: int, into: str) -> tuple[dict[str, Any], dict[str, Any]]:
        """Resumes for the steps after `step`; returns what it began with, and the last checkpoint.

        nerfstudio counts the steps of a process, not those of a run.
        """
        loaded = self.outputs / f"{name}.loaded"
        load_dir = f"--load-dir={self.folder(name) / 'nerfstudio_models'}"
        assert self.train(into, STEPS - step - 1, load_dir, loaded=loaded) == 0
        return torch.load(loaded), newest(self.folder(into))


@pytest.fixture
def runs(forks: None, tiny_scene: Path, tmp_path: Path) -> Runs:
    """An empty folder, and processes that compute on one core."""
    allow_checkpoint_globals()
    return Runs(tiny_scene, tmp_path)


def newest(folder: Path) -> dict[str, Any]:
    """The checkpoint that nerfstudio resumes from; there is one only, and nothing beside it."""
    (path,) = (folder / "nerfstudio_models").iterdir()
    checkpoint: dict[str, Any] = torch.load(path)
    assert path.name == f"step-{checkpoint['step']:09d}.ckpt"
    return checkpoint


def leaves(tree: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """Tensors and plain values of nested mappings and lists, with their names."""
    parts = tree.items() if isinstance(tree, dict) else enumerate(tree)
    for key, value in parts:
        if isinstance(value, (dict, list, tuple)):
            yield from leaves(value, f"{name}{key}/")
        else:
            yield f"{name}{key}", value


def assert_same(found: Any, expected: Any) -> None:
    """Equal names, and equal values down to the last bit."""
    found, expected = dict(leaves(found)), dict(leaves(expected))
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        same = torch.equal(found[name], value) if torch.is_tensor(value) else found[name] == value
        assert same, name


def gate_of(checkpoint: dict[str, Any]) -> dict[str, torch.Tensor]:
    state = checkpoint["pipeline"]
    return {name.removeprefix(MIXTURE): state[name] for name in state if name.startswith(GATE)}


def extra_of(checkpoint: dict[str, Any]) -> dict[str, Any]:
    """Beside tensors: of the mixture, and the progress of its run."""
    state = checkpoint["pipeline"]
    return state[f"{MIXTURE}_extra_state"] | state[f"{MODEL}_extra_state"]


def is_frozen(checkpoint: dict[str, Any]) -> bool:
    return bool(checkpoint["pipeline"][f"{MIXTURE}frozen"])


def assert_finished(folder: Path, last: dict[str, Any], froze_at: int) -> None:
    """Guided to its last step, with a file that says what the checkpoint says."""
    assert last["step"] == STEPS - 1
    assert is_frozen(last)
    report = extra_of(last)["report"]
    assert report["step"] == froze_at
    assert float(last["pipeline"][f"{MIXTURE}threshold"]) == pytest.approx(report["threshold"])
    occupancy = Occupancy.load(folder / "occupancy.safetensors")
    assert occupancy.report == report
    assert occupancy.threshold == float(last["pipeline"][f"{MIXTURE}threshold"])
    assert_same({k: v for k, v in occupancy.state_dict().items() if "gate" in k}, gate_of(last))
    assert not (folder / "nerfstudio_models.unfinished").exists()


@pytest.mark.parametrize(
    ("moment", "newest_step", "file"),
    [
        ("while it learns", 6, False),
        ("with a part of the occupancy's file", 9, False),
        ("with the occupancy's file written", 9, True),
        ("with the frozen checkpoint not yet in its place", 9, True),
    ],
)
def test_killed_before_a_checkpoint_is_frozen_it_learns_on_and_freezes(
    runs: Runs, moment: str, newest_step: int, file: bool
) -> None:
    checkpoint = runs.kill("run", moment)
    assert checkpoint["step"] == newest_step and not is_frozen(checkpoint)
    path = runs.folder("run") / "occupancy.safetensors"
    assert path.exists() == file
    left = Occupancy.load(path).state_dict() if file else {}
    loaded, last = runs.resume("run", newest_step, into="run")
    assert_same(loaded, {name: checkpoint[name] for name in loaded})
    assert_finished(runs.folder("run"), last, FREEZES_AT)
    # the file that nobody vouches for has given way to that of the gate frozen since
    gate = gate_of(last)
    assert not file or any(not torch.equal(left[name], gate[name]) for name in gate)


@pytest.mark.parametrize(
    ("moment", "newest_step"),
    [("with the frozen checkpoint written", FREEZES_AT), ("while it is guided", 15)],
)
def test_killed_after_freezing_it_goes_on_guided_by_the_same_gate(
    runs: Runs, moment: str, newest_step: int
) -> None:
    checkpoint = runs.kill("run", moment)
    assert checkpoint["step"] == newest_step and is_frozen(checkpoint)
    # as nerfstudio does unless told otherwise, in a folder of its own
    loaded, last = runs.resume("run", newest_step, into="resumed")
    assert_same(loaded, {name: checkpoint[name] for name in loaded})
    assert_finished(runs.folder("resumed"), last, FREEZES_AT)
    assert_same(gate_of(last), gate_of(checkpoint))
    for one in (last, checkpoint):  # set by each guided step that looks at its price
        extra_of(one)["progress"]["watch"].pop("due")
    assert_same(extra_of(last), extra_of(checkpoint))
    moved = f"{MIXTURE}field.density_head.weight"
    assert not torch.equal(last["pipeline"][moved], checkpoint["pipeline"][moved])


def test_killed_after_it_was_healed_it_keeps_the_longer_schedule(runs: Runs) -> None:
    checkpoint = runs.kill("run", "after it has been healed", collapses=True)
    assert checkpoint["step"] == 12 and not is_frozen(checkpoint)
    loaded, last = runs.resume("run", 12, into="run")
    assert_same(loaded, {name: checkpoint[name] for name in loaded})
    assert_finished(runs.folder("run"), last, HEALED_FREEZES_AT)
    progress = extra_of(last)["progress"]
    assert progress["recoveries"] == 1 and progress["learn_steps"] == HEALED_FREEZES_AT + 1
    assert progress["learn_seconds"] > extra_of(checkpoint)["progress"]["learn_seconds"] > 0.0


def test_ctrl_c_ends_a_run_after_its_step_and_says_how_to_go_on(runs: Runs) -> None:
    assert runs.train("run", STEPS, interrupted=7) == 1
    said = (runs.outputs / "run.log").read_text()
    last_line = said.strip().splitlines()[-1]
    folder = runs.folder("run") / "nerfstudio_models"
    assert last_line.startswith("step 7: stopped by Ctrl-C; the last good checkpoint is")
    assert last_line.endswith(
        f"the same command with --load-dir {folder} --max-num-iterations {STEPS - 8} goes on"
        ", in place of its own --max-num-iterations"
    )
    assert "Traceback" not in said and "stopping after this step" in said
    checkpoint = newest(runs.folder("run"))
    assert checkpoint["step"] == 7 and not is_frozen(checkpoint)
    _, last = runs.resume("run", 7, into="run")
    assert_finished(runs.folder("run"), last, FREEZES_AT)


def test_a_batch_with_nan_ends_the_run_at_its_step_with_the_last_good_checkpoint(
    runs: Runs,
) -> None:
    assert runs.train("run", STEPS, spoiled=14) == 1
    said = (runs.outputs / "run.log").read_text()
    last_line = said.strip().splitlines()[-1]
    assert last_line.startswith("step 14: rgb_loss is not finite: the training image holds values")
    assert last_line.endswith("step-000000012.ckpt") and "Traceback" not in said
    assert newest(runs.folder("run"))["step"] == 12
