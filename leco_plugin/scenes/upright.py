"""Surveys from the air that lie on their side, and the rotation that sets them upright.

Structure from motion does not know what is down, and nerfstudio takes the photographs' top edges
for up: of cameras that look straight down these are level, and point in any direction.
"""

from __future__ import annotations

import torch
from nerfstudio.cameras.camera_utils import rotation_matrix_between
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from torch import Tensor

from leco_plugin.scenes.photographs import POINTS

FEWEST_CAMERAS, FEWEST_POINTS = 4, 32
UPRIGHT = 0.94
"""Cosine of 20 degrees: what is nearer to z may be the slope of a hill."""
DOWN, MOSTLY = -0.3, 0.9
"""Height of a unit vector that goes down, and the share of cameras of a survey that look so."""
ABOVE = 0.75
"""Share of a survey's cameras that are above nearly all points."""
FLAT = 0.35
"""Thickness of the ground, and of the layer in which cameras fly, of its lesser width."""
TURNED, LEVEL = 0.3, 0.15
"""Cosines (root mean square) of the cameras' right axes with the second direction in which they
point, if they are turned at all, and with the vertical, if they are level."""
ONE_HEADING = 0.7
"""Length of the mean of the cameras' top axes: with more, all are held alike."""
WIDE = 0.3
"""Spread of cameras over a survey, of their height: those of somebody who stands before a wall, and
holds all photographs alike, are closer together."""


def turn_to_upright(poses: Tensor, points: Tensor | None) -> Tensor | None:
    """The rotation [3, 3] that sets a survey from the air upright; None if it is, or is no survey.

    What is up is where the cameras are over a flat ground, where their right axes are level, or
    where they fly in a layer, whichever is known.

    Args:
        poses: [C, 3, 4] OpenGL camera to world.
        points: [P, 3] sparse points in the same coordinates, or None.
    """
    poses = poses.detach().double().cpu()
    looks, places = -poses[:, :, 2], poses[:, :, 3]
    if len(poses) < FEWEST_CAMERAS:
        return None
    if points is not None:
        points = _without_strays(points.detach().double().cpu())
    candidates = (
        _normal_of_layer(points) if points is not None else None,
        _vertical_of(poses[:, :, 0]),
        _normal_of_layer(places),
    )
    ups = [
        -found if float((looks @ found).mean()) > 0.0 else found
        for found in candidates
        if found is not None
    ]
    ups = [up for up in ups if float((looks @ up < DOWN).double().mean()) >= MOSTLY]
    ups = [up for up in ups if _fly_over(poses, points, up)]
    if not ups or any(float(up[2]) > UPRIGHT for up in ups):
        return None
    return rotation_matrix_between(ups[0].float(), torch.tensor([0.0, 0.0, 1.0]))


def turned(outputs: DataparserOutputs, turn: Tensor) -> DataparserOutputs:
    """What a dataparser says of a scene, turned: cameras, sparse points, and the way back."""
    outputs.cameras.camera_to_worlds = turn.to(outputs.cameras.camera_to_worlds) @ (
        outputs.cameras.camera_to_worlds
    )
    outputs.dataparser_transform = (
        turn.to(outputs.dataparser_transform) @ (outputs.dataparser_transform[:3])
    )
    if outputs.metadata.get(POINTS) is not None:
        points = torch.as_tensor(outputs.metadata[POINTS])
        outputs.metadata[POINTS] = points @ turn.to(points).T
    return outputs


def _fly_over(poses: Tensor, points: Tensor | None, up: Tensor) -> bool:
    """Whether cameras are above the points, and those that are held alike far from one another."""
    alike = float(poses[:, :, 1].mean(dim=0).norm()) > ONE_HEADING
    if points is None:
        return not alike
    heights, ground = poses[:, :, 3] @ up, points @ up
    above = float((heights > ground.quantile(0.95)).double().mean()) >= ABOVE
    clearance = float(heights.median() - ground.median())
    spread = float(_spreads(poses[:, :, 3])[0][1])
    return above and (not alike or spread >= WIDE * clearance)


def _without_strays(points: Tensor) -> Tensor | None:
    """The nine tenths of points [P, 3] that are nearest to their middle; None of too few."""
    points = points[points.isfinite().all(dim=-1)]
    points = points[:: max(1, len(points) // 100_000)]
    if len(points) < FEWEST_POINTS:
        return None
    distances = (points - points.median(dim=0).values).norm(dim=-1)
    return points[distances <= distances.quantile(0.9)]


def _spreads(places: Tensor) -> tuple[Tensor, Tensor]:
    """Standard deviations [3] of places [N, 3] along their principal axes, least first, and the
    axes as columns [3, 3]."""
    values, axes = torch.linalg.eigh(torch.cov(places.T))
    return values.clamp(min=0.0).sqrt(), axes


def _normal_of_layer(places: Tensor) -> Tensor | None:
    """The direction [3] across places [N, 3] that lie in a flat layer."""
    spreads, axes = _spreads(places)
    return axes[:, 0] if bool(spreads[0] < FLAT * spreads[1]) else None


def _vertical_of(rights: Tensor) -> Tensor | None:
    """The direction [3] to which the cameras' right axes [C, 3] are level, if they turn enough."""
    _, lengths, directions = torch.linalg.svd(rights, full_matrices=False)
    cosines = lengths / len(rights) ** 0.5
    return directions[2] if bool((cosines[1] > TURNED) & (cosines[2] < LEVEL)) else None
