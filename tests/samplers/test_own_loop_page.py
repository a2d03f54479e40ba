"""The code of README.md and docs/own-loop.md runs as it stands; the frame leads where it says."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
import torch
from samplers.analytic_occupancy import camera_rays

from leco_plugin.models.encodings import EncodingConfig
from leco_plugin.models.gate import Gate, GateConfig
from leco_plugin.occupancy import Occupancy
from leco_plugin.samplers.registry import OURS
from leco_plugin.scenes.frames import APPLIED_EARLIER
from leco_plugin.space import Space

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "own-loop.md").read_text()
SAMPLING, MOVING = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
SCALE = 0.01


def turned(positions: torch.Tensor, matrix: torch.Tensor) -> torch.Tensor:
    return positions @ matrix[:, :3].T + matrix[:, 3]


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """An occupancy in units of 100 metres."""
    torch.manual_seed(0)
    turn = torch.linalg.qr(torch.randn(3, 3))[0]
    turn = turn * torch.linalg.det(turn).sign() * SCALE
    frame = torch.cat([turn, torch.tensor([[0.1], [0.2], [0.3]])], dim=1)
    report: dict[str, Any] = {"near": 0.5, "far": 4.0, "step_size": 0.02, "cone_angle": 0.01}
    report["frame"] = frame.tolist()
    small = GateConfig(EncodingConfig(octaves=2), width=16, layers=1)  # its cells are cached
    occupancy = Occupancy(Gate(small), Space(), threshold=0.7, report=report)
    occupancy.save(tmp_path / "occupancy.safetensors")
    return tmp_path / "occupancy.safetensors"


@pytest.mark.parametrize("processed", ["not at all", "and said", "and not said"])
def test_its_code_samples_in_the_scenes_coordinates_and_in_the_photographs(
    file: Path, tmp_path: Path, processed: str
) -> None:
    origins, directions = camera_rays(40)
    code = SAMPLING.replace('"cuda"', '"cpu"').replace("occupancy.safetensors", str(file))
    given: dict[str, Any] = {
        "rays_o": origins,
        "rays_d": directions,
        "sigma_fn": lambda starts, ends, rays: torch.ones_like(starts),
    }
    exec(code.replace("stratified=True", "stratified=False"), given)
    assert len(given["t_starts"]) > 100

    (frame,) = [torch.tensor(given["occupancy"].report["frame"])]
    back = torch.linalg.inv(frame[:, :3])
    saved, meta = torch.eye(3, 4), {}
    if processed == "and said":
        saved = torch.tensor([[1.0, 0.0, 0.0, 0.4], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 2.0]])
        meta = {"applied_transform": saved.tolist()}
    if processed == "and not said":
        saved = torch.tensor(APPLIED_EARLIER)
        (tmp_path / "colmap/sparse/0").mkdir(parents=True)
    (tmp_path / "transforms.json").write_text(json.dumps(meta))
    metres = {
        "rays_o": turned((origins - frame[:, 3]) @ back.T, saved),
        "rays_d": directions @ back.T @ saved[:, :3].T * SCALE,  # of length 1
        "folder": tmp_path,
    }
    moved: dict[str, Any] = {**given, **metres}
    exec(MOVING, moved)
    torch.testing.assert_close(moved["rays_o"], origins, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(moved["rays_d"], directions * SCALE)
    assert torch.allclose(frame[:, :3].det() ** (1 / 3), torch.tensor(SCALE))
    report = given["occupancy"].report
    rays, t_starts, _ = given["estimator"].sampling(
        moved["rays_o"],
        moved["rays_d"],
        sigma_fn=lambda starts, ends, rays: torch.full_like(starts, SCALE),
        near_plane=report["near"] / SCALE,
        far_plane=report["far"] / SCALE,
        render_step_size=report["step_size"] / SCALE,
        cone_angle=report["cone_angle"],
        alpha_thre=0.01,
    )
    assert rays.equal(given["ray_indices"])
    torch.testing.assert_close(t_starts * SCALE, given["t_starts"], rtol=1e-3, atol=1e-4)


def test_the_code_of_the_readme_needs_no_more_than_a_file(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(file.parent)
    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    given: dict[str, Any] = {}
    exec(code, given)
    assert len(given["ray_indices"]) == len(given["t_starts"]) == len(given["t_ends"])


def test_it_names_the_samplers_of_packed_hosts() -> None:
    rows = re.findall(r"^\| `([\w-]+)` \| `(?:aabb|occupancy)`", PAGE, re.MULTILINE)
    packed = {name for name, spec in OURS.items() if spec.estimator is not None}
    assert set(rows) == {name for name in packed if OURS[name].gate_encoding is None}
