"""Claims about the description of the machine, stored JSON."""

from __future__ import annotations

import datetime
import json
import math
import platform
from pathlib import Path

import pytest
import torch

from leco_plugin.evaluation.report import (
    describe_code,
    describe_cores,
    describe_machine,
    made_by,
)
from leco_plugin.scenes.whole_files import write_json


def test_the_machine_is_described_without_its_name() -> None:
    text = json.dumps(describe_machine())
    assert {"cpu", "cores", "device", "torch"} <= json.loads(text).keys()
    assert "/" not in json.loads(text)["device"]
    assert not platform.node() or platform.node() not in text


@pytest.mark.parametrize("vectors", ["AVX2", "AVX512"])
def test_cores_are_named_with_their_vectors(monkeypatch: pytest.MonkeyPatch, vectors: str) -> None:
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: vectors)
    assert describe_machine()["cpu"].endswith(f" ({vectors})")


@pytest.mark.parametrize(
    ("cores", "threads", "said"),
    [(2, 1, "one CPU core"), (8, 4, "4 CPU cores"), (2, 7, "2 CPU cores")],
)
def test_a_run_has_no_more_cores_than_there_are(cores: int, threads: int, said: str) -> None:
    assert describe_cores({"cores": cores, "threads": threads}) == said


def test_a_figure_says_what_made_it_and_when() -> None:
    code = describe_code()
    assert code == describe_code() and len(code["sources"]) == 12
    made = made_by(code)
    assert made["code"] == code and datetime.date.fromisoformat(made["date"])


def test_what_is_no_json_leaves_no_file_but_in_a_copy_of_a_users(tmp_path: Path) -> None:
    with pytest.raises(ValueError):
        write_json(tmp_path / "report.json", {"psnr": float("nan")})
    assert list(tmp_path.iterdir()) == []
    write_json(tmp_path / "copy.json", {"sharpness": math.nan}, allow_nan=True)
    assert math.isnan(json.loads((tmp_path / "copy.json").read_text())["sharpness"])
