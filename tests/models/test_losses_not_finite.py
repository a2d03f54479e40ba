"""A loss that is not finite names its cause."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from leco_plugin.models.losses import first_non_finite, require_finite


def sound() -> tuple[torch.nn.Module, dict[str, Any], torch.Tensor]:
    """A model, outputs and an image in which everything is finite."""
    rays = SimpleNamespace(origins=torch.zeros(4, 3), directions=torch.ones(4, 3))
    shaded = SimpleNamespace(
        logits=torch.zeros(9, 3),
        sigmas=torch.zeros(9),
        rgb=torch.zeros(4, 3),
        weights=torch.zeros(9),
    )
    model = torch.nn.Sequential(torch.nn.Linear(2, 2), torch.nn.Embedding(0, 3))
    return model, {"rays": rays, "shaded": shaded}, torch.zeros(4, 3)


def said_of(model: torch.nn.Module, outputs: dict[str, Any], image: torch.Tensor) -> str:
    """What is said of a loss that is not finite."""
    with pytest.raises(FloatingPointError) as caught:
        require_finite({"rgb_loss": torch.tensor(torch.nan)}, model, outputs, image)
    return str(caught.value)


Spoil = Callable[[torch.nn.Module, dict[str, Any], torch.Tensor], object]

CAUSES: dict[str, tuple[Spoil, str]] = {
    "image": (lambda model, outputs, image: image.fill_(torch.nan), "training image"),
    "origin": (lambda model, outputs, image: outputs["rays"].origins.fill_(torch.inf), "poses"),
    "direction": (
        lambda model, outputs, image: outputs["rays"].directions.fill_(torch.nan),
        "poses",
    ),
    "parameter": (
        lambda model, outputs, image: model.get_parameter("0.bias").data.fill_(torch.nan),
        "parameter 0.bias is not finite: the learning rate",
    ),
    "logits": (lambda model, outputs, image: outputs["shaded"].logits.fill_(torch.inf), "logits"),
    "density": (lambda model, outputs, image: outputs["shaded"].sigmas.fill_(torch.inf), "density"),
    "colour": (lambda model, outputs, image: outputs["shaded"].rgb.fill_(torch.nan), "colour"),
    "nothing": (lambda model, outputs, image: None, "the loss itself overflowed"),
}


@pytest.mark.parametrize("name", CAUSES)
def test_the_cause_is_named_in_one_line(name: str) -> None:
    spoil, cause = CAUSES[name]
    model, outputs, image = sound()
    spoil(model, outputs, image)
    message = said_of(model, outputs, image)
    assert message.startswith("rgb_loss is not finite: ") and cause in message
    assert "\n" not in message


def test_the_first_cause_on_the_way_is_named() -> None:
    model, outputs, image = sound()
    image.fill_(torch.nan)
    outputs["shaded"].rgb.fill_(torch.nan)
    assert "training image" in said_of(model, outputs, image)


@pytest.mark.parametrize("bad", [torch.nan, torch.inf, -torch.inf])
def test_the_first_loss_that_is_not_finite_is_named(bad: float) -> None:
    names = ("rgb_loss", "distortion_loss", "nearness_loss", "contribution_loss")
    losses = {name: torch.tensor(1.0, requires_grad=True) for name in names}
    assert first_non_finite(losses) is None
    losses["contribution_loss"] = torch.tensor(bad)
    assert first_non_finite(losses) == "contribution_loss"
    losses["distortion_loss"] = torch.tensor(bad, dtype=torch.bfloat16)
    assert first_non_finite(losses) == "distortion_loss"


class CountsWaits(TorchDispatchMode):
    """Counts the reads of single numbers, each of which waits for the device."""

    waits = 0

    def __torch_dispatch__(self, operation, types, arguments=(), options=None):  # type: ignore[no-untyped-def]
        self.waits += operation is torch.ops.aten._local_scalar_dense.default
        return operation(*arguments, **(options or {}))


def test_all_losses_are_waited_for_at_once() -> None:
    losses = {str(number): torch.tensor(float(number)) for number in range(5)}
    with CountsWaits() as counted:
        for loss in losses.values():
            float(loss)
    assert counted.waits == 5
    with CountsWaits() as counted:
        first_non_finite(losses)
    assert counted.waits <= 1


def test_losses_of_hosts_have_any_shape_and_may_be_plain_numbers() -> None:
    losses: dict[str, Any] = {"rgb_loss": torch.ones(1), "none": 0.0, "per_ray": torch.ones(3, 2)}
    assert first_non_finite(losses) is None
    losses["per_ray"][1, 1] = torch.nan
    assert first_non_finite(losses) == "per_ray"
