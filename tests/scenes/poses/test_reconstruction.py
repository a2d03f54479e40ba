"""Claims about structure from motion by pycolmap."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from rendered_survey import write_survey

from leco_plugin import cli
from leco_plugin.evaluation.report import usable_cores
from leco_plugin.scenes.poses import reconstruction

pytestmark = pytest.mark.xdist_group("poses")


@pytest.mark.slow
def test_a_lens_with_enough_photographs_gets_its_full_model(
    made: Path, pycolmap: Any, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(reconstruction, "ENOUGH", 3)
    work = reconstruction.Reconstructor(made, [], threads=1)
    model = work.map()[0]
    before = model.compute_mean_reprojection_error()
    work.refine(model, "perspective")
    found = sorted((camera.model_name, len(camera.params)) for camera in model.cameras.values())
    assert found == [("OPENCV", 8), ("SIMPLE_RADIAL", 4)]
    full = next(camera for camera in model.cameras.values() if camera.model_name == "OPENCV")
    assert full.params[:4] == pytest.approx([256.0, 256.0, 160.0, 120.0], rel=0.03)
    assert model.compute_mean_reprojection_error() < before + 0.01
    assert capfd.readouterr().err == ""  # COLMAP's own log is not shown


@pytest.mark.slow
def test_photographs_that_do_not_overlap_end_in_one_line(
    pycolmap: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for seed in range(4):
        write_survey(tmp_path / "photos", [(0.0, 0.0, 40.0)], seed=10 * (seed + 1))
    out = tmp_path / "out"
    assert cli.main(["poses", str(tmp_path / "photos"), "--out", str(out), "--threads", "1"]) == 2
    said = capsys.readouterr().err
    assert "no three of the 4 photographs were found to overlap: " in said and said.count("\n") == 1


def test_an_old_pycolmap_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pycolmap", SimpleNamespace(__version__="3.13.0"))
    with pytest.raises(ImportError, match=r"too old for leco poses: pip install 'pycolmap>=4'"):
        reconstruction.load_pycolmap()


def test_threads_are_those_that_the_process_may_use() -> None:
    assert usable_cores() >= 1
