"""`--machine.num-devices N` with `--machine.device-type cpu`: N processes that speak gloo.

nerfstudio 1.1.5 takes the backend from the device type, and then wants CUDA devices all the same:
in each process that it starts, and where a pipeline tells torch the number of a model's GPU.
"""

from __future__ import annotations

import functools
import shlex
import sys
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import torch
from nerfstudio.configs.base_config import MachineConfig
from nerfstudio.engine.trainer import TrainerConfig
from torch import distributed, nn
from torch.multiprocessing import ProcessExitedException, ProcessRaisedException
from torch.nn.parallel import DistributedDataParallel

from leco_plugin.log import say
from leco_plugin.scenes.input_error import InputError, TrainingStopped, require
from leco_plugin.scenes.whole_files import writing_into
from leco_plugin.studio.checkpoints import follow_data
from leco_plugin.studio.run_folder import OUTPUT, claim
from leco_plugin.studio.run_progress import is_short, short_screen
from leco_plugin.studio.trainer import AtomicTrainer

LOST = ("Connection closed by peer", "Connection reset by peer", "NCCL communicator was aborted")
"""What gloo and NCCL say of a process that is gone."""

COUNTS_OF_RAYS = (
    "pipeline.datamanager.train_num_rays_per_batch",
    "pipeline.model.eval_num_rays_per_chunk",
    "pipeline.fewest_rays",
    "pipeline.most_rays",
)
"""Where a config counts rays, of the methods that do."""


@dataclass
class DataParallelTrainerConfig(TrainerConfig):
    """nerfstudio's, with checkpoints that are whole, and with several processes also on a CPU"""

    _target: type = field(default_factory=lambda: AtomicTrainer)
    """target class to instantiate"""
    verbose: bool = False
    """Whether all details are on the screen, and nerfstudio's own lines. Else they go to the file
    train.log in the run's folder. Without --logging.local-writer.enable nothing is measured for the
    screen, and nothing is kept from it."""

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Called by yaml: data that were moved with their run are found before they are read."""
        self.__dict__.update(state)
        follow_data(self)

    def set_timestamp(self) -> None:
        """Prepares the launcher too: of a config, nothing else is called before processes start.
        InputError if they cannot start or find each other, there is no step, or no such folder."""
        super().set_timestamp()
        self._require_what_is_named()
        require_startable(self.machine)
        if self.machine.num_devices * self.machine.num_machines > 1:
            prepare_launcher()

    def _require_what_is_named(self) -> None:
        """InputError, before anything of a run is written, if there is no step to take, no ray in a
        batch, or no such folder or file."""
        if self.max_num_iterations < 1:
            raise InputError(
                f"--max-num-iterations is {self.max_num_iterations}; a run needs at least one step"
            )
        for place in COUNTS_OF_RAYS:
            number: Any = self
            for name in place.split("."):
                number = getattr(number, name, None)
            option = f"--{place.replace('_', '-')}"
            require(number is None or number >= 1, option, number, "at least 1")
        named = {
            "data": self.data,
            "load-dir": self.load_dir,
            "load-checkpoint": self.load_checkpoint,
        }
        for option, path in named.items():
            if path is not None and not path.exists():
                raise InputError(f"--{option} {path}: there is no such folder or file")

    def print_to_terminal(self) -> None:
        """Nothing where the screen is short: the config is in its file."""
        if not is_short(self):
            super().print_to_terminal()

    def save_config(self) -> None:
        """Takes the run's folder; one that another run has, or has left, gives way to a new one."""
        wanted, reasons = self.timestamp, []
        load_from = self.load_dir or self.load_checkpoint
        while reason := claim(self.get_base_dir(), self.get_checkpoint_dir(), load_from):
            reasons.append(reason)
            self.timestamp = f"{wanted}-{len(reasons) + 1}"
        if reasons:
            say(f"{reasons[0]}; this run goes to {self.get_base_dir()}")
        with writing_into(self.get_base_dir(), OUTPUT), short_screen(self):
            super().save_config()


def require_startable(machine: MachineConfig) -> None:
    """InputError for what nerfstudio would refuse in a process that it has started: fewer GPUs than
    processes here, or several machines that do not know of each other."""
    devices, machines = machine.num_devices, machine.num_machines
    if machine.device_type == "cuda" and devices > 1:
        there = torch.cuda.device_count()
        if devices > there:
            raise InputError(
                f"--machine.num-devices is {devices}, and torch sees {there} CUDA devices here; "
                "it counts those of one machine"
            )
    if machines > 1 and machine.dist_url == "auto":
        raise InputError(
            f"--machine.num-machines is {machines}: give each --machine.dist-url tcp://HOST:PORT, "
            "the name or address of the machine with rank 0 and a port that is free there"
        )
    if not 0 <= machine.machine_rank < machines:
        raise InputError(
            f"--machine.machine-rank is {machine.machine_rank}; of {machines} machines the ranks "
            f"are 0 to {machines - 1}"
        )


def prepare_launcher() -> None:
    """Has nerfstudio's next launch of processes end in one line when one is lost, or on a CPU start
    `process` in place of its own; after it, or an error in it, the launcher is its own again."""
    for name in ("nerfstudio.scripts.train", "__main__"):
        launcher: Any = sys.modules.get(name)
        if hasattr(launcher, "launch") and hasattr(launcher, "_distributed_worker"):
            own = getattr(launcher.launch, "of_nerfstudio", launcher.launch)
            launcher.launch = _launching_once(launcher, own)


def _launching_once(launcher: Any, launch: Any) -> Any:
    """What stands for `launch` of a module until it has been called."""

    @functools.wraps(launch)
    def launching(*arguments: Any, **options: Any) -> Any:
        launcher.launch, own = launch, launcher._distributed_worker
        if options.get("device_type") == "cpu":
            launcher._distributed_worker = process
        try:
            return launch(*arguments, **options)
        except ProcessExitedException as error:
            exit_code = f"exit code {error.exit_code}"
            _stop(f"number {error.error_index}", error.signal_name or exit_code, options["config"])
        except ProcessRaisedException as error:
            name, _, line = str(error).strip().splitlines()[-1].partition(": ")
            if name.endswith((TrainingStopped.__name__, InputError.__name__)):
                raise TrainingStopped(line) from None
            if not any(sign in line for sign in LOST):
                raise
            _stop("one", "its connection broke", options["config"])
        finally:
            launcher._distributed_worker = own

    launching.of_nerfstudio = launch  # type: ignore[attr-defined]
    return launching


def _stop(which: str, how: str, config: Any) -> None:
    """Ends the launcher because a process is gone: TrainingStopped, which says what is left."""
    folder = config.get_checkpoint_dir()
    saved = any(folder.glob("*.ckpt"))
    left = f"nothing that was saved is lost: go on with --load-dir {shlex.quote(str(folder))}"
    raise TrainingStopped(
        f"{which} of {config.machine.num_devices} processes here was lost ({how}), and the others "
        f"have stopped; {left if saved else 'no checkpoint was saved yet: begin anew'}"
    ) from None


def process(local_rank: int, *arguments: Any) -> None:
    """One of the processes of a run on a CPU, by its number on this machine and what nerfstudio's
    launcher gives its own function."""
    train, world_size, here, machine_rank, address, config, timeout, _ = arguments
    # each would else take all cores for itself
    torch.set_num_threads(max(1, torch.get_num_threads() // here))
    rank = machine_rank * here + local_rank
    distributed.init_process_group(
        "gloo", init_method=address, world_size=world_size, rank=rank, timeout=timeout
    )
    _name_machines(world_size, here, machine_rank)
    _wrap_models_without_devices()
    train(local_rank, world_size, config, rank)
    distributed.barrier()
    distributed.destroy_process_group()


def _name_machines(world_size: int, here: int, machine_rank: int) -> None:
    """The group of processes on this machine, for which nerfstudio asks."""
    from nerfstudio.utils import comms

    for machine in range(world_size // here):
        group = distributed.new_group(list(range(machine * here, (machine + 1) * here)))
        if machine == machine_rank:
            comms.LOCAL_PROCESS_GROUP = group  # type: ignore[assignment]


class WithoutDevices(DistributedDataParallel):
    """torch's, for a caller that names a device although the module is on a CPU."""

    def __init__(self, module: nn.Module, device_ids: Any = None, **options: Any) -> None:
        super().__init__(module, **options)


def _wrap_models_without_devices() -> None:
    """For all pipelines of this process, which was started for one run on a CPU."""
    from nerfstudio.pipelines import base_pipeline

    base_pipeline.DDP = WithoutDevices  # type: ignore[assignment, misc]
    base_pipeline.dist = SimpleNamespace(  # type: ignore[assignment]
        barrier=lambda **_: distributed.barrier()
    )
