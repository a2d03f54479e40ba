"""Rows are moved as indexing moves them, forward and backward."""

from __future__ import annotations

import torch

from leco_plugin.models.compute.dispatch import permute_rows, select_rows


def test_permuting_is_indexing() -> None:
    rows = torch.randn(9, 4, dtype=torch.float64, requires_grad=True)
    order = torch.randperm(9)
    weights = torch.randn(9, 4, dtype=torch.float64)
    moved = permute_rows(rows, order, order.argsort())
    assert torch.equal(moved, rows[order])
    (gradient,) = torch.autograd.grad((moved * weights).sum(), rows)
    (expected,) = torch.autograd.grad((rows[order] * weights).sum(), rows)
    assert torch.equal(gradient, expected)


def test_selecting_is_indexing_and_rows_left_out_receive_nothing() -> None:
    rows = torch.randn(9, 4, dtype=torch.float64, requires_grad=True)
    chosen = torch.tensor([7, 0, 3])
    weights = torch.randn(3, 4, dtype=torch.float64)
    taken = select_rows(rows, chosen)
    assert torch.equal(taken, rows[chosen])
    (gradient,) = torch.autograd.grad((taken * weights).sum(), rows)
    (expected,) = torch.autograd.grad((rows[chosen] * weights).sum(), rows)
    assert torch.equal(gradient, expected)
