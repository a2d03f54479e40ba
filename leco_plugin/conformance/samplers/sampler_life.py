"""Checks that ask the same of samplers at both seams: over training, evaluation and checkpoints."""

from __future__ import annotations

import functools
import io

import torch
from torch import nn

from leco_plugin.conformance.kit.intervals import PARTS, check_inside, same
from leco_plugin.conformance.kit.scene import (
    EVERYTHING,
    OTHER,
    SLAB,
    Field,
    Rays,
    crossing,
    cut_short,
)
from leco_plugin.conformance.kit.two_processes import on_two_ranks
from leco_plugin.conformance.rule import require
from leco_plugin.conformance.samplers.sampler_case import SamplerCase
from leco_plugin.samplers.marching import Samples


def deterministic_in_eval(case: SamplerCase) -> None:
    """Evaluation does not depend on random numbers."""
    sampler, rays = case.shared(SLAB), crossing()
    one, other = (case.sample(sampler, rays, seed=seed) for seed in (1, 2))
    require(same(one, other), "two calls in evaluation mode return different samples")


def stratified_in_training(case: SamplerCase) -> None:
    """Random offsets in training, and still between the ends of each ray."""
    sampler, rays = case.shared(SLAB).train(), cut_short()
    one, other = (case.sample(sampler, rays, seed=seed) for seed in (1, 2))
    require(not same(one, other), "two calls in training return the same samples")
    for samples in (one, other):
        check_inside(rays, samples)


def no_gradient_to_the_gate(case: SamplerCase) -> None:
    """A loss on rendered colours moves the host's field, and never the frozen gate."""
    sampler, rays, field = case.shared(SLAB).train(), crossing(), Field()
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
    carrying = [name for name, part in zip(PARTS, samples, strict=True) if part.requires_grad]
    require(not carrying, f"{' and '.join(carrying)} carry a gradient")


def state_dict_round_trip(case: SamplerCase) -> None:
    """What a checkpoint of one scene holds turns a sampler of another scene into the first."""
    source, rays = case.shared(EVERYTHING), crossing()
    file = io.BytesIO()
    torch.save(source.state_dict(), file)
    file.seek(0)
    state = torch.load(file, weights_only=True)
    restored = case.build(OTHER.occupancy(case.gate_encoding) if case.needs_occupancy else None)
    restored.load_state_dict(state)
    samples = case.sample(restored.eval(), rays, EVERYTHING)
    require(
        same(samples, case.sample(source, rays, EVERYTHING)),
        "a sampler that was restored from a checkpoint samples otherwise than the one it is of",
    )


def two_processes(case: SamplerCase) -> None:
    """Two ranks that train side by side sample alike."""
    work = functools.partial(samples_after_a_step, type(case), case.name)
    one, other = on_two_ranks(work, case.imports)
    require(same(one, other), "two ranks with the same buffers sample the same rays differently")


def samples_after_a_step(kind: type[SamplerCase], name: str, rank: int) -> Samples:
    """Samples in evaluation after a training step on the rank's own rays, of a sampler that each
    process finds by its name."""
    case, rays = kind(name), crossing()
    sampler = case.shared(SLAB).train()
    own = Rays(*(tensor[rank::2] for tensor in rays))
    case.colours(sampler, own, Field()).sum().backward()
    _share(sampler)
    return case.sample(sampler.eval(), rays, seed=rank)


def _share(sampler: nn.Module) -> None:
    """What data-parallel training does before each step: all ranks take what rank 0 holds."""
    for tensor in (*sampler.parameters(), *sampler.buffers()):
        held = tensor.detach().clone(memory_format=torch.contiguous_format)
        torch.distributed.broadcast(held, src=0)
        tensor.detach().copy_(held)
