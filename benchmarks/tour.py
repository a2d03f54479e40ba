"""Draws a flight past a trained scene as a film: photograph, rendering, what is kept, samples.

python benchmarks/tour.py outputs/SCENE/leco-occupancy --out docs/images/tour.gif
"""

from __future__ import annotations

import argparse
from itertools import pairwise
from pathlib import Path
from typing import Any

import checkout  # noqa: F401
import numpy as np
import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.utils.eval_utils import eval_setup
from PIL import Image, ImageDraw
from torch import Tensor

from leco_plugin.cli_occupancy import occupancy_of
from leco_plugin.evaluation.history_picture import write_film
from leco_plugin.evaluation.inspection import candidates
from leco_plugin.log import bar
from leco_plugin.occupancy import Occupancy

PANEL, GAP, HEAD = 232, 6, 24
"""Pixels: width of a panel, between panels, and of the line above them."""
STEPS = 8
"""Frames from one photograph to the next."""
FRAME = 140
"""Milliseconds."""
COLOURS = 128
"""Of all frames together, so that a page may hold the film."""
CANDIDATES, BISECTIONS = 384, 6
"""Of a ray, and halvings of the way from one to the next."""
RAYS_AT_ONCE = 8192
MOST_SAMPLES = 64
"""Of a ray, which are drawn brightest."""
LIGHT = (0.35, 0.25, 0.9)
"""Where it comes from, east, north, up."""
AMBIENT = 0.35
PAPER, INK = (22, 27, 34), (230, 237, 243)
"""Dark, as films are: for light pages and dark ones."""


def flight(cameras: Cameras, first: int, photographs: int, width: int) -> tuple[Cameras, list[int]]:
    """Cameras from one photograph to the next, and for each frame the nearest photograph."""
    from nerfstudio.cameras.camera_utils import get_interpolated_poses

    numbers = range(first, first + photographs)
    poses, nearest = [], []
    for one, other in pairwise(numbers):
        between = get_interpolated_poses(
            *(cameras.camera_to_worlds[i].numpy() for i in (one, other)), steps=STEPS + 1
        )
        poses += list(between)[:-1]
        nearest += [one if step < STEPS / 2 else other for step in range(STEPS)]
    lens = cameras[first]
    scale = width / int(lens.width)
    flown = Cameras(
        torch.from_numpy(np.stack(poses)).float()[:, :3],
        *(float(value) * scale for value in (lens.fx, lens.fy, lens.cx, lens.cy)),
        width=width,
        height=round(int(lens.height) * scale),
    )
    return flown, nearest


@torch.no_grad()
def kept_relief(occupancy: Occupancy, rays: Any) -> Tensor:
    """The kept volume in light, seen along rays [h, w]: colours [h, w, 3], white where nothing is.

    A pixel shows where its ray first meets what is kept.
    """
    shape = rays.origins.shape[:2]
    origins, directions = rays.origins.reshape(-1, 3), rays.directions.reshape(-1, 3)
    parts = zip(origins.split(RAYS_AT_ONCE), directions.split(RAYS_AT_ONCE))
    depth = torch.cat([first_kept(occupancy, *part) for part in parts]).view(shape)
    places = rays.origins + rays.directions * depth[..., None].nan_to_num(posinf=0.0)
    places = smooth(places.permute(2, 0, 1)).permute(1, 2, 0)
    down, right = torch.gradient(places, dim=(0, 1))
    normals = torch.nn.functional.normalize(torch.linalg.cross(right, down, dim=-1), dim=-1)
    normals = normals * -(normals * rays.directions).sum(-1, keepdim=True).sign()
    light = torch.nn.functional.normalize(torch.tensor(LIGHT), dim=0)
    shade = AMBIENT + (1.0 - AMBIENT) * (normals @ light).clamp(min=0.0)
    height = places[..., 2]
    low, high = torch.quantile(height[depth.isfinite()], torch.tensor([0.02, 0.98]))
    colours = of_map("viridis", 0.15 + 0.8 * (height - low) / (high - low).clamp(min=1e-6))
    return torch.where(depth.isfinite()[..., None], colours * shade[..., None], 1.0)


def first_kept(occupancy: Occupancy, origins: Tensor, directions: Tensor) -> Tensor:
    """Distances [R] at which rays [R, 3] first meet what is kept; infinite where they do not."""

    def is_kept(of_ray: Tensor, distances: Tensor) -> Tensor:
        places = torch.addcmul(origins[of_ray], directions[of_ray], distances[:, None])
        return occupancy.occupied(places)

    of_ray, starts, ends = candidates(occupancy, origins, directions, most=CANDIDATES)
    kept = is_kept(of_ray, 0.5 * (starts + ends))
    first = torch.full((len(origins),), torch.inf)
    first.scatter_reduce_(0, of_ray[kept], ends[kept], "amin")
    lengths = torch.zeros(len(origins)).scatter_reduce_(0, of_ray, ends - starts, "amax")
    for _ in range(BISECTIONS):  # the surface lies between the candidate before and this one
        lengths = 0.5 * lengths
        nearer = first - lengths
        met = nearer.isfinite().nonzero()[:, 0]
        there = is_kept(met, nearer[met])
        first[met[there]] = nearer[met[there]]
    return first


def smooth(picture: Tensor) -> Tensor:
    """[C, h, w] with the mean of the 3 x 3 pixels around each."""
    padded = torch.nn.functional.pad(picture[None], [1] * 4, mode="replicate")
    return torch.nn.functional.avg_pool2d(padded, 3, 1)[0]


def of_map(name: str, values: Tensor) -> Tensor:
    """Colours [..., 3] of values in [0, 1]."""
    from matplotlib import colormaps

    return torch.from_numpy(colormaps[name](values.clamp(0.0, 1.0).numpy())[..., :3]).float()


def framed(panels: list[Tensor], titles: list[str]) -> Image.Image:
    """Panels [h, w, 3] beside each other, with a line above each."""
    from matplotlib.font_manager import findfont
    from PIL import ImageFont

    height = len(panels[1])
    page = Image.new("RGB", (len(panels) * (PANEL + GAP) - GAP, HEAD + height), PAPER)
    draw = ImageDraw.Draw(page)
    font = ImageFont.truetype(findfont("DejaVu Sans"), 15)
    for number, (panel, title) in enumerate(zip(panels, titles)):
        picture = Image.fromarray((255.0 * panel.clamp(0.0, 1.0)).byte().numpy())
        left = number * (PANEL + GAP)
        page.paste(picture.resize((PANEL, height), Image.Resampling.LANCZOS), (left, HEAD))
        draw.text((left + 2, 2), title, INK, font)
    return page


@torch.no_grad()
def draw(run: Path, out: Path, first: int, photographs: int) -> None:
    """Writes the film of a run of `leco-occupancy`."""
    pipeline: Any = eval_setup(run / "config.yml", test_mode="test")[1]
    model, dataset = pipeline.model, pipeline.datamanager.train_dataset
    occupancy = Occupancy.load(run / "occupancy.safetensors")
    cameras, nearest = flight(dataset.cameras, first, photographs, PANEL)
    frames: list[Image.Image] = []
    with bar("Flying") as show:
        for number, photograph in enumerate(nearest):
            camera = cameras[number : number + 1]
            outputs = model.get_outputs_for_camera(camera)
            samples = outputs["samples_per_ray"][..., 0]
            panels = [
                dataset.get_data(photograph)["image"][..., :3].float(),
                outputs["rgb"],
                kept_relief(occupancy, camera.generate_rays(0)),
                of_map("magma", (samples / MOST_SAMPLES).sqrt()),
            ]
            titles = ["photograph", "rendering", "what is kept"]
            count = f"{float(samples.mean()):.0f} of {model.mixture.sizes.candidates} samples a ray"
            frames.append(framed(panels, [*titles, count]))
            show((number + 1) / len(nearest))
    write_film(frames + frames[-2:0:-1], out, FRAME, COLOURS)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path, help="folder of a run, or of runs: the newest in it")
    parser.add_argument("--out", type=Path, required=True, help="a .gif")
    parser.add_argument("--first", type=int, default=0, help="number of the first photograph")
    parser.add_argument("--photographs", type=int, default=3)
    asked = parser.parse_args()
    draw(occupancy_of(asked.run).parent, asked.out, asked.first, asked.photographs)
