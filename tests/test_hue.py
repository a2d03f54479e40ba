"""Claims about the errors in hue and on thin lines, and about the runs whose errors are stored."""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import hue
import pytest
import torch

from leco_plugin.evaluation.report import made_by


def test_grey_images_and_painted_over_lines_have_errors_of_one() -> None:
    """A line of one pixel on a coloured ground; lightness is no error of hue."""
    ground = torch.tensor([0.2, 0.5, 0.3])
    truth = ground.repeat(20, 30, 1)
    truth[10] = torch.tensor([0.9, 0.1, 0.1])
    grey = truth.mean(dim=-1, keepdim=True).expand_as(truth)
    assert hue.hue_error(truth, truth) == hue.thin_error(truth, truth) == 0.0
    assert hue.hue_error(grey, truth) == pytest.approx(1.0)
    assert hue.hue_error(truth + 0.05, truth) == pytest.approx(0.0, abs=1e-5)
    assert hue.thin_error(ground.expand_as(truth), truth) == pytest.approx(1.0)


def test_stored_runs_are_made_again_only_after_a_change_of_the_code(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    made: list[tuple[str, int, float]] = []

    def train(data: Path, seconds: float, seed: int, weight: float) -> dict[str, Any]:
        made.append((data.name, seed, weight))
        figures = {"psnr": 20.0 + seed, "hue": 0.5 - seed / 8, "thin": 1.0}
        asked = {"scene": data.name, "seed": seed, "weight": weight, "seconds": seconds}
        return {**asked, **figures, **made_by(hue.describe_code())}

    monkeypatch.setattr(hue, "train", train)
    monkeypatch.setattr(hue, "ProcessPoolExecutor", lambda at_once, _: ThreadPoolExecutor(at_once))
    out = tmp_path / "hue.json"
    asked = ["town", "--out", str(out), "--weights", "8", "--seeds"]
    hue.main([*asked, "0"])
    hue.main([*asked, "0", "1"])
    assert made == [("town", 0, 8.0), ("town", 1, 8.0)]
    page = "\n".join(hue.hue_section(json.loads(out.read_text())))
    assert "| town | 8 | 20.5 (20.0 to 21.0) | 0.438 (0.375 to 0.500) | 1.000 (" in page
    changed = hue.describe_code() | {"sources": "other"}
    monkeypatch.setattr(hue, "describe_code", lambda: changed)
    hue.main([*asked, "1"])
    assert made[2:] == [("town", 1, 8.0)]
    assert [row["seed"] for row in json.loads(out.read_text())["runs"]] == [1]
