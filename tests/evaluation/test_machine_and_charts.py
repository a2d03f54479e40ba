"""Claims about the description of the machine, stored JSON, and the chart."""

from __future__ import annotations

import datetime
import json
import platform
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from leco_plugin.chart.drawing.theme import DARK, LIGHT, Theme
from leco_plugin.evaluation.charts import psnr_against_seconds
from leco_plugin.evaluation.json_file import write_json
from leco_plugin.evaluation.machine import describe_code, describe_machine, made_by


def test_the_machine_is_described_without_its_name() -> None:
    text = json.dumps(describe_machine())
    assert {"cpu", "cores", "device", "torch"} <= json.loads(text).keys()
    assert "/" not in json.loads(text)["device"]
    assert not platform.node() or platform.node() not in text


def test_a_figure_says_what_made_it_and_when() -> None:
    code = describe_code()
    assert code == describe_code() and len(code["sources"]) == 12
    made = made_by(code)
    assert made["code"] == code and datetime.date.fromisoformat(made["date"])


def test_what_is_no_json_leaves_no_file(tmp_path: Path) -> None:
    with pytest.raises(ValueError):
        write_json(tmp_path / "report.json", {"psnr": float("nan")})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("theme", [LIGHT, DARK], ids=["light", "dark"])
def test_the_chart_marks_both_runs_and_the_freezing(theme: Theme, tmp_path: Path) -> None:
    curve = [[10.0 * i, 18.0 + i] for i in range(1, 6)]
    runs = [
        {"method": "a", "train_seconds": 50.0, "curve": curve, "freeze_seconds": 12.0},
        {"method": "b", "train_seconds": 50.0, "curve": [[t, p - 1.0] for t, p in curve]},
    ]
    path = psnr_against_seconds(runs, tmp_path / "chart.png", "b loses", "a city", theme=theme)
    image = np.asarray(Image.open(path).convert("RGB")).reshape(-1, 3).astype(int)
    for colour, fewest in {theme.page: 200_000, **dict.fromkeys(theme.colours[:2], 500)}.items():
        wanted = [int(colour[i : i + 2], 16) for i in (1, 3, 5)]
        assert (np.abs(image - wanted).max(axis=1) < 8).sum() > fewest
