"""Claims about the benchmark of samples along a ray, on the ball in a run that is known."""

from __future__ import annotations

import importlib
import json
from pathlib import Path
from types import ModuleType

import pytest

from leco_plugin.capacity.sources import find_source
from leco_plugin.occupancy import Occupancy

ROOT = Path(__file__).resolve().parent.parent

pytestmark = [  # nerfstudio leaves an image open
    pytest.mark.filterwarnings("ignore:unclosed file:ResourceWarning"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]


@pytest.fixture
def samples(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    return importlib.import_module("samples")


def test_less_is_left_of_a_ray_after_each_question(
    samples: ModuleType, known_run: Path, tiny_scene: Path, tmp_path: Path
) -> None:
    out = tmp_path / "samples.json"
    samples.main(samples.Options((f"{known_run}={tiny_scene}",), out))
    ((scene, row),) = json.loads(out.read_text())["scenes"].items()
    assert scene == tiny_scene.name and row["code"]["version"]
    # a ray's last run of 16 is asked whole
    assert row["candidates"] + 16 > row["formed"] > row["gate"] > 0.0
    assert row["candidates"] / 16 <= row["coarse"] < row["candidates"]
    assert row["formed"] >= row["kept"] > 0.0
    # an opaque ball: what lies behind its surface is kept, and not shaded from the front
    assert row["shaded_from_the_front"] < row["shaded"]
    assert row["psnr_from_the_front"] == pytest.approx(row["psnr"], abs=1e-2)


def test_what_is_kept_is_what_the_occupancy_keeps_of_all_candidates(
    samples: ModuleType, known_run: Path, tiny_scene: Path
) -> None:
    source = find_source(known_run / "occupancy.safetensors", tiny_scene)
    model = source.model
    assert model is not None
    pictures = samples.bundles_of(source.manager, model.device)
    counts = samples.along_rays(model, [bundle for bundle, _ in pictures])
    occupancy = Occupancy.load(known_run / "occupancy.safetensors")
    kept = total = 0
    for bundle, _ in pictures:
        rays = model.rays_of(bundle.flatten())
        intervals = model.mixture.with_backdrops(rays, model.mixture.candidates(rays))
        ray_indices, t_starts, t_ends = intervals
        middles = 0.5 * (t_starts + t_ends)[:, None]
        positions = rays.origins[ray_indices] + rays.directions[ray_indices] * middles
        kept += int(occupancy.occupied(positions).sum())
        total += len(rays.origins)
    assert counts["kept"] == pytest.approx(kept / total, rel=0.02)


def test_a_scene_without_its_run_is_named(samples: ModuleType, tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match="is not RUN=SCENE"):
        samples.main(samples.Options(("runs/city",), tmp_path / "samples.json"))


def test_the_table_has_a_row_a_scene(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    tables = importlib.import_module("sizes_tables")
    row = {
        **{"candidates": 150.8, "coarse": 11.3, "formed": 71.9, "gate": 1.2, "kept": 23.9},
        **{"shaded_from_the_front": 20.3, "psnr": 21.757, "psnr_from_the_front": 21.757},
        "time_from_the_front": 0.914,
    }
    said = tables.samples_table({"city-3": row}).splitlines()[-1]
    counts = "150.8 | 11.3 | 71.9 | 1.2 | 23.9 | 20.3"
    assert said == f"| city-3 | {counts} | 21.757 dB | 21.757 dB | 0.91 x |"
