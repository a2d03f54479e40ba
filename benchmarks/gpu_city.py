"""The procedural city as rays with colours, traced by torch: training data without a data manager.

Surfaces are painted as in `scenes/city/render.py`; shadows are left out.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from leco_plugin.samplers.boxes import intersect_box
from leco_plugin.scenes.city.cameras import CaptureConfig, View, views_of
from leco_plugin.scenes.city.city import City, CityConfig
from leco_plugin.scenes.city.render import paint_surface

SUN = (0.48, -0.36, 0.8)
PAIRS = 1 << 24
"""Pairs of ray and triangle met at once."""
CALIBRATION_SHARE = 0.05
"""Of the training pixels, kept out of training for the threshold."""


class Pixels(NamedTuple):
    """Rays through pixels, with what is seen there."""

    origins: Tensor
    """[N, 3] metres."""
    directions: Tensor
    """[N, 3] unit vectors."""
    colors: Tensor
    """[N, 3] in [0, 1]; black where nothing is met."""
    images: Tensor
    """[N] int64."""

    def some(self, chosen: Tensor) -> Pixels:
        """Those with the given indices."""
        return Pixels(*(part.index_select(0, chosen) for part in self))


class Photographed(NamedTuple):
    """A city, and its pixels by what they are for."""

    train: Pixels
    calibration: Pixels
    test: Pixels
    box: Tensor
    """Low and high corner of everything that is solid, metres, [6]."""
    num_images: int
    length: float
    """Median length of the rays inside the box, metres."""


def take_photographs(
    config: CityConfig, capture: CaptureConfig, device: torch.device
) -> Photographed:
    """Builds a city and takes its pictures."""
    city = City(config)
    views = views_of(city, capture)
    tracer = Tracer(city, device)
    pictures = [tracer.picture(view, capture) for view in views]

    def joined(held_out: bool) -> Pixels:
        chosen = [p for view, p in zip(views, pictures) if view.held_out == held_out]
        return Pixels(*map(torch.cat, zip(*chosen)))

    train, test = joined(False), joined(True)
    order = torch.randperm(len(train.images), generator=torch.Generator().manual_seed(0)).to(device)
    kept_out = int(CALIBRATION_SHARE * len(order)) + 1
    box = torch.tensor(city.bounds, dtype=torch.float32, device=device).view(-1)
    enters, leaves = intersect_box(train.origins, train.directions, box)
    lengths = leaves - enters.clamp(min=0.0)
    length = float(lengths[lengths > 0.0].median())
    return Photographed(
        train.some(order[kept_out:]), train.some(order[:kept_out]), test, box, len(views), length
    )


class Tracer:
    """Meets rays with all triangles of a city at once."""

    def __init__(self, city: City, device: torch.device) -> None:
        self.city, self.device = city, device
        corner = city.triangles[:, 0]
        one, other = city.triangles[:, 1] - corner, city.triangles[:, 2] - corner
        normals = np.cross(one, other)
        squared = np.maximum((normals**2).sum(1, keepdims=True), 1e-12)
        # heights above the plane, and the shares of both sides, are linear in a position
        forms = normals, np.cross(other, normals) / squared, np.cross(normals, one) / squared
        self.forms = [torch.tensor(form.T, dtype=torch.float32, device=device) for form in forms]
        offsets = [(form * corner).sum(1) for form in forms]
        self.offsets = [torch.tensor(o, dtype=torch.float32, device=device) for o in offsets]
        self.normals = normals / np.sqrt(squared)

    def cast(self, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """Distance [N] of the first triangle that each ray meets, inf for none, and its number."""
        heights, *shares = (
            (origins @ form - offset, directions @ form)
            for form, offset in zip(self.forms, self.offsets)
        )
        along = -heights[0] / heights[1]
        first, second = (at + along * slope for at, slope in shares)
        met = (along > 1e-3) & (first >= 0.0) & (second >= 0.0) & (first + second <= 1.0)
        return torch.where(met, along, torch.inf).min(dim=1)

    def picture(self, view: View, capture: CaptureConfig) -> Pixels:
        """All pixels of one view."""
        lens = capture.lens
        turned = lens.directions().reshape(-1, 3) @ view.pose[:, :3].T
        directions = torch.tensor(turned, dtype=torch.float32, device=self.device)
        at = torch.tensor(view.pose[:, 3], dtype=torch.float32, device=self.device)
        origins = at.expand_as(directions)
        rays_at_once = max(1, PAIRS // len(self.normals))
        parts = [self.cast(at.expand_as(d), d) for d in directions.split(rays_at_once)]
        depths, faces = (torch.cat(part).cpu().numpy() for part in zip(*parts))
        colors = np.zeros((len(depths), 3), np.float32)
        hit = np.flatnonzero(np.isfinite(depths))
        positions = view.pose[:, 3] + depths[hit, None] * turned[hit]
        normals, paint = self.normals[faces[hit]], self.city.paint[faces[hit]]
        albedo = paint_surface(self.city, positions, normals, paint, depths[hit] / lens.focal)
        light = 0.45 + 0.55 * np.clip(normals @ np.array(SUN), 0.0, 1.0)
        colors[hit] = albedo * light[:, None]
        images = torch.full((len(origins),), view.number, device=self.device)
        return Pixels(origins, directions, torch.tensor(colors, device=self.device), images)
