"""Runs of `leco-occupancy` that are killed with SIGKILL at random moments and resumed.

    python benchmarks/kills.py --kills 100 --minutes 10

Each kill must lose nothing that had been saved, and each run must end as runs that nobody kills.
Half of the moments before training begins, and all of it, are drawn from alike, so that few kills
come before anything is there to be lost.
The result is written after every run, and a later call goes on with it. Runs are as small as still
pass through every phase, and ask their gate directly: building its cell cache would take most of
the time, and nothing of it is ever saved.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import multiprocessing
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import checkout  # noqa: F401
import psutil

from leco_plugin.evaluation.report import describe_machine
from leco_plugin.occupancy import Occupancy
from leco_plugin.scenes.input_error import InputError
from leco_plugin.scenes.whole_files import write_json
from leco_plugin.studio.checkpoints import (
    allow_checkpoint_globals,
    newest_whole,
    previous_of,
    step_of,
)
from leco_plugin.studio.run_folder import iterations_until

ROOT = Path(__file__).resolve().parents[1]
STEPS, LEARN_STEPS = 60, 24
UNDISTURBED = 40
"""Runs with other seeds that nobody kills, which say how much the end of a run varies; one more for
each later call says how long a run takes now."""
POLL_SECONDS = 0.05
"""Between two looks at the time that a process has worked."""
KILLS_A_RUN = 5
"""At most: what comes between the last of them and the end of a run shows no kill."""
PRELOADED = [
    "nerfstudio.scripts.train",
    "leco_plugin.studio.trainer",
    "leco_plugin.learning.learner",
    "leco_plugin.evaluation.timed_run",
]
"""Imported once for all runs."""
ARGUMENTS = [
    "--steps-per-save=4",
    "--steps-per-eval-image=0",
    "--vis=tensorboard",
    "--logging.local-writer.enable=False",
    "--pipeline.datamanager.train-num-rays-per-batch=256",
    f"--pipeline.model.schedule.learn-steps={LEARN_STEPS}",
    "--pipeline.model.calibration.rays=256",
    "--pipeline.model.calibration.recheck-rays=64",
    "--pipeline.model.calibration.steps-per-recheck=10",
    "--pipeline.model.sizes.candidates=32",
    "--pipeline.model.sizes.learn-candidates=16",
    "--pipeline.model.sizes.field.encoding.log2-table=12",
    "--pipeline.model.sizes.gate.encoding.octaves=1",
    "--pipeline.model.sizes.gate.layers=1",
    "--pipeline.model.sizes.gate.width=8",
]


def train(arguments: list[str], log: Path, end: Path) -> None:
    """`ns-train` as the target of a process; leaves what its end is like as a JSON file."""
    with log.open("ab") as printed:
        os.dup2(printed.fileno(), sys.stdout.fileno())
        os.dup2(printed.fileno(), sys.stderr.fileno())
    from mortal_training import leave_out_the_cache
    from nerfstudio.engine.trainer import Trainer
    from nerfstudio.scripts import train as ns_train

    from leco_plugin.evaluation.timed_run import psnr_on_rays

    leave_out_the_cache()
    after = Trainer._after_train

    def after_train(trainer: Trainer) -> None:
        after(trainer)
        model: Any = trainer.pipeline.model
        figures = {
            "step": trainer.step,
            "psnr": round(psnr_on_rays(trainer, 2048), 3),
            "frozen": bool(model.mixture.frozen),
        }
        write_json(end, figures)

    Trainer._after_train = after_train  # type: ignore[method-assign]
    sys.argv = ["ns-train", *arguments]
    trained = Trainer.train

    def train_from_here(trainer: Trainer) -> None:
        write_json(begun_at(end), {"seconds": time.process_time()})
        trained(trainer)

    Trainer.train = train_from_here  # type: ignore[method-assign]
    ns_train.entrypoint()


def begun_at(end: Path) -> Path:
    """The file, beside that of a run's end, with the processor seconds until training began."""
    return end.with_suffix(".begun.json")


class Runs:
    """Runs of one scene, each in a folder of its own."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.scene = folder, folder / "scene"
        shutil.rmtree(folder, ignore_errors=True)
        sys.path.insert(0, str(ROOT / "tests"))
        import tiny_scene

        tiny_scene.write(self.scene)
        self.forks = multiprocessing.get_context("forkserver")
        self.forks.set_forkserver_preload(PRELOADED)
        first = self.forks.Process(target=int)  # waits for the imports, which no run is to pay for
        first.start()
        first.join()

    def base(self, name: str) -> Path:
        return self.folder / "tiny" / "leco-occupancy" / name

    def start(self, name: str, seed: int, done: int) -> Any:
        """A process that trains a run from its newest checkpoint on, after so many steps; at its
        last one, one step more, for it has an end to be measured."""
        checkpoints = self.base(name) / "nerfstudio_models"
        arguments = [
            *("leco-occupancy", "--data", str(self.scene), *ARGUMENTS),
            *("--output-dir", str(self.folder), "--experiment-name", "tiny", "--timestamp", name),
            f"--max-num-iterations={iterations_until(max(STEPS, done + 1), done)}",
            f"--machine.seed={seed}",
            *([f"--load-dir={checkpoints}"] if done else []),
        ]
        log, end = self.folder / f"{name}.log", self.folder / f"{name}.json"
        process = self.forks.Process(target=train, args=(arguments, log, end))
        process.start()
        return process

    def newest(self, name: str) -> tuple[int, int]:
        """Step of the newest whole checkpoint, -1 where there is none, and how many are damaged."""
        folder = self.base(name) / "nerfstudio_models"
        if not any(folder.glob("*.ckpt")) and not any(previous_of(folder).glob("*.ckpt")):
            return -1, 0
        try:
            path, damaged = newest_whole(folder)
        except InputError:
            return -1, 1
        return step_of(path), len(damaged)

    def end(self, name: str) -> dict[str, Any]:
        """How a run ended; its occupancy loads."""
        figures: dict[str, Any] = json.loads((self.folder / f"{name}.json").read_text())
        occupancy = Occupancy.load(self.base(name) / "occupancy.safetensors")
        figures["threshold"] = round(occupancy.threshold, 4)
        return figures

    def begun(self, name: str) -> float:
        """Processor seconds until the training of a run began."""
        found = json.loads(begun_at(self.folder / f"{name}.json").read_text())
        return float(found["seconds"])


def train_undisturbed(runs: Runs, seed: int) -> dict[str, Any]:
    """A run that nobody kills, and the processor seconds that it takes, until training begins and
    in all."""
    name = f"undisturbed-{seed}"
    process = runs.start(name, seed, 0)
    seconds = wait_for(process)
    if process.exitcode != 0:
        raise RuntimeError((runs.folder / f"{name}.log").read_text()[-3000:])
    return runs.end(name) | {"begun": round(runs.begun(name), 2), "seconds": round(seconds, 2)}


def wait_for(process: Any, most: float = math.inf) -> float:
    """Waits for a process to end or to have worked so many seconds; returns how many it has.

    Of the processor's time: on a busy machine a run takes as much of that, and moments that are
    drawn in it lie in the run and not behind its end.
    """
    spent = 0.0
    while process.exitcode is None and spent < most:
        process.join(POLL_SECONDS)
        with contextlib.suppress(psutil.NoSuchProcess):
            times = psutil.Process(process.pid).cpu_times()
            spent = max(spent, times.user + times.system)
    return spent


def train_with_kills(
    runs: Runs, number: int, kills: int, begun: float, seconds: float, dice: random.Random
) -> Any:
    """A run that is killed up to so often, until it ends by itself.

    Args:
        begun, seconds: processor seconds of a run that nobody kills, until training begins and in
            all.
    Returns:
        Its end, with `kills`: for each the step that was saved when its process began, just before
        it and after it, and after how many processor seconds it came. A run that lost something, or
        that is left with a damaged checkpoint, ends there; one that cannot go on says why in
        `failed`.
    """
    name, found = f"killed-{number}", []
    while True:
        first = runs.newest(name)[0]
        process = runs.start(name, number, first + 1)
        left = 1.0 - (first + 1) / STEPS
        moment = dice.uniform(0.5 * begun, begun + 1.1 * left * (seconds - begun))
        wait_for(process, moment if len(found) < kills else math.inf)
        before, _ = runs.newest(name)
        if process.exitcode is None:
            os.kill(process.pid, signal.SIGKILL)
            process.join()
        if process.exitcode == -signal.SIGKILL:
            after, damaged = runs.newest(name)
            kill = {"first": first, "before": before, "after": after, "seconds": round(moment, 2)}
            found.append(kill | ({"damaged": damaged} if damaged else {}))
            if damaged or after < max(first, before):
                return {"step": after, "kills": found}
        elif process.exitcode == 0:
            return runs.end(name) | {"kills": found}
        else:
            said = (runs.folder / f"{name}.log").read_text().strip().split("\n")[-1]
            return {"step": first, "kills": found, "failed": said[:200]}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--minutes", type=float, default=math.inf, help="that this may take, about")
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks" / "results" / "kills.json")
    arguments = parser.parse_args()
    ends = time.monotonic() + 60.0 * arguments.minutes
    allow_checkpoint_globals()
    os.environ["OMP_NUM_THREADS"] = "1"
    result = {"format": 2, "steps": STEPS, "undisturbed": [], "killed": []}
    if arguments.out.exists():
        result = json.loads(arguments.out.read_text())
    result["machine"] = describe_machine()
    with tempfile.TemporaryDirectory() as folder:
        runs = Runs(Path(folder) / "runs")
        for _ in range(max(1, UNDISTURBED - len(result["undisturbed"]))):
            result["undisturbed"].append(train_undisturbed(runs, len(result["undisturbed"])))
            write_json(arguments.out, result)
        last = result["undisturbed"][-1]
        while (left := arguments.kills - total(result)) > 0 and time.monotonic() < ends:
            number = len(result["killed"])
            dice = random.Random(number)
            run = train_with_kills(
                runs, number, min(KILLS_A_RUN, left), last["begun"], last["seconds"], dice
            )
            result["killed"].append(run)
            write_json(arguments.out, result | {"kills": total(result)})
            print(f"{total(result)} of {arguments.kills} kills", flush=True)


def total(result: dict[str, Any]) -> int:
    """Kills so far."""
    return sum(len(run["kills"]) for run in result["killed"])


if __name__ == "__main__":
    main()
