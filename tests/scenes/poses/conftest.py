"""A rendered survey and its scene, which more than one test file of this room uses."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from PIL import Image
from rendered_survey import HEIGHT, PLACES, WIDTH, exif_of, write_survey

from leco_plugin import cli


@pytest.fixture(scope="session")
def pycolmap() -> Any:
    return pytest.importorskip("pycolmap")


@pytest.fixture(scope="session")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twelve photographs: one turned by EXIF, one a grey PNG, one cut to another size."""
    folder = tmp_path_factory.mktemp("photos")
    paths = write_survey(folder, PLACES)
    with Image.open(paths[2]) as image:
        exif = exif_of(PLACES[2], 4)
        exif[0x0112] = 8
        turned = image.rotate(-90, expand=True)
    turned.save(paths[2], quality=95, exif=exif)
    with Image.open(paths[5]) as image:
        image.convert("L").save(paths[5].with_suffix(".png"), exif=exif_of(PLACES[5], 10))
    paths[5].unlink()
    with Image.open(paths[7]) as image:
        cut = image.crop((20, 20, WIDTH - 20, HEIGHT - 20))
    cut.save(paths[7], quality=95)  # without EXIF, too
    return folder


@pytest.fixture(scope="session")
def made(pycolmap: Any, photos: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The scene of these photographs, and its report in report.json."""
    out = tmp_path_factory.mktemp("made") / "scene"
    asked = ["poses", photos, "--out", out, "--threads", 1, "--json", out.with_suffix(".json")]
    assert cli.main([str(each) for each in asked]) == 0
    return out
