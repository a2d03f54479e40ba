"""Registered samplers, built for known scenes, and the checks that are the same at both seams."""

from __future__ import annotations

import functools
import os
import socket
import tempfile
import time
from abc import abstractmethod
from collections.abc import Callable, Sequence
from datetime import timedelta
from pathlib import Path
from typing import Any, cast
from unittest.mock import patch

import torch
import torch.multiprocessing as processes
from torch import Tensor, nn

from leco_plugin.conformance import scene as kit
from leco_plugin.conformance.rules import Broken, Case, checks, require
from leco_plugin.conformance.scene import SLAB, Field, Rays, Slab
from leco_plugin.models.encodings import Kind
from leco_plugin.occupancy import Occupancy
from leco_plugin.samplers.marching import Samples
from leco_plugin.samplers.registry import sampler_spec

BOTH = "estimator", "proposal"
PATIENCE, PATIENCE_OF_A_RANK = 280.0, 120.0
"""Seconds in all, and seconds that a rank waits for the other: a busy machine takes a minute for
what an idle one does in five seconds."""
SERVER = "forkserver"
"""Starts processes that share what it has imported, and so takes those seconds only once."""


class SamplerCase(Case):
    """A sampler at one of the two seams.

    Building can take seconds: a sampler of a scene is built once and shared by the rules, which
    leave it as they found it. `ValueError` where there is no sampler of that name.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        spec = sampler_spec(name)
        self.needs_occupancy = spec.needs_occupancy
        self.options = dict(spec.check_options)
        self.gate_encoding = cast(Kind, spec.gate_encoding or "frequency")
        self._shared: dict[Slab, tuple[Any, Occupancy]] = {}

    def forget(self) -> None:
        self._shared.clear()

    def shared(self, scene: Slab) -> Any:
        """The sampler of a scene, ready for hosts and in evaluation mode."""
        if scene not in self._shared:
            self._shared[scene] = sampler, _ = self.build_in(scene)
            if not self.needs_occupancy:
                self.teach(sampler, scene)
        return self._shared[scene][0].eval()

    def occupancy(self, scene: Slab) -> Occupancy:
        """The occupancy that `shared(scene)` was given, if it needs one."""
        return self._shared[scene][1]

    def build_in(self, scene: Slab) -> tuple[Any, Occupancy]:
        """A sampler of a scene, untaught, and the occupancy that it is given if it needs one."""
        occupancy = scene.occupancy(self.gate_encoding)
        return self.build(occupancy if self.needs_occupancy else None), occupancy

    @abstractmethod
    def build(self, occupancy: Occupancy | None) -> Any:
        """The sampler as a host builds it."""

    def teach(self, sampler: Any, scene: Slab) -> None:
        """What a host does before and between its steps, with the densities of a scene."""

    @abstractmethod
    def sample(
        self, sampler: Any, rays: Rays, scene: Slab = SLAB, *, seed: int = 0, **options: Any
    ) -> Samples:
        """What a host gets, with random numbers from `seed`, as packed samples. The scene is for
        samplers that ask the host for densities."""

    @abstractmethod
    def colours(self, sampler: Any, rays: Rays, field: Field) -> Tensor:
        """What a host renders in the scene `SLAB`, in front of the background: [n_rays, 3]."""


def devices() -> list[torch.device]:
    """The CPU, and a CUDA device where there is one."""
    cuda = ["cuda"] if torch.cuda.is_available() else []
    return [torch.device(name) for name in ("cpu", *cuda)]


def check_module(sampler: Any, *methods: str) -> None:
    """Raises unless a sampler is a torch module with these methods."""
    require(isinstance(sampler, nn.Module), f"it is a {type(sampler).__name__}, no torch module")
    for method in methods:
        require(callable(getattr(sampler, method, None)), f"it has no method {method}")


def check_tensor(name: str, tensor: Tensor, rays: Tensor) -> None:
    """Raises unless a tensor is finite, and of the type and on the device of the rays."""
    require(tensor.dtype == rays.dtype, f"{name} is {tensor.dtype}, the rays are {rays.dtype}")
    require(tensor.device == rays.device, f"{name} is on {tensor.device}")
    require(bool(tensor.isfinite().all()), f"{name} holds values that are not finite")


def check_rays(given: Rays, before: Rays) -> None:
    """Raises if a sampler has written into the rays that it was given."""
    for name, now, was in zip(Rays._fields, given, before, strict=True):
        require(torch.equal(now, was), f"{name} of the host's rays was written into")


def check_gradients(field: Field, why: str) -> None:
    """Raises unless all parameters of a field have finite gradients."""
    gradients = [parameter.grad for parameter in field.parameters()]
    finite = all(grad is not None and grad.isfinite().all() for grad in gradients)
    require(finite, f"{why}: gradients are missing or not finite")


@checks("deterministic-in-eval", *BOTH)
def deterministic_in_eval(case: SamplerCase) -> None:
    sampler, rays = case.shared(SLAB), kit.crossing()
    one, other = of_two_seeds(lambda seed: case.sample(sampler, rays, seed=seed))
    require(kit.same(one, other), "two calls in evaluation mode return different samples")


def of_two_seeds(evaluate: Callable[[int], Any]) -> tuple[Any, Any]:
    """What an evaluation returns with random numbers from two seeds. Raises if it sets a seed of
    its own: training would go on with the same numbers after each test image."""
    one, after_one = evaluate(1), torch.get_rng_state()
    other, after_other = evaluate(2), torch.get_rng_state()
    require(not after_one.equal(after_other), "evaluation sets the seed of torch's random numbers")
    return one, other


@checks("stratified-in-training", "proposal")
def check_shifts(case: SamplerCase) -> None:
    """Raises unless samples shift in training, and stay between the ends of each ray."""
    sampler, rays = case.shared(SLAB).train(), kit.cut_short()
    one, other = (case.sample(sampler, rays, seed=seed) for seed in (1, 2))
    require(not kit.same(one, other), "two calls in training return the same samples")
    for samples in (one, other):
        kit.check_inside(rays, samples)


@checks("no-gradient-to-the-gate", *BOTH)
def no_gradient_to_the_gate(case: SamplerCase) -> None:
    sampler, field = case.shared(SLAB).train(), Field()
    origins, directions = (part.clone().requires_grad_() for part in kit.crossing()[:2])
    # cameras may be optimised
    rays = kit.crossing()._replace(origins=origins, directions=directions)
    colours = case.colours(sampler, rays, field)
    require(torch.is_grad_enabled(), "sampling leaves gradients switched off")
    colours.square().sum().backward()
    for name, parameter in field.named_parameters():
        gradient = parameter.grad
        arrives = gradient is not None and bool(gradient.isfinite().all() and gradient.any())
        require(arrives, f"the gradient of the field's {name} is {gradient}")
    for name, parameter in case.occupancy(SLAB).gate.named_parameters():
        require(not parameter.requires_grad, f"the gate's {name} is no longer frozen")
        require(parameter.grad is None, f"the gate's {name} was given a gradient")
    samples = case.sample(sampler, rays)
    carrying = [name for name, part in zip(kit.PARTS, samples, strict=True) if part.requires_grad]
    require(not carrying, f"{' and '.join(carrying)} carry a gradient")


@checks("state-dict-round-trip", *BOTH)
def state_dict_round_trip(case: SamplerCase) -> None:
    """The checkpoint of one scene turns a sampler of another scene into the first."""
    source, rays = case.shared(kit.EVERYTHING), kit.crossing()
    restored, _ = case.build_in(kit.OTHER)
    # what is derived at first use is of the other scene
    case.sample(restored.eval(), rays, kit.OTHER)
    restored.load_state_dict(reloaded(source.state_dict()))
    samples = case.sample(restored.eval(), rays, kit.EVERYTHING)
    require(
        kit.same(samples, case.sample(source, rays, kit.EVERYTHING)),
        "a sampler that was restored from a checkpoint samples otherwise than the one it is of",
    )


def reloaded(state: Any) -> Any:
    """What a checkpoint of this state gives back."""
    with tempfile.TemporaryFile() as file:
        torch.save(state, file)
        file.seek(0)
        return torch.load(file, map_location="cpu", weights_only=True)


@checks("two-processes", *BOTH)
def two_processes(case: SamplerCase) -> None:
    work = functools.partial(samples_after_a_step, type(case), case.name)
    one, other = on_two_ranks(work, case.imports)
    require(
        kit.same(one, other), "two ranks with the same buffers sample the same rays differently"
    )


def samples_after_a_step(kind: type[SamplerCase], name: str, rank: int) -> Samples:
    """Samples in evaluation after a training step on the rank's own rays."""
    case, rays = kind(name), kit.crossing()
    sampler = case.shared(SLAB).train()
    own = Rays(*(tensor[rank::2] for tensor in rays))
    case.colours(sampler, own, Field()).sum().backward()
    # as data-parallel training does before each step, all ranks take what rank 0 holds
    for tensor in (*sampler.parameters(), *sampler.buffers()):
        held = tensor.detach().clone(memory_format=torch.contiguous_format)
        torch.distributed.broadcast(held, src=0)
        tensor.detach().copy_(held)
    return case.sample(sampler.eval(), rays, seed=rank)


def on_two_ranks(work: Callable[[int], Any], imports: Sequence[str]) -> list[Any]:
    """What a function of the rank returns on two CPU ranks, connected as for data-parallel
    training; `Broken` where one failed, or the two wait for each other. It can be pickled, returns
    what `torch.load` reads without unpickling foreign types, and needs `imports`, modules that take
    time to import."""
    method = SERVER if SERVER in processes.get_all_start_methods() else "spawn"
    if method == SERVER:
        processes.set_forkserver_preload(list(imports))  # type: ignore[attr-defined]
    with tempfile.TemporaryDirectory() as folder:
        # what the processes import has warned in this one already
        with patch.dict(os.environ, PYTHONWARNINGS="ignore"):
            ranks: Any = processes.start_processes(
                _rank, args=(work, folder), nprocs=2, join=False, start_method=method
            )
        deadline = time.monotonic() + PATIENCE
        try:
            while not ranks.join(timeout=1.0):
                require(time.monotonic() < deadline, f"the ranks hang: no end after {PATIENCE:g} s")
        except processes.ProcessRaisedException as error:
            raise Broken(f"a rank failed: {str(error).strip().splitlines()[-1]}") from error
        finally:
            for process in ranks.processes:
                process.kill()
        return [torch.load(f"{folder}/rank-{rank}.pt", weights_only=True) for rank in range(2)]


def _rank(rank: int, work: Callable[[int], Any], folder: str) -> None:
    """What each process does, with its own random numbers."""
    torch.set_num_threads(1)
    torch.manual_seed(rank)
    loopback = {"lo", "lo0"} & {interface for _, interface in socket.if_nameindex()}
    for interface in loopback:  # a machine need not be able to look up its own name
        os.environ.setdefault("GLOO_SOCKET_IFNAME", interface)
    torch.distributed.init_process_group(
        "gloo",
        init_method=(Path(folder) / "store").as_uri(),
        rank=rank,
        world_size=2,
        timeout=timedelta(seconds=PATIENCE_OF_A_RANK),
    )
    torch.save(work(rank), f"{folder}/rank-{rank}.pt")
    torch.distributed.destroy_process_group()
