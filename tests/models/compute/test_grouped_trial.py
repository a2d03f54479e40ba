"""Grouped products are used where a trial finds them right and faster, and one line says so."""

from __future__ import annotations

import logging

import pytest
import torch

from leco_plugin.models.compute import grouped as grouped_trial
from leco_plugin.models.compute.grouped import is_grouping_faster, is_right, race

pytestmark = pytest.mark.skipif(
    not hasattr(torch.nn.functional, "grouped_mm"), reason="this torch has no grouped_mm"
)
CPU = torch.device("cpu")


@pytest.fixture(autouse=True)
def untried() -> None:
    is_grouping_faster.cache_clear()


class Wrong(torch.autograd.Function):
    """Gradients of matrices without rows are whatever was in memory."""

    @staticmethod
    def forward(ctx, matrices):
        return matrices.clone()

    @staticmethod
    def backward(ctx, gradients):
        empty = (gradients == 0.0).all(dim=-1).all(dim=-1)
        return torch.where(empty[:, None, None], 7.0, gradients)


@pytest.mark.parametrize("fault", ["odd sizes", "no rows"])
def test_products_that_are_wrong_are_found_out(fault: str, monkeypatch, caplog) -> None:
    right = torch.nn.functional.grouped_mm

    def grouped_mm(rows, matrices, *, offs):
        if fault == "no rows":
            return right(rows, Wrong.apply(matrices), offs=offs)
        return right(rows, matrices, offs=(offs + 7) // 8 * 8)

    assert is_right(CPU)
    monkeypatch.setattr(torch.nn.functional, "grouped_mm", grouped_mm)
    assert not is_right(CPU)
    with caplog.at_level(logging.WARNING):
        assert not is_grouping_faster(CPU, 4, 16) and not is_grouping_faster(CPU, 4, 16)
    assert [record.getMessage() for record in caplog.records] == [
        "no grouped products: they are wrong on cpu"
    ]


@pytest.mark.parametrize("error", [torch.OutOfMemoryError, NotImplementedError])
def test_a_trial_that_fails_is_said_in_one_line(error, monkeypatch, caplog) -> None:
    def grouped_mm(*_: object, **__: object) -> None:
        raise error("CUDA out of memory.\nTried to allocate")

    monkeypatch.setattr(torch.nn.functional, "grouped_mm", grouped_mm)
    with caplog.at_level(logging.WARNING):
        assert not is_grouping_faster(CPU, 4, 16) and not is_grouping_faster(CPU, 4, 16)
    assert [record.getMessage() for record in caplog.records] == [
        "no grouped products, one for each expert in their place: CUDA out of memory."
    ]


@pytest.mark.parametrize("faster", [True, False])
def test_the_faster_of_the_two_is_taken(faster: bool, monkeypatch, caplog) -> None:
    monkeypatch.setattr(grouped_trial, "race", lambda *_: (1e-3, 2e-3) if faster else (2e-3, 1e-3))
    with caplog.at_level(logging.INFO):
        assert is_grouping_faster(CPU, 4, 16) == faster
    assert "ms a layer grouped" in caplog.text


def test_both_run_in_the_race(monkeypatch) -> None:
    monkeypatch.setattr(grouped_trial, "ROWS", 64)
    assert min(race(CPU, 3, 16)) > 0.0
