"""The scenes of the cases, by name. All but the far ones lie within four metres of the middle."""

from __future__ import annotations

import numpy as np

from leco_plugin.stability.matter import Ball, Box, Paint, Rod, Shape
from leco_plugin.stability.stage import Fog, Pane, Stage

BRICK, SAND, GRASS = Paint((0.72, 0.38, 0.30)), Paint((0.80, 0.72, 0.52)), Paint((0.36, 0.55, 0.28))
BLUE, STEEL = Paint((0.30, 0.42, 0.75)), Paint((0.16, 0.17, 0.19), contrast=0.1)
CAR = Paint((0.85, 0.15, 0.12), grain=2.0)

FLOOR = Box((-3.6, -3.6, -0.3), (3.6, 3.6, 0.0), Paint((0.62, 0.60, 0.56), grain=1.1))
HOUSES: tuple[Shape, ...] = (
    Box((-2.4, -2.2, 0.0), (-1.0, -0.8, 1.6), BRICK),
    Box((0.9, 0.8, 0.0), (2.2, 2.4, 1.1), SAND),
    Box((-1.9, 1.1, 0.0), (-0.9, 2.3, 0.7), BLUE),
    Ball((1.5, -1.4, 0.6), 0.6, GRASS),
)
YARD = Stage((FLOOR, *HOUSES))
"""A few things on a floor: what every method can learn."""


def _poles_and_wires() -> tuple[Shape, ...]:
    feet = [(x, y) for x in (-3.0, 0.0, 3.0) for y in (-3.0, 3.0)]
    poles = [Rod((x, y, 0.0), (x, y, 1.9), 0.04, STEEL) for x, y in feet]
    wires = [Rod((-3.0, y, z), (3.0, y, z), 0.02, STEEL) for y in (-3.0, 3.0) for z in (1.5, 1.85)]
    return (*poles, *wires)


def _irregular_floor() -> tuple[Shape, ...]:
    """Plates that leave bays and an island: no box fits the outline."""
    plates = (
        ((-3.6, -1.0), (-0.4, 1.2)),
        ((-0.4, -0.2), (1.6, 3.4)),
        ((-2.0, -3.4), (-0.9, -1.0)),
        ((2.3, -3.2), (3.5, -1.7)),
    )
    return tuple(Box((*low, -0.3), (*high, 0.0), FLOOR.paint) for low, high in plates)


def _hills() -> tuple[Shape, ...]:
    """A plain, and hills at several times the scene's size."""
    plain = Box((-40.0, -40.0, -0.6), (40.0, 40.0, -0.31), Paint((0.42, 0.50, 0.30), grain=6.0))
    turns = 2.0 * np.pi * np.arange(7) / 7
    hills = [
        Ball((24.0 * float(np.cos(a)), 24.0 * float(np.sin(a)), -7.0), 11.0, plain.paint)
        for a in turns
    ]
    return (plain, *hills)


def _room() -> tuple[Shape, ...]:
    return (
        Box((-3.5, -3.5, 0.0), (3.5, 3.5, 2.6), Paint((0.82, 0.78, 0.70), grain=1.6)),
        Box((-1.0, -0.6, 0.0), (1.0, 0.6, 0.8), BRICK),
        Box((2.4, -3.2, 0.0), (3.3, -1.4, 2.0), BLUE),
        Ball((-2.4, 2.3, 0.5), 0.5, GRASS),
    )


_AIR = Box((-3.6, -3.6, 0.0), (3.6, 3.6, 2.4), Paint((0.72, 0.75, 0.80), grain=3.0, contrast=0.15))
_EVERYWHERE = Box((-6.0, -6.0, -2.0), (6.0, 6.0, 6.0), Paint((0.60, 0.50, 0.42), 2.4, 0.5))
_WINDOWS = (
    Pane(Box((-0.6, -2.6, 0.0), (-0.56, -0.2, 1.8), Paint((0.35, 0.60, 0.55), grain=2.0)), 0.35),
    Pane(Box((0.2, 0.3, 0.0), (2.6, 0.34, 1.5), Paint((0.62, 0.45, 0.60), grain=2.0)), 0.35),
)

STAGES: dict[str, Stage] = {
    "yard": YARD,
    "poles-and-wires": Stage(YARD.shapes, details=_poles_and_wires()),
    "glass": Stage(YARD.shapes, panes=_WINDOWS),
    "fog": Stage(YARD.shapes, fog=Fog(_AIR, 0.25)),
    "all-empty": Stage(sky=True),
    "all-full": Stage(fog=Fog(_EVERYWHERE, 0.9)),
    "far-terrain": Stage((*YARD.shapes, *_hills()), sky=True),
    "outline": Stage((*_irregular_floor(), Box((-2.6, -0.6, 0.0), (-1.4, 0.6, 1.2), BRICK))),
    "indoors": Stage(_room()),
}


def moving_car(number: int) -> Shape:
    """What drives through some pictures, and is never twice in the same place."""
    x = -3.0 + (1.7 * number) % 6.0
    return Box((x - 0.5, -0.35, 0.0), (x + 0.5, 0.25, 0.55), CAR)
