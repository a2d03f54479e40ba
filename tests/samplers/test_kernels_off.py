"""Kernels are off that the user names, and no others."""

from __future__ import annotations

import pytest
import torch

from leco_plugin.models.compute import grouped
from leco_plugin.samplers.kernels import NAMES, VARIABLE, fused, kernels_off

CUDA = torch.device("cuda")


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("", set()),
        ("march", {"march"}),
        ("gate,experts", {"gate", "experts"}),
        (" march  gate ", {"gate", "march"}),
        ("all", NAMES),
    ],
)
def test_those_that_are_named_are_off(text: str, names: set[str], monkeypatch) -> None:
    monkeypatch.setenv(VARIABLE, text)
    assert kernels_off() == names


def test_none_is_off_by_itself(monkeypatch) -> None:
    monkeypatch.delenv(VARIABLE, raising=False)
    assert kernels_off() == frozenset()


def test_an_unknown_name_is_refused_with_those_that_there_are(monkeypatch) -> None:
    monkeypatch.setenv(VARIABLE, "gates")
    with pytest.raises(
        ValueError, match="names gates; it takes experts, gate, march, native, or all"
    ):
        kernels_off()


def test_a_kernel_that_is_off_is_not_tried(monkeypatch) -> None:
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    monkeypatch.setattr(fused, "_off", set())
    monkeypatch.delenv(VARIABLE, raising=False)
    assert fused.is_ready(CUDA, "gate") and fused.is_ready(CUDA, "march")
    monkeypatch.setenv(VARIABLE, "march")
    assert fused.is_ready(CUDA, "gate") and not fused.is_ready(CUDA, "march")
    assert not fused.is_ready(torch.device("cpu"))


def test_experts_that_are_off_are_not_grouped(monkeypatch) -> None:
    monkeypatch.setattr(grouped, "is_grouping_faster", lambda *_: True)
    monkeypatch.setattr(torch.nn.functional, "grouped_mm", None, raising=False)
    monkeypatch.setattr(torch, "get_autocast_dtype", lambda _: torch.bfloat16)

    class OnCuda:
        """Features on a device that is not here."""

        device, dtype = CUDA, torch.bfloat16

        def __len__(self) -> int:
            return 5

    features: torch.Tensor = OnCuda()  # type: ignore[assignment]
    monkeypatch.delenv(VARIABLE, raising=False)
    assert grouped.may_group(features, 4, 64)
    monkeypatch.setenv(VARIABLE, "experts")
    assert not grouped.may_group(features, 4, 64)
