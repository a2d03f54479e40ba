"""Makes two scenes of nine photographs without sparse points, on which occupancies fail.

A facade of the procedural city, seen from the street, and, with `--fox`, every fifth training
photograph of that scene. The commands that compare methods on them are printed.

python benchmarks/nine_photographs.py nine --fox "$LECO_SCENES/fox"
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path

import checkout  # noqa: F401
import numpy as np

from leco_plugin.scenes.city.cameras import EYE_HEIGHT, CaptureConfig, View, look_at
from leco_plugin.scenes.city.city import City, CityConfig
from leco_plugin.scenes.city.folder import TRANSFORMS, NerfstudioLayout
from leco_plugin.scenes.city.render import Tracer
from leco_plugin.scenes.scene_file import load_json
from leco_plugin.scenes.whole_files import write_json

TRAINED, TESTED = 9, 3
EVERY = 5
"""Of the training photographs of `fox`, one in so many stays."""
COMPARED = (
    "leco chart --data {scene} --out {scene}-chart --methods leco-occupancy leco-nerfacto nerfacto "
    "--samplers learned-occupancy own --seconds 120 --seeds 0 1"
)


def make_facade(out: Path) -> None:
    """Takes photographs of one house from across its street, three of them held out."""
    city = City(CityConfig(blocks=2, sky=True))
    size, middle = city.config.block_size, city.centres[city.built][0]
    lens, tracer = CaptureConfig(width=240, height=180).lens, Tracer(city)
    views = []
    for number, along in enumerate(np.linspace(-0.3, 0.3, TRAINED + TESTED)):
        place = middle + size * np.array([along, -0.5])
        aim = np.array([*(middle + size * np.array([0.5 * along, -0.3])), 3.0 * EYE_HEIGHT])
        pose = look_at(np.array([*place, EYE_HEIGHT]), aim)
        views.append(View(number, f"{number:02d}", pose, number % 4 == 2))
    layout = NerfstudioLayout(views, lens, seed=0)
    for view in views:
        layout.write(out, view, *tracer.photograph(view.pose, lens))
    layout.finish(out)
    _forget_points(out)


def take_every_fifth(scene: Path, out: Path) -> None:
    """Copies a scene with one training photograph in `EVERY`, and all of its tests."""
    meta = load_json(scene / TRANSFORMS)
    meta["train_filenames"] = meta["train_filenames"][::EVERY]
    kept = {*meta["train_filenames"], *meta["val_filenames"], *meta["test_filenames"]}
    meta["frames"] = [frame for frame in meta["frames"] if frame["file_path"] in kept]
    for name in kept:
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(scene / name, out / name)
    write_json(out / TRANSFORMS, meta, indent=1)
    _forget_points(out)


def _forget_points(scene: Path) -> None:
    meta = load_json(scene / TRANSFORMS)
    (scene / meta.pop("ply_file_path")).unlink(missing_ok=True)
    write_json(scene / TRANSFORMS, meta, indent=1)


def main() -> None:
    """Makes the scenes, and says what compares methods on them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--fox", type=Path, help="that scene of instant-ngp, nerfstudio's format")
    given = parser.parse_args()
    make_facade(given.out / "facade")
    print(COMPARED.format(scene=given.out / "facade"))
    if given.fox is not None:
        take_every_fifth(given.fox, given.out / "fox")
        print(COMPARED.format(scene=given.out / "fox"))


if __name__ == "__main__":
    main()
