"""Volume rendering of packed samples against the sums of the definition."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from samplers.analytic_occupancy import slow_weights
from torch import Tensor

from leco_plugin.samplers import packed

N_RAYS = 6
RAYS = torch.tensor([0, 0, 0, 2, 2, 3, 3, 3, 3, 5])
BY_RAY = {"ray_indices": RAYS, "n_rays": N_RAYS}


def random_samples(seed: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    torch.manual_seed(seed)
    t_starts = torch.rand(len(RAYS), dtype=torch.float64)
    t_ends = t_starts + torch.rand(len(RAYS), dtype=torch.float64)
    return t_starts, t_ends, torch.rand(len(RAYS), dtype=torch.float64) * 3.0


@settings(deadline=None)
@given(seed=st.integers(0, 2**16))
def test_weights_follow_the_definition(seed):
    t_starts, t_ends, sigmas = random_samples(seed)
    expected = slow_weights(sigmas * (t_ends - t_starts), RAYS)
    info = packed.pack_info(RAYS, N_RAYS)
    for rays in (BY_RAY, {"packed_info": info}):
        outputs = packed.render_weight_from_density(t_starts, t_ends, sigmas, **rays)
        for output, slow in zip(outputs, expected, strict=True):
            assert output.tolist() == pytest.approx(slow, abs=1e-12)
    alphas = torch.tensor(expected[2], dtype=torch.float64)
    outputs = packed.render_weight_from_alpha(alphas, **BY_RAY)
    for output, slow in zip(outputs, expected[:2], strict=True):
        assert output.tolist() == pytest.approx(slow, abs=1e-12)


def test_batched_samples_render_like_packed_ones():
    t_starts, t_ends, sigmas = (torch.rand(3, 8, dtype=torch.float64) for _ in range(3))
    rays = {"ray_indices": torch.arange(3).repeat_interleave(8), "n_rays": 3}
    batched = packed.render_weight_from_density(t_starts, t_ends, sigmas)
    flat = packed.render_weight_from_density(
        t_starts.flatten(), t_ends.flatten(), sigmas.flatten(), **rays
    )
    for one, other in zip(batched, flat, strict=True):
        torch.testing.assert_close(one.flatten(), other)
    weights, values = torch.rand(3, 8), torch.rand(3, 8, 2)
    torch.testing.assert_close(
        packed.accumulate_along_rays(weights, values),
        packed.accumulate_along_rays(weights.flatten(), values.flatten(0, 1), **rays),
    )
    torch.testing.assert_close(
        packed.accumulate_along_rays(weights),
        packed.accumulate_along_rays(weights.flatten(), **rays),
    )


@pytest.mark.parametrize("batched", [False, True])
def test_weights_have_exact_gradients(batched):
    t_starts, t_ends, sigmas = random_samples()
    shape = (2, 5) if batched else (10,)
    rays = {} if batched else BY_RAY
    inputs = [tensor.view(shape).requires_grad_() for tensor in (t_starts, t_ends, sigmas)]
    for outputs in ([0], [1], [2], [0, 1, 2]):
        assert torch.autograd.gradcheck(
            lambda *tensors, chosen=outputs: tuple(
                packed.render_weight_from_density(*tensors, **rays)[i] for i in chosen
            ),
            inputs,
        )


@pytest.mark.parametrize("batched", [False, True])
def test_weights_and_sums_have_exact_second_gradients(batched):
    t_starts, t_ends, sigmas = random_samples()
    shape = (2, 5) if batched else (10,)
    rays = {} if batched else BY_RAY
    inputs = [tensor.view(shape).requires_grad_() for tensor in (t_starts, t_ends, sigmas)]
    assert torch.autograd.gradgradcheck(
        lambda *samples: packed.render_weight_from_density(*samples, **rays), inputs
    )
    values = torch.rand(*shape, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradgradcheck(
        lambda weights, values: packed.accumulate_along_rays(weights, values, **rays),
        (inputs[2], values),
    )


def test_a_packed_product_says_that_it_has_no_second_gradient():
    alphas = torch.rand(10, requires_grad=True)
    trans = packed.render_transmittance_from_alpha(alphas, **BY_RAY)
    (gradient,) = torch.autograd.grad(trans.square().sum(), alphas, create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        gradient.sum().backward()


def test_alpha_weights_have_exact_gradients_at_opaque_samples():
    alphas = torch.rand(10, dtype=torch.float64)
    alphas[[1, 5, 7, 9]] = 1.0
    alphas.requires_grad_()
    assert torch.autograd.gradcheck(
        lambda a: packed.render_weight_from_alpha(a, **BY_RAY),
        alphas,
        eps=1e-7,
    )


def test_accumulation_is_a_sum_with_exact_gradients_in_any_order():
    order = torch.randperm(10)
    weights = torch.rand(10, dtype=torch.float64, requires_grad=True)
    values = torch.rand(10, 3, dtype=torch.float64, requires_grad=True)
    sums = packed.accumulate_along_rays(weights, values, RAYS[order], N_RAYS)
    for ray in range(N_RAYS):
        of_ray = RAYS[order] == ray
        expected = (weights[of_ray, None] * values[of_ray]).sum(dim=0)
        torch.testing.assert_close(sums[ray], expected)
    assert torch.autograd.gradcheck(
        lambda w, v: packed.accumulate_along_rays(w, v, RAYS[order], N_RAYS), (weights, values)
    )
    assert torch.autograd.gradcheck(
        lambda w: packed.accumulate_along_rays(w, None, RAYS[order], N_RAYS), weights
    )


def test_ten_million_float32_weights_are_as_good_as_their_inputs():
    generator = torch.Generator().manual_seed(1)
    ray_indices = torch.arange(100_000).repeat_interleave(100)
    depths = torch.rand(10_000_000, generator=generator) * 0.1
    zeros = torch.zeros_like(depths)
    weights, *_ = packed.render_weight_from_density(
        zeros, zeros + 1.0, depths, ray_indices=ray_indices, n_rays=100_000
    )
    last = slow_weights(depths[-1000:].double(), ray_indices[-1000:])[0]
    torch.testing.assert_close(weights[-1000:], torch.tensor(last).float(), rtol=2e-6, atol=1e-8)


@pytest.mark.parametrize("bad", [torch.nan, torch.inf])
def test_a_bad_density_does_not_leave_its_ray(bad):
    t_starts, t_ends, sigmas = (tensor.float() for tensor in random_samples())
    clean = packed.render_weight_from_density(t_starts, t_ends, sigmas, **BY_RAY)[0]
    sigmas[4] = bad
    weights = packed.render_weight_from_density(t_starts, t_ends, sigmas, **BY_RAY)[0]
    torch.testing.assert_close(weights[RAYS != 2], clean[RAYS != 2])
    assert weights[4].isnan() == (bad != bad)


@pytest.mark.parametrize("bad", [torch.nan, torch.inf])
@pytest.mark.parametrize("by", ["density", "alpha"])
def test_what_a_bad_sample_does_to_gradients_stays_on_its_ray(by, bad):
    t_starts, t_ends, sigmas = random_samples()
    alphas = sigmas / 4.0

    def gradients(value: float | None) -> Tensor:
        inputs = (sigmas if by == "density" else alphas).clone()
        if value is not None:
            inputs[4] = value
        inputs.requires_grad_()
        if by == "density":
            outputs = packed.render_weight_from_density(t_starts, t_ends, inputs, **BY_RAY)
        else:
            outputs = packed.render_weight_from_alpha(inputs, **BY_RAY)
        sum((output * t_ends).sum() for output in outputs).backward()
        return inputs.grad

    found, clean = gradients(bad), gradients(None)
    torch.testing.assert_close(found[RAYS != 2], clean[RAYS != 2])
    assert found[4].isnan() or bad == bad


@pytest.mark.parametrize("bad", [torch.nan, torch.inf, -torch.inf])
def test_a_gradient_that_is_no_number_does_not_leave_its_ray(bad):
    t_starts, t_ends, sigmas = random_samples()

    def gradients(of_fifth: float) -> Tensor:
        inputs = sigmas.clone().requires_grad_()
        weights = packed.render_weight_from_density(t_starts, t_ends, inputs, **BY_RAY)[0]
        given = t_ends.clone()
        given[4] = of_fifth
        weights.backward(given)
        return inputs.grad

    found, clean = gradients(bad), gradients(1.0)
    torch.testing.assert_close(found[RAYS != 2], clean[RAYS != 2])
    assert not found[4].isfinite()


def test_prefix_transmittance_scales_weights():
    t_starts, t_ends, sigmas = random_samples()
    prefix = torch.rand(10, dtype=torch.float64)
    plain = packed.render_weight_from_density(t_starts, t_ends, sigmas, **BY_RAY)
    scaled = packed.render_weight_from_density(
        t_starts, t_ends, sigmas, **BY_RAY, prefix_trans=prefix
    )
    torch.testing.assert_close(scaled[0], plain[0] * prefix)
    torch.testing.assert_close(scaled[1], plain[1] * prefix)


def test_visibility_is_two_comparisons():
    t_starts, t_ends, sigmas = random_samples()
    _, trans, alphas = packed.render_weight_from_density(t_starts, t_ends, sigmas, **BY_RAY)
    expected = (trans >= 0.5) & (alphas >= 0.4)
    limits = {"early_stop_eps": 0.5, "alpha_thre": 0.4}
    by_density = packed.render_visibility_from_density(t_starts, t_ends, sigmas, **BY_RAY, **limits)
    assert by_density.equal(expected)
    assert packed.render_visibility_from_alpha(alphas, **BY_RAY, **limits).equal(expected)


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_half_precision_is_taken_to_float32(dtype):
    t_starts, t_ends, sigmas = random_samples()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        weights = packed.render_weight_from_density(
            t_starts.float(), t_ends.float(), sigmas.to(dtype), **BY_RAY
        )[0]
        colors = packed.accumulate_along_rays(weights, torch.rand(10, 3).to(dtype), **BY_RAY)
    exact = packed.render_weight_from_density(
        t_starts, t_ends, sigmas.to(dtype).double(), **BY_RAY
    )[0]
    assert weights.dtype == colors.dtype == torch.float32
    torch.testing.assert_close(weights.double(), exact, rtol=1e-5, atol=1e-6)


def test_no_samples_render_black_and_can_be_backpropagated_through():
    empty, indices = torch.zeros(0, requires_grad=True), torch.zeros(0, dtype=torch.int64)
    rays = {"ray_indices": indices, "n_rays": 2}
    weights, _, _ = packed.render_weight_from_density(empty, empty, empty, **rays)
    colors = packed.accumulate_along_rays(weights, torch.zeros(0, 3, requires_grad=True), **rays)
    colors.sum().backward()
    assert colors.equal(torch.zeros(2, 3))


def test_rendering_and_its_gradients_wait_for_no_device():
    # a tensor without values ends in an error whatever reads one
    t_starts, t_ends, sigmas = (torch.rand(10, device="meta") for _ in range(3))
    sigmas.requires_grad_()
    rays = {"ray_indices": RAYS.to("meta"), "n_rays": N_RAYS}
    weights, _, alphas = packed.render_weight_from_density(t_starts, t_ends, sigmas, **rays)
    by_alpha, trans = packed.render_weight_from_alpha(alphas, **rays)
    colors = packed.accumulate_along_rays(weights + by_alpha, torch.rand(10, 3).to("meta"), **rays)
    sums = packed.inclusive_sum(trans, packed.pack_info(rays["ray_indices"], N_RAYS))
    (colors.sum() + sums.sum()).backward()
    assert sigmas.grad.shape == (10,)
    seen = packed.render_visibility_from_density(t_starts, t_ends, sigmas, **rays, alpha_thre=0.1)
    assert seen.shape == (10,)


def test_shapes_that_do_not_fit_are_named():
    with pytest.raises(ValueError, match=r"\(3,\), \(3,\), \(4,\)"):
        packed.render_weight_from_density(torch.ones(3), torch.ones(3), torch.ones(4))
    with pytest.raises(ValueError, match=r"n_rays \(got None\)"):
        packed.accumulate_along_rays(torch.ones(3), None, torch.zeros(3, dtype=torch.int64))
    with pytest.raises(ValueError, match=r"values \(2, 3\) do not fit weights \(3,\)"):
        packed.accumulate_along_rays(torch.ones(3), torch.ones(2, 3))
