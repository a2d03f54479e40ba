"""One process has nothing to agree on with others; `tests/test_data_parallel.py` has two."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from leco_plugin.models.compute import ranks

CPU = torch.device("cpu")


def test_one_process_decides_alone() -> None:
    assert not ranks.is_distributed() and ranks.is_first()
    assert ranks.mean(1.5, CPU) == 1.5
    assert ranks.from_first(lambda: {"rays": 3}, CPU) == {"rays": 3}


def test_its_tensors_stay_as_they_are() -> None:
    value = torch.rand(3)
    before = value.clone()
    ranks.share([value])
    assert torch.equal(value, before)


def test_its_model_is_trained_as_it_is() -> None:
    model = nn.Linear(1, 1)
    assert ranks.averaging(model, CPU) is model


def test_tensors_in_other_strides_are_shared_too(monkeypatch: pytest.MonkeyPatch) -> None:
    firsts = [torch.rand(3, 2), torch.rand(2, 3)]
    sent = iter(firsts)

    def broadcast(given: torch.Tensor, src: int) -> None:
        given.copy_(next(sent).contiguous().view(-1).view(torch.uint8))

    monkeypatch.setattr(ranks, "is_distributed", lambda: True)
    monkeypatch.setattr(ranks.distributed, "broadcast", broadcast)
    values = [torch.zeros(3, 2), torch.zeros(3, 2).T]
    ranks.share(values)
    assert all(map(torch.equal, values, firsts))
