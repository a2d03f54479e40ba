"""The scenes of the cases, by name. All but the far ones lie within four metres of the middle.

Whatever stands in them is grey; only the sky is blue. A host learns shapes and lightness early and
hue late, in some seeds hundreds of steps later than in others, which says nothing about where it
samples.
"""

from __future__ import annotations

import numpy as np

from leco_plugin.stability.scene import Ball, Box, Fog, Paint, Pane, Rod, Shape, Stage


def grey(lightness: float, grain: float = Paint.grain, contrast: float = Paint.contrast) -> Paint:
    """A paint without a hue."""
    return Paint((lightness, lightness, lightness), grain, contrast)


BRICK, SAND, LAWN, SLATE = grey(0.36), grey(0.86), grey(0.48), grey(0.26)
STEEL, CAR = grey(0.17, contrast=0.1), grey(0.95, grain=2.0)

FLOOR = Box((-3.6, -3.6, -0.3), (3.6, 3.6, 0.0), grey(0.59, grain=1.1))
HOUSES: tuple[Shape, ...] = (
    Box((-2.4, -2.2, 0.0), (-1.0, -0.8, 1.6), BRICK),
    Box((0.9, 0.8, 0.0), (2.2, 2.4, 1.1), SAND),
    Box((-1.9, 1.1, 0.0), (-0.9, 2.3, 0.7), SLATE),
    Ball((1.5, -1.4, 0.6), 0.6, LAWN),
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
    plain = Box((-40.0, -40.0, -0.6), (40.0, 40.0, -0.31), grey(0.41, grain=6.0))
    turns = 2.0 * np.pi * np.arange(7) / 7
    hills = [
        Ball((24.0 * float(np.cos(a)), 24.0 * float(np.sin(a)), -7.0), 11.0, plain.paint)
        for a in turns
    ]
    return (plain, *hills)


def _room() -> tuple[Shape, ...]:
    return (
        Box((-3.5, -3.5, 0.0), (3.5, 3.5, 2.6), grey(0.77, grain=1.6)),
        Box((-1.0, -0.6, 0.0), (1.0, 0.6, 0.8), BRICK),
        Box((2.4, -3.2, 0.0), (3.3, -1.4, 2.0), SLATE),
        Ball((-2.4, 2.3, 0.5), 0.5, LAWN),
    )


_AIR = Box((-3.6, -3.6, 0.0), (3.6, 3.6, 2.4), grey(0.76, grain=3.0, contrast=0.15))
_EVERYWHERE = Box((-6.0, -6.0, -2.0), (6.0, 6.0, 6.0), grey(0.51, 2.4, 0.5))
_WINDOWS = (
    Pane(Box((-0.6, -2.6, 0.0), (-0.56, -0.2, 1.8), grey(0.50, grain=2.0)), 0.35),
    Pane(Box((0.2, 0.3, 0.0), (2.6, 0.34, 1.5), grey(0.56, grain=2.0)), 0.35),
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
