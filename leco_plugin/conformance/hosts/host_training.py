"""Checks of a training step of a guided host: what it moves, and what it has no use for."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from leco_plugin.conformance.hosts.host_case import HostCase, loss_of
from leco_plugin.conformance.kit.host_scene import batch, bundle
from leco_plugin.conformance.kit.watching import densely, shaded
from leco_plugin.conformance.rule import require

if TYPE_CHECKING:
    from nerfstudio.models.base_model import Model

GUIDE = "leco_guide."
"""How the names of what belongs to the guide of a host begin."""


def samples_shift_in_training(case: HostCase) -> None:
    """The field is asked at other places in each step."""
    model = case.shared().train()
    one, other = (_places(model, seed) for seed in (1, 2))
    require(
        one.shape != other.shape or not one.equal(other),
        "two training steps ask the field at the same places",
    )


@torch.no_grad()
def _places(model: Model, seed: int) -> Tensor:
    torch.manual_seed(seed)
    with shaded(model) as places:
        model(bundle())
    require(bool(places), "the field is asked about no sample at all")
    return torch.cat(places)


def teaches_the_host_alone(case: HostCase) -> None:
    """A step moves the host's parameters, and never the frozen gate."""
    model: Any = case.shared()
    groups = model.get_param_groups()
    handed_out = {id(parameter) for group in groups.values() for parameter in group}
    gradients = gradients_of_a_step(model)
    reached = [name for name, gradient in gradients.items() if bool(gradient.any())]
    require(bool(reached), "no parameter of the host gets a gradient")
    for name, gradient in gradients.items():
        require(bool(gradient.isfinite().all()), f"the gradient of {name} is not finite")
    for name, parameter in model.leco_guide.named_parameters():
        require(not parameter.requires_grad, f"{name} of the guide is no longer frozen")
        require(id(parameter) not in handed_out, f"{name} of the guide is handed to an optimizer")
    touched = [name for name in gradients if name.startswith(GUIDE)]
    require(not touched, f"{_some(touched)} of the guide get a gradient")


def gradients_of_a_step(model: Model, seed: int = 0) -> dict[str, Tensor]:
    """Gradients of the batch's loss by parameter, for parameters that it reaches."""
    torch.manual_seed(seed)
    loss = loss_of(model.train(), bundle(), batch())
    require(loss.requires_grad, "the loss has no gradient")
    loss.backward()  # type: ignore[no-untyped-call]
    named = [(name, parameter.grad) for name, parameter in model.named_parameters()]
    model.zero_grad(set_to_none=True)
    return {name: gradient for name, gradient in named if gradient is not None}


def nothing_superfluous_is_left(case: HostCase) -> None:
    """What the gate stands for is gone from memory, checkpoints and optimizers."""
    from leco_plugin.hosts.seams import PACKED, PROPOSAL

    own, model = case.unguided(), case.shared()
    for adapter in (PACKED, PROPOSAL):
        require(not adapter.fits(model), f"the host still holds {adapter.description}")
    now = dict(model.named_parameters())
    with densely(own):  # a grid that nobody has updated keeps nothing
        before = gradients_of_a_step(own)
    idle = before.keys() & now.keys() - gradients_of_a_step(model).keys()
    require(
        not idle,
        f"{_some(sorted(idle))} are trained with the host's own sampler, and get no gradient now",
    )
    state = model.state_dict().keys()
    gained = state - own.state_dict().keys()
    more = sorted(name for name in gained if not name.startswith(GUIDE))
    require(not more, f"the state dict has gained {_some(more)} beside the guide")
    held = {id(parameter) for parameter in now.values()}
    for name, group in model.get_param_groups().items():
        require(bool(group), f"the parameter group {name!r} is empty, which no optimizer takes")
        gone = sum(id(parameter) not in held for parameter in group)
        require(gone == 0, f"the parameter group {name!r} holds {gone} that the host no longer has")


def _some(names: list[str]) -> str:
    shown = ", ".join(names[:3])
    return shown if len(names) <= 3 else f"{shown} and {len(names) - 3} more"
