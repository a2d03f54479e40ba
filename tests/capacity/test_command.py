"""Claims about `leco capacity`: it goes on where it was stopped, draws, and refuses in one line."""

from __future__ import annotations

import json
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import tiny_scene as tiny_scene_writer
from PIL import Image

from leco_plugin import cli
from leco_plugin.capacity import measuring
from leco_plugin.capacity.measuring import VOLUMES
from leco_plugin.capacity.search import Candidate, gates
from leco_plugin.chart.theme import SOURCE, fingerprint
from leco_plugin.scenes.input_error import InputError
from leco_plugin.scenes.whole_files import alone_in


def run(*arguments: object) -> int:
    return cli.main([str(argument) for argument in arguments])


def row_of(candidate: Candidate) -> dict[str, Any]:
    return {
        "family": candidate.family,
        "size": candidate.size,
        "bytes": candidate.bytes,
        "seconds": 0.1,
        "kept_volume": 0.05 + 50.0 / (candidate.bytes + 1000),
        "kept_candidates": 0.2,
        "lost_at_volumes": [0.03 / (1 + i) ** 2 for i in range(len(VOLUMES))],
    }


class Taught(list[str]):
    """Keys of what would have been taught."""

    stops_at: int | None = None
    """Number of the gate at which somebody presses Ctrl-C."""


@pytest.fixture
def taught(monkeypatch: pytest.MonkeyPatch) -> Taught:
    """Nothing is learned."""
    done = Taught()

    def of_gate(ground: Any, candidate: Candidate, lost: float) -> dict[str, Any]:
        if len(done) == done.stops_at:
            raise KeyboardInterrupt
        done.append(candidate.key)
        return row_of(candidate)

    mixture = SimpleNamespace(num_images=7)
    ground = SimpleNamespace(mixture=mixture, held_out=SimpleNamespace(rays=99))
    monkeypatch.setattr(measuring, "prepare", lambda *arguments: ground)
    monkeypatch.setattr(measuring, "measure_candidate", of_gate)
    return done


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(measuring, "draw", lambda *arguments: None)


def test_what_was_finished_is_kept(
    taught: Taught, tiny_scene: Path, tmp_path: Path, printed: Any
) -> None:
    out = tmp_path / "capacity"
    arguments = ["capacity", "--data", tiny_scene, "--out", out, "--grids", 16, 32]
    taught.stops_at = 5
    assert run(*arguments) == 130
    assert len(list((out / "points").iterdir())) == len(taught) == 5
    taught.stops_at = None
    assert run(*arguments) == 0
    assert len(set(taught)) == len(taught)
    results = json.loads((out / "results.json").read_text())
    assert len(results["representations"]) == len(taught)
    assert all(row["code"]["sources"] and row["date"] for row in results["representations"])
    assert results["verdict"] in printed()
    for name in ("capacity.png", "capacity-dark.png"):
        with Image.open(out / name) as image:
            assert image.size[0] > 1000
            assert image.info[SOURCE] == fingerprint(results)
    before = len(taught)
    assert run(*arguments) == 0 and len(taught) == before


@pytest.mark.usefixtures("taught")
def test_other_settings_and_bad_input_are_refused_in_one_line(
    tiny_scene: Path, tmp_path: Path, refused: Any
) -> None:
    out = tmp_path / "capacity"
    assert run("capacity", "--data", tiny_scene, "--out", out, "--grids", 16) == 0
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "thesis.txt").write_text("")
    new = ["--out", tmp_path / "new"]
    empty = tmp_path / "empty"
    empty.mkdir()
    other = tiny_scene_writer.write(tmp_path / "other" / tiny_scene.name, train=4, test=2)
    cases: dict[str, list[object]] = {
        "empty": ["--data", empty, *new],
        "another scene": ["--data", other, "--out", out],
        "another learn steps": ["--data", tiny_scene, "--out", out, "--learn-steps", 7],
        "holds something else": ["--data", tiny_scene, "--out", tmp_path / "taken"],
        "there is no folder": ["--data", tmp_path / "none", *new],
        "between 0 and 0.5": ["--data", tiny_scene, *new, "--lost-surface-mass", 0],
        "--grids has 1; a grid has 2 cells or more": ["--data", tiny_scene, *new, "--grids", 1],
    }
    for cause, arguments in cases.items():
        assert cause in refused("capacity", *arguments)
    with alone_in(out, "points"):
        busy = refused("capacity", "--data", tiny_scene, "--out", out, "--grids", 16)
    assert "another process makes the points in" in busy
    assert not (tmp_path / "new").exists()


@pytest.mark.usefixtures("taught", "undrawn")
@pytest.mark.parametrize("name", ["settings.json", "points/grid-16.json"])
@pytest.mark.parametrize("text", ["{", "[]", '{"data": 1}'])
def test_a_damaged_file_is_named(
    tiny_scene: Path, tmp_path: Path, refused: Any, name: str, text: str
) -> None:
    arguments = ["capacity", "--data", tiny_scene, "--out", tmp_path / "out", "--grids", 16]
    assert run(*arguments) == 0
    (tmp_path / "out" / name).write_text(text)
    refused(*arguments)


@pytest.mark.usefixtures("undrawn")
def test_a_grid_is_measured_once(taught: Taught, tiny_scene: Path, tmp_path: Path) -> None:
    arguments = ["capacity", "--data", tiny_scene, "--out", tmp_path / "out"]
    assert run(*arguments, "--grids", 16, 16) == 0
    assert taught.count("grid-16") == 1


@pytest.mark.slow
def test_one_field_teaches_gates_and_grids(
    tiny_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(measuring, "RAYS", 256)
    monkeypatch.setattr(measuring, "TAUGHT_RAYS", 256)
    monkeypatch.setattr(measuring, "VOLUME_POINTS", 2048)
    monkeypatch.setattr(measuring, "STEPS", 20)
    monkeypatch.setattr("leco_plugin.learning.sharpening.BATCH", 512)
    some = [candidate for candidate in gates() if candidate.bytes < 5000]
    monkeypatch.setattr(measuring, "gates", lambda: some)
    out = tmp_path / "out"
    for _ in range(2):  # the second time from the stored field
        results = measuring.capacity(tiny_scene, out, (8, 16), 0.01, 4)
        assert len(results["representations"]) == len(some) + 2
        for file in (out / "points").glob("grid*"):
            file.unlink()
    other = tiny_scene_writer.write(tmp_path / "other" / tiny_scene.name, train=4, test=2)
    refused = f"{out} holds points of another scene than {other}; name a new folder with --out"
    with pytest.raises(InputError, match=re.escape(refused)):
        measuring.capacity(other, out, (8, 16), 0.01, 4)
    (out / "field.pt").write_bytes(b"no field")
    with pytest.raises(InputError, match=r"field\.pt cannot be used"):
        measuring.capacity(tiny_scene, out, (8, 16), 0.01, 4)
    assert all(0.0 < row["kept_volume"] <= 1.0 for row in results["representations"])


@pytest.mark.usefixtures("undrawn")
def test_a_grid_that_does_not_fit_the_memory_is_left_out_and_said(
    taught: Taught, tiny_scene: Path, tmp_path: Path, printed: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(measuring, "fits_memory", lambda cells: cells < 20**3)
    out = tmp_path / "out"
    assert run("capacity", "--data", tiny_scene, "--out", out, "--grids", 8, 16, 32) == 0
    said = printed()
    assert "a grid of 32^3 cells does not fit the free memory" in said
    rows = json.loads((out / "results.json").read_text())["representations"]
    assert [row["size"] for row in rows if row["family"] == "grid"] == ["8", "16"]
