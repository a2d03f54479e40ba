"""Claims about the picture of what each expert gets while an occupancy is learned."""

from __future__ import annotations

from pathlib import Path

import learning
import pytest
import torch
from PIL import Image

from leco_plugin.chart.theme import SOURCE, fingerprint
from leco_plugin.learning.history import GateHistory


def history() -> GateHistory:
    """Four looks; from the third on half, then three quarters, of the points are empty."""
    shares = [[0.0, 1.0, 0.0], [0.2, 0.8, 0.0], [0.5, 0.25, 0.25], [0.75, 0.0, 0.25]]
    densities = [[0.0, 1.0, 0.0], [1.0, 9.0, 0.0], [2.0, 100.0, 300.0], [4.0, 0.0, 1e13]]
    rows = {"steps": [0, 10, 20, 30], "shares": shares, "densities": densities}
    tensors = {name: torch.tensor(values) for name, values in rows.items()}
    return GateHistory([{name: tensors[name][look] for name in tensors} for look in range(4)])


def test_the_sentence_is_of_the_later_looks_and_opaque_is_opaque() -> None:
    report = learning.report_of(history(), "city", "2024-02-29")
    share, empty, scene = learning.late_means(report)
    assert share == pytest.approx(0.625) and empty == pytest.approx(3.0)
    assert scene == pytest.approx((200.0 + learning.OPAQUE) / 2)
    assert learning.sentence(report) == (
        "The empty-space expert takes 62% of the points; they are about 1,700 times less dense "
        "than the rest"
    )
    empty = {**report, "densities": [[0.0, *rest] for _, *rest in report["densities"]]}
    assert learning.sentence(empty).endswith("takes 62% of the points, which have no density")


def test_an_expert_without_points_has_no_density() -> None:
    report = learning.report_of(history(), "city", "2024-02-29")
    known = torch.tensor(learning.without_none(report)).isfinite().tolist()
    assert known == [[share > 0.0 for share in row] for row in report["shares"]]


def test_the_picture_remembers_of_which_figures_it_is(tmp_path: Path) -> None:
    report = learning.report_of(history(), "city", "2024-02-29")
    with Image.open(learning.draw(tmp_path / "learning.png", report)) as image:
        assert image.info[SOURCE] == fingerprint(report)
