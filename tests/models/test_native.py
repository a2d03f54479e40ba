"""The routines in C against their slow twins in torch."""

from __future__ import annotations

import logging

import pytest
import torch
from torch import Tensor

from leco_plugin.models.compute import native
from leco_plugin.models.encodings import HashEncoding
from leco_plugin.samplers.kernels import VARIABLE

needs_compiler = pytest.mark.skipif(not native.has_native(), reason="no C compiler")


def features_and_gradient(encoding: HashEncoding, positions: Tensor) -> tuple[Tensor, Tensor]:
    features = encoding(positions)
    worth = torch.linspace(-1.0, 1.0, features.numel()).view_as(features)
    return features.detach(), torch.autograd.grad((features * worth).sum(), encoding.table)[0]


@needs_compiler
@pytest.mark.parametrize("features", [1, 2, 4])
@pytest.mark.parametrize("threads", [1, 3])
def test_a_hash_grid_is_that_of_torch(
    features: int, threads: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    torch.manual_seed(0)
    encoding = HashEncoding(levels=5, features=features, log2_table=9, coarsest=4, finest=300)
    positions = torch.cat([torch.rand(331, 3) * 2 - 1, torch.tensor([[-1.0] * 3, [1.0] * 3])])
    monkeypatch.setattr(native, "FEWEST", 1)
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads)
    ours = features_and_gradient(encoding, positions)
    monkeypatch.setenv(VARIABLE, "native")
    theirs = features_and_gradient(encoding, positions)
    torch.testing.assert_close(ours[0], theirs[0], rtol=1e-6, atol=1e-10)
    torch.testing.assert_close(ours[1], theirs[1], rtol=1e-4, atol=1e-5)


@needs_compiler
def test_positions_in_other_strides_are_read_as_they_are() -> None:
    encoding = HashEncoding(levels=2, features=2, log2_table=6, coarsest=4, finest=9)
    columns = torch.rand(3, 50) * 2 - 1
    assert torch.equal(encoding(columns.t()), encoding(columns.t().contiguous()))


def test_without_a_compiler_torch_answers_and_the_log_says_so(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    native._library.cache_clear()
    monkeypatch.setattr(native.shutil, "which", lambda _: None)
    try:
        with caplog.at_level(logging.INFO):
            assert not native.has_native()
        encoding = HashEncoding(levels=2, features=2, log2_table=6, coarsest=4, finest=9)
        assert encoding(torch.rand(7, 3)).shape == (7, 4)
    finally:
        native._library.cache_clear()
    assert "no C compiler" in caplog.text


def test_a_compiler_that_fails_is_named_with_what_it_said(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    native._library.cache_clear()
    monkeypatch.setattr(native, "FLAGS", ("--no-such-flag",))
    try:
        with caplog.at_level(logging.INFO):
            found = native.has_native()
    finally:
        native._library.cache_clear()
    assert not found
    assert "no-such-flag" in caplog.text or "no C compiler" in caplog.text
