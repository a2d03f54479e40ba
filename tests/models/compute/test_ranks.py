"""One process has nothing to agree on with others; `tests/test_data_parallel.py` has two."""

from __future__ import annotations

import logging

import pytest
import torch
from torch import nn

from leco_plugin.models.compute import ranks

CPU = torch.device("cpu")


def test_one_process_decides_alone() -> None:
    assert not ranks.several() and ranks.is_first()
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


@pytest.mark.parametrize("first", [True, False])
def test_only_the_first_speaks(
    first: bool, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ranks, "is_first", lambda: first)
    ranks.say("hear, hear")
    assert ("[leco] hear, hear" in capsys.readouterr().out) == first


@pytest.fixture
def logged(monkeypatch: pytest.MonkeyPatch) -> logging.Logger:
    """The logger of a sampler, whose lines are said; the package's is put back afterwards."""
    log = logging.getLogger("leco_plugin")
    monkeypatch.setattr(log, "handlers", [])
    monkeypatch.setattr(log, "level", log.level)
    ranks.say_what_is_logged()
    ranks.say_what_is_logged()
    return logging.getLogger("leco_plugin.samplers.somewhere")


def test_what_samplers_log_is_said_once(
    logged: logging.Logger, capsys: pytest.CaptureFixture[str]
) -> None:
    logged.info("no fused gate: %s", "it is [wide]")
    assert capsys.readouterr().out.count("[leco] no fused gate: it is [wide]") == 1


def test_a_process_that_is_not_the_first_only_warns(
    logged: logging.Logger, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ranks, "is_first", lambda: False)
    monkeypatch.setattr(ranks.distributed, "get_rank", lambda: 3)
    of_its_card = logging.getLogger("leco_plugin.samplers.kernels.fused")
    of_its_card.info("the fused gate answers")
    of_its_card.warning("the fused gate does not run")
    logged.warning("no cell cache in any process")
    said = capsys.readouterr().out
    assert "[leco] process 3: the fused gate does not run" in said
    assert "answers" not in said and "cell cache" not in said
