"""Packed sums and products against the same loops written out, and their gradients."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from leco_plugin.samplers import scan
from leco_plugin.samplers.scan import (
    exclusive_prod,
    exclusive_sum,
    inclusive_prod,
    inclusive_sum,
    pack_info,
)

SCANS = [inclusive_sum, exclusive_sum, inclusive_prod, exclusive_prod]
counts_of_rays = st.lists(st.integers(0, 6), min_size=0, max_size=8)


def slow_scan(function, inputs: Tensor, ray_indices: Tensor) -> list[float]:
    start = 1.0 if "prod" in function.__name__ else 0.0
    outputs, running, last = [], start, -1
    for value, ray in zip(inputs.tolist(), ray_indices.tolist(), strict=True):
        running = start if ray != last else running
        after = running * value if start else running + value
        outputs.append(running if "exclusive" in function.__name__ else after)
        running, last = after, ray
    return outputs


def indices_of(counts: list[int]) -> Tensor:
    return torch.repeat_interleave(torch.arange(len(counts)), torch.tensor(counts).long())


@given(counts=counts_of_rays)
def test_pack_info_is_start_and_count(counts):
    info = pack_info(indices_of(counts), len(counts))
    starts = [sum(counts[:ray]) for ray in range(len(counts))]
    assert info.tolist() == [list(pair) for pair in zip(starts, counts, strict=True)]


def test_pack_info_finds_the_number_of_rays():
    assert pack_info(torch.tensor([0, 0, 3])).tolist() == [[0, 2], [2, 0], [2, 0], [2, 1]]
    assert pack_info(torch.zeros(0, dtype=torch.int64)).shape == (0, 2)


@pytest.mark.parametrize("function", SCANS)
@settings(deadline=None)
@given(counts=counts_of_rays, seed=st.integers(0, 2**16), zeros=st.booleans())
def test_packed_scans_are_loops_over_rays(function, counts, seed, zeros):
    ray_indices = indices_of(counts)
    torch.manual_seed(seed)
    inputs = torch.randn(len(ray_indices), dtype=torch.float64)
    if zeros:
        inputs[torch.rand(len(inputs)) < 0.3] = 0.0
    expected = slow_scan(function, inputs, ray_indices)
    for described in (
        {"packed_info": pack_info(ray_indices, len(counts))},
        {"indices": ray_indices},
    ):
        assert function(inputs, **described).tolist() == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("function", SCANS)
def test_batched_scans_run_along_the_last_dimension(function):
    inputs = torch.randn(3, 7, dtype=torch.float64)
    flat = function(inputs.flatten(), indices=torch.arange(3).repeat_interleave(7))
    torch.testing.assert_close(function(inputs), flat.view(3, 7))


@pytest.mark.parametrize("function", SCANS)
def test_gradients_are_exact_also_at_zeros(function):
    ray_indices = indices_of([4, 0, 5, 1, 3])
    inputs = torch.randn(13, dtype=torch.float64)
    inputs[[1, 5, 7, 9]] = 0.0  # one zero on a ray, two on the next, and a ray of only a zero
    inputs.requires_grad_()
    assert torch.autograd.gradcheck(lambda x: function(x, indices=ray_indices), inputs)


@pytest.mark.parametrize("function", SCANS)
def test_columns_are_scanned_each_by_itself(function):
    ray_indices, inputs = indices_of([3, 0, 4]), torch.randn(7, 2, dtype=torch.float64)
    columns = [function(column, indices=ray_indices) for column in inputs.unbind(-1)]
    torch.testing.assert_close(function(inputs, indices=ray_indices), torch.stack(columns, dim=-1))


def test_ten_million_float32_samples_keep_their_digits():
    generator = torch.Generator().manual_seed(0)
    counts = torch.randint(0, 200, (100_000,), generator=generator)
    ray_indices = torch.repeat_interleave(torch.arange(100_000), counts)
    inputs = torch.rand(len(ray_indices), generator=generator)
    assert len(inputs) > 9_900_000
    sums = inclusive_sum(inputs, pack_info(ray_indices, 100_000))
    last_rays = slice(-5000, None)  # where a global float32 scan has lost most
    exact = slow_scan(inclusive_sum, inputs.double()[last_rays], ray_indices[last_rays])
    first = int((ray_indices[last_rays] != ray_indices[-5000]).nonzero()[0])
    got = sums[last_rays][first:]
    torch.testing.assert_close(got, torch.tensor(exact)[first:].float(), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("bad", [torch.inf, -torch.inf, torch.nan])
@pytest.mark.parametrize("function", SCANS)
def test_a_bad_value_stays_on_its_ray(function, bad):
    ray_indices, inputs = indices_of([2, 3, 2]), torch.tensor([1.0, 2.0, -1.0, bad, 0.5, 3.0, 1.0])
    outputs = function(inputs, indices=ray_indices)
    expected = torch.tensor(slow_scan(function, inputs, ray_indices))
    torch.testing.assert_close(outputs, expected, equal_nan=True)


@pytest.mark.parametrize("bad", [torch.inf, -torch.inf, torch.nan])
@pytest.mark.parametrize("function", SCANS)
def test_what_a_bad_value_does_to_gradients_stays_on_its_ray(function, bad):
    ray_indices, values = indices_of([2, 3, 2]), torch.tensor([1.0, 2.0, -1.0, 4.0, 0.5, 3.0, 1.0])

    def gradients(middle: float) -> Tensor:
        inputs = values.clone()
        inputs[3] = middle
        inputs.requires_grad_()
        (function(inputs, indices=ray_indices) * values).sum().backward()
        return inputs.grad

    elsewhere = ray_indices != 1
    torch.testing.assert_close(gradients(bad)[elsewhere], gradients(4.0)[elsewhere])


@pytest.mark.parametrize("function", SCANS)
def test_a_bad_gradient_stays_on_its_ray(function):
    ray_indices, inputs = indices_of([2, 3, 2]), torch.rand(7).add(0.5).requires_grad_()
    weights = torch.tensor([1.0, 2.0, -1.0, torch.nan, 0.5, 3.0, 1.0])
    (function(inputs, indices=ray_indices) * weights).sum().backward()
    bad = inputs.grad.isnan()
    assert bad[2] and not bad[[0, 1, 5, 6]].any()


@pytest.mark.parametrize("function", [inclusive_prod, exclusive_prod])
def test_signs_zeros_and_nan_of_a_product_are_counted_apart(function):
    rays = [-1, -2, -3], [], [0, torch.nan, -1, 0], [torch.nan, 0, 0, 1], [-1, -1, 5]
    ray_indices = indices_of([len(ray) for ray in rays])
    inputs = torch.tensor([value for ray in rays for value in ray], dtype=torch.float64)
    expected = torch.tensor(slow_scan(function, inputs, ray_indices), dtype=torch.float64)
    outputs = function(inputs, indices=ray_indices)
    torch.testing.assert_close(outputs, expected, equal_nan=True)


@pytest.mark.parametrize("function", SCANS)
def test_devices_without_float64_agree(function, monkeypatch):
    torch.manual_seed(0)  # a factor near zero makes a product's gradient less exact in float32
    ray_indices, inputs = indices_of([4, 0, 5, 1, 3]), torch.rand(13).requires_grad_()
    expected = function(inputs, indices=ray_indices)
    (expected_grad,) = torch.autograd.grad(expected.square().sum(), inputs)
    monkeypatch.setattr(scan, "has_float64", lambda device: False)
    outputs = function(inputs, indices=ray_indices)
    torch.testing.assert_close(outputs, expected)
    (grad,) = torch.autograd.grad(outputs.square().sum(), inputs)
    torch.testing.assert_close(grad, expected_grad)


@pytest.mark.parametrize("function", SCANS)
def test_no_samples_is_no_samples(function):
    empty = torch.zeros(0, requires_grad=True)
    outputs = function(empty, pack_info(torch.zeros(0, dtype=torch.int64), 3))
    outputs.sum().backward()
    assert outputs.shape == (0,)


def test_shapes_that_do_not_fit_are_named():
    with pytest.raises(ValueError, match=r"\(3,\) does not fit 4 samples"):
        inclusive_sum(torch.ones(4), indices=torch.zeros(3, dtype=torch.int64))
    with pytest.raises(ValueError, match=r"packed_info must be \[n_rays, 2\]"):
        inclusive_sum(torch.ones(4), torch.zeros(3, dtype=torch.int64))
    with pytest.raises(ValueError, match=r"ray_indices must be \[n_samples\]"):
        pack_info(torch.zeros(2, 2, dtype=torch.int64))
