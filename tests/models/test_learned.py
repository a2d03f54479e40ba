"""What networks learn by routines in C, against what torch differentiates."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor, nn

from leco_plugin.models.compute import native
from leco_plugin.models.encodings import EncodingConfig
from leco_plugin.models.field import ColorHead, FieldConfig, HMoEField
from leco_plugin.models.gate import Gate, GateConfig
from leco_plugin.models.hmoe import HMoEConfig
from leco_plugin.models.rendering import Intervals, Rays, composite
from leco_plugin.samplers.kernels import VARIABLE

pytestmark = pytest.mark.skipif(not native.has_native(), reason="no C compiler")
ROWS = torch.contiguous_format
Answer = Callable[[], tuple[Tensor, ...]]


def learned(answer: Answer, wanted: list[Tensor]) -> tuple[list[Tensor], list[Tensor | None]]:
    """Answers, and gradients of sums of them whose factors are all different."""
    answers = answer()
    torch.manual_seed(1)
    loss = torch.stack([(one * torch.randn_like(one)).sum() for one in answers]).sum()
    gradients = torch.autograd.grad(loss, wanted, allow_unused=True)
    return [one.detach() for one in answers], list(gradients)


def check(answer: Answer, wanted: list[Tensor], monkeypatch: pytest.MonkeyPatch) -> None:
    """In C with one thread and with three as in torch."""
    monkeypatch.setattr(native, "FEWEST", 1)
    given = []
    for threads in (1, 3):
        monkeypatch.setattr(torch, "get_num_threads", lambda threads=threads: threads)
        given.append(learned(answer, wanted))
    monkeypatch.setenv(VARIABLE, "native")
    theirs = learned(answer, wanted)
    for ours in given:
        for one, other in zip(ours[0] + ours[1], theirs[0] + theirs[1], strict=True):
            assert (one is None) == (other is None)
            if one is not None and other is not None:
                scale = float(other.abs().max())
                torch.testing.assert_close(one, other, rtol=1e-4, atol=2e-5 * scale + 1e-12)


@pytest.mark.parametrize(("width", "layers", "octaves"), [(64, 3, 6), (17, 1, 9)])
@pytest.mark.parametrize("normed", [True, False])
def test_a_gate_learns_as_torch_does(
    width: int, layers: int, octaves: int, normed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    torch.manual_seed(0)
    gate = Gate(GateConfig(EncodingConfig(octaves=octaves), width, layers, 3, normed))
    gate.norm.bias.data.normal_()
    mapped = (torch.rand(3, 157) * 2 - 1).t()  # the strides of the march
    assert gate.suits_native(mapped)
    check(lambda: (gate(mapped),), list(gate.parameters()), monkeypatch)


@pytest.mark.parametrize(("width", "layers"), [(64, 2), (18, 3)])
def test_a_field_learns_as_torch_does(
    width: int, layers: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One expert has left, and another is asked about nothing: it has no gradient, not zeros."""
    torch.manual_seed(0)
    hash_grid = EncodingConfig("hash", levels=3, log2_table=6, coarsest=4, finest=20)
    field = HMoEField(FieldConfig(hash_grid, HMoEConfig(4, width, layers)), 1)
    for parameter in field.parameters():
        parameter.data.normal_(0.0, 0.2)
    field.experts.drop(2)
    mapped, routes = torch.rand(333, 3) * 2 - 1, torch.tensor([0, 4, 1]).repeat(111)
    factors = (torch.rand(333) + 0.5).requires_grad_()
    wanted = [factors, *(p for name, p in field.named_parameters() if "color" not in name)]
    check(lambda: field.density(mapped, routes, factors), wanted, monkeypatch)


@pytest.mark.parametrize(("width", "hidden"), [(64, 64), (18, 30)])
def test_colours_are_learned_as_by_torch(
    width: int, hidden: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Some samples are not seen, some rays have no sample."""
    torch.manual_seed(0)
    color = ColorHead(width, hidden, 2, 4, num_images=3)
    for parameter in color.parameters():
        parameter.data.normal_(0.0, 0.3)
    num_rays, ray_indices = 40, torch.arange(60).repeat_interleave(5)[50:250] - 10
    weights = (torch.rand(200) - 0.3).clamp(min=0.0).requires_grad_()
    features = torch.randn(200, width, requires_grad=True)
    directions = nn.functional.normalize(torch.randn(num_rays, 3), dim=-1)
    zeros, images = torch.zeros(num_rays), torch.randint(0, 3, (num_rays,))
    rays = Rays(torch.zeros(num_rays, 3), directions, zeros, zeros + 1.0, images, None)
    intervals = Intervals(ray_indices, torch.zeros(200), torch.ones(200))
    ray_indices.clamp_(max=num_rays - 1)

    def answer() -> tuple[Tensor]:
        return (composite(color, features, weights, rays, intervals),)

    check(answer, [features, weights, *color.parameters()], monkeypatch)


def test_positions_that_want_a_gradient_have_it() -> None:
    gate, mapped = Gate(GateConfig(width=16, layers=1)), torch.rand(9, 3, requires_grad=True)
    gate(mapped).sum().backward()
    assert mapped.grad is not None and float(mapped.grad.abs().max()) > 0.0


def test_a_gradient_of_a_gradient_is_refused() -> None:
    gate = Gate(GateConfig(width=16, layers=1))
    total = gate(torch.rand(9, 3)).square().sum()
    first = torch.autograd.grad(total, gate.head.weight, create_graph=True)[0]
    with pytest.raises(RuntimeError, match="once_differentiable"):
        first.sum().backward()


def test_what_is_kept_for_gradients_may_come_back_in_other_strides() -> None:
    """As of torch's `save_on_cpu`, which keeps it in memory of its own."""
    torch.manual_seed(0)
    gate, mapped = Gate(GateConfig(width=16, layers=1)), torch.rand(3, 9).t()

    def gradient() -> Tensor:
        gate.zero_grad()
        gate(mapped).square().sum().backward()
        return gate.hidden[0].weight.grad.clone()

    expected = gradient()
    with torch.autograd.graph.saved_tensors_hooks(
        lambda x: x.clone(memory_format=ROWS), lambda x: x
    ):
        torch.testing.assert_close(gradient(), expected)


def test_what_is_no_number_stays_none() -> None:
    gate = Gate(GateConfig(width=16, layers=1))
    gate.hidden[0].bias.data[3] = torch.nan
    gate(torch.rand(5, 3)).sum().backward()
    assert bool(gate.head.weight.grad.isnan().all())
