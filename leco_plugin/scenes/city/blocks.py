"""What can stand on a lot: towers, houses in gardens, flats around a court, a park, a works.

Each kind of block paints a canvas (walls and flat roofs) and stands roofs, trees and masts on
it. Nothing overlaps: crowns keep clear of walls, so that every face still touches air.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.random import Generator

from leco_plugin.scenes.city.shapes import (
    FLAT_ROOFS,
    LEAVES,
    STOREY,
    TILES,
    WALLS,
    Canvas,
    Colour,
    Material,
    Palette,
    Rectangle,
    Shapes,
    add_roof,
    rounded,
    square,
)

GROUND_DEPTH = 4.0
"""Thickness of the ground in metres; deep enough that no sample near it passes through."""
KERB = 0.15
SETBACK = 2.6


@dataclass
class Block:
    """One block under construction: its lot's canvas and what all its parts need to know."""

    shapes: Shapes
    palette: Palette
    random: Generator
    x: float
    y: float
    lot: float
    """Side of the lot in metres."""
    canvas: Canvas
    metal: int
    earth: int
    grass: int

    @property
    def reach(self) -> float:
        """Half the side of the square that may be built on, in metres."""
        return self.lot / 2 - SETBACK

    def pick(self, colours: list[Colour]) -> Colour:
        """One of the colours, slightly varied, so that no two houses are quite the same."""
        colour = np.array(colours[self.random.integers(len(colours))])
        colour *= self.random.uniform(0.88, 1.08)
        red, green, blue = np.clip(colour + self.random.normal(0, 0.015, 3), 0.03, 0.97)
        return float(red), float(green), float(blue)

    def placed(self, area: Rectangle) -> Rectangle:
        """A rectangle in coordinates of the city."""
        x0, x1, y0, y1 = area
        return self.x + x0, self.x + x1, self.y + y0, self.y + y1

    def box(self, area: Rectangle, top: float) -> int:
        """Paints a building part that stands on the ground; returns the paint of its walls."""
        x0, x1, y0, y1 = area
        along_x, along_y = (side / max(1, round(side / 2.6)) for side in (x1 - x0, y1 - y0))
        anchor = (self.x + x0, self.y + y0, 0.0)
        wall = self.palette.add(Material.WALL, self.pick(WALLS), anchor, (along_x, along_y))
        self.slab(area, top, wall)
        return wall

    def slab(self, area: Rectangle, top: float, wall: int) -> None:
        """A part with a parapet around a flat roof, in a given wall paint."""
        anchor = (self.x + area[0], self.y + area[2], top)
        roof = self.palette.add(Material.ROOF, self.pick(FLAT_ROOFS), anchor)
        self.paint(area, top + 0.5, wall)
        self.paint(_inset(area, 0.35), top, roof)

    def paint(self, area: Rectangle, top: float, paint: int, covered: bool = False) -> None:
        """A stroke on the lot's canvas in block coordinates."""
        self.canvas.stroke(self.placed(area), top, paint, covered)

    def turned(
        self, x: float, y: float, profile: list[tuple[float, float, int]], foot: int, sides: int = 8
    ) -> None:
        """Stands a turned solid (pole, tree, tank) on a low square foot, which keeps the face under
        it simple; `x`, `y` in block coordinates. `profile` lists radius and height above the foot
        in metres, from the foot up, with the paint of the stretch that ends there; `sides` is a
        multiple of 4."""
        reach = round(profile[0][0] + 0.12, 2)
        x, y = round(float(self.x + x), 2), round(float(self.y + y), 2)
        base = round(self.canvas.height(x, y) + 0.12, 2)
        x0, x1, y0, y1 = area = rounded(square(reach, x, y))
        self.canvas.stroke(area, base, foot, covered=True)
        turn = 2 * np.pi * np.arange(sides) / sides
        circle = np.column_stack([np.cos(turn), np.sin(turn), np.zeros(sides)])
        rings = [np.array([x, y, base + z]) + radius * circle for radius, z, _ in profile]
        corners = np.array([[x1, y1, base], [x0, y1, base], [x0, y0, base], [x1, y0, base]])
        for corner, following, arc in zip(
            corners, np.roll(corners, -1, 0), np.arange(sides).reshape(4, -1)
        ):
            arc = [*arc, (arc[-1] + 1) % sides]
            for a, b in pairwise(arc):
                self.shapes.add_polygon(np.stack([rings[0][b], rings[0][a], corner]), foot)
            self.shapes.add_polygon(np.stack([rings[0][arc[-1]], corner, following]), foot)
        for (lower, upper), (_, _, paint) in zip(pairwise(rings), profile[1:]):
            self.shapes.add_between(upper, lower, paint, shared=1)
        self.shapes.add_polygon(rings[-1], profile[-1][2])

    def tree(self, x: float, y: float, crown: float) -> None:
        """A tree with the given crown radius in metres."""
        leaves = self.palette.add(Material.LEAVES, self.pick(LEAVES))
        bark = self.palette.add(Material.EARTH, (0.30, 0.22, 0.15))
        trunk, size = 1.1 + 0.7 * crown, crown * self.random.uniform(0.9, 1.2)
        radius = 0.08 + 0.05 * crown
        rings = [(radius, 0.0, bark), (radius, trunk, bark)]
        for width, height in ((0.7, 0.25), (1.0, 0.9), (0.8, 1.6), (0.3, 2.1)):
            rings.append((width * crown, trunk + height * size, leaves))
        self.turned(x, y, rings, self.earth)

    def clutter(self, area: Rectangle, top: float) -> None:
        """Machines, and sometimes a thin aerial, on a flat roof whose free area is given."""
        x0, x1, y0, y1 = area
        for _ in range(self.random.integers(0, 3)):
            width, length = self.random.uniform(1.0, 2.4, 2)
            if x1 - x0 > width + 1.2 and y1 - y0 > length + 1.2:
                x = self.random.uniform(x0 + 0.5, x1 - 0.5 - width)
                y = self.random.uniform(y0 + 0.5, y1 - 0.5 - length)
                height = top + self.random.uniform(0.8, 1.9)
                self.paint((x, x + width, y, y + length), height, self.metal)
        if self.random.random() < 0.6 and x1 - x0 > 2 and y1 - y0 > 2:
            x, y = self.random.uniform(x0 + 0.6, x1 - 0.6), self.random.uniform(y0 + 0.6, y1 - 0.6)
            tip = self.random.uniform(3, 5)
            self.turned(x, y, [(0.1, 0.0, self.metal), (0.1, tip, self.metal)], self.metal)


def _inset(area: Rectangle, by: float) -> Rectangle:
    x0, x1, y0, y1 = area
    return x0 + by, x1 - by, y0 + by, y1 - by


def _towers(block: Block) -> None:
    """Four parcels of tall, often stepped, buildings."""
    r, gap = block.reach, 1.5
    block.paint(square(r), KERB, block.palette.add(Material.PAVEMENT, (0.60, 0.56, 0.52)))
    for sx in (-1, 1):
        for sy in (-1, 1):
            x0, x1 = sorted((sx * gap, sx * (r - block.random.uniform(0, 1.2))))
            y0, y1 = sorted((sy * gap, sy * (r - block.random.uniform(0, 1.2))))
            top = STOREY * block.random.integers(3, 7)
            area, side = (x0, x1, y0, y1), min(x1 - x0, y1 - y0)
            wall = block.box(area, top)
            while block.random.random() < 0.65 and side > 5.5 and top < 8 * STOREY:
                step = block.random.uniform(0.9, 1.8)
                area, side = _inset(area, step), side - 2 * step
                top += STOREY * block.random.integers(1, 4)
                block.slab(area, top, wall)
            block.clutter(_inset(area, 0.6), top)


def _houses(block: Block) -> None:
    """Two rows of houses with pitched roofs in gardens."""
    r = block.reach
    block.paint(square(r), KERB + 0.05, block.grass)
    columns = max(2, int(2 * r // 7.5))
    width = 2 * r / columns
    for row in (-1, 1):
        for column in range(columns):
            middle = -r + (column + 0.5) * width
            half_x = width / 2 - block.random.uniform(0.8, 1.3)
            depth = block.random.uniform(0.8, 1.0) * min(7.2, r - 3.6)
            y0, y1 = sorted((row * (r - 1.0), row * (r - 1.0 - depth)))
            top, rise = block.random.uniform(3.0, 6.2), block.random.uniform(1.8, 3.2)
            x0, x1 = middle - half_x, middle + half_x
            wall = block.box((x0, x1, y0, y1), top)
            block.paint((x0, x1, y0, y1), top, wall, covered=True)
            hip = block.random.choice([0.0, 0.0, 0.22]) * max(x1 - x0, y1 - y0)
            tiles = block.palette.add(Material.TILES, block.pick(TILES), (block.x, block.y, top))
            bounds = block.placed((x0, x1, y0, y1))
            add_roof(block.shapes, bounds, top, rise, hip, tiles, wall)
            if block.random.random() < 0.7:
                x = middle + block.random.uniform(-1, 1)
                block.tree(x, row * 1.3, block.random.uniform(0.8, 1.05))


def _court(block: Block) -> None:
    """A closed row of flats around a garden, with one gateway."""
    r, depth = block.reach, block.random.uniform(4.5, 5.5)
    top = STOREY * block.random.integers(3, 6)
    wall = block.box(square(r), top)
    inner = r - depth
    block.paint(square(inner + 0.35), top + 0.5, wall)
    block.paint(square(inner), KERB, block.grass)
    gate = block.random.uniform(-inner + 2, inner - 2)
    paving = block.palette.add(Material.PAVEMENT, (0.55, 0.5, 0.46))
    block.paint((gate - 1.8, gate + 1.8, -r, -inner), KERB, paving)
    block.clutter((-r + 1, -inner - 1, -inner, inner), top)
    block.clutter((-inner, inner, inner + 1, r - 1), top)
    for x, y in ((-0.5, -0.4), (0.5, 0.45), (0.45, -0.5)):
        block.tree(inner * x, inner * y, block.random.uniform(0.7, 1.0) * min(1.6, 0.22 * inner))


def _park(block: Block) -> None:
    """Lawn, crossing paths, trees, and a slender monument."""
    r = block.reach
    path = block.palette.add(Material.EARTH, (0.66, 0.58, 0.45))
    block.paint(square(r), KERB + 0.05, block.grass)
    for area in ((-r, r, -1.0, 1.0), (-1.0, 1.0, -r, r), square(2.6)):
        block.paint(area, KERB, path)
    block.paint(square(1.4), 0.7, block.palette.add(Material.PAVEMENT, (0.62, 0.60, 0.58)))
    stone = block.palette.add(Material.ROOF, (0.80, 0.77, 0.70))
    block.turned(0, 0, [(0.55, 0.0, stone), (0.4, 8.5, stone), (0.05, 9.6, stone)], stone, sides=4)
    for i in np.linspace(-0.82, 0.82, 4):
        for j in np.linspace(-0.82, 0.82, 4):
            if block.random.random() < 0.7:
                x = r * i + block.random.uniform(-0.5, 0.5)
                y = r * j + block.random.uniform(-0.5, 0.5)
                block.tree(x, y, block.random.uniform(0.9, min(1.7, 0.17 * r)))


def _works(block: Block) -> None:
    """A hall under saw-tooth roofs, a round tank and a tall chimney."""
    r = block.reach
    yard = block.palette.add(Material.STREET, (0.47, 0.46, 0.45), (1e3, 1e3, 0))
    block.paint(square(r), KERB, yard)
    x0, x1, top = -r + 0.5, 0.25 * r, block.random.uniform(5.5, 8.0)
    hall = (x0, x1, -r + 0.5, r - 0.5)
    wall = block.box(hall, top)
    block.paint(hall, top, wall, covered=True)
    tiles = block.palette.add(Material.TILES, block.pick(TILES[2:]), (block.x, block.y, top))
    cuts = np.round(np.linspace(block.y - r + 0.5, block.y + r - 0.5, 4), 2)
    for y0, y1 in pairwise(cuts):
        add_roof(block.shapes, (block.x + x0, block.x + x1, y0, y1), top, 2.2, 0.0, tiles, wall)
    tank = block.palette.add(Material.METAL, block.pick(FLAT_ROOFS))
    size = 0.21 * r
    rings = [(size, 0.0, tank), (size, 5.0, tank), (0.3 * size, 6.0, tank)]
    block.turned(0.62 * r, -0.5 * r, rings, tank, sides=12)
    brick = block.palette.add(Material.ROOF, (0.60, 0.33, 0.25))
    block.turned(0.62 * r, 0.45 * r, [(0.9, 0.0, brick), (0.5, 19.0, brick)], brick, sides=12)


KINDS: dict[str, Callable[[Block], None]] = {
    "towers": _towers,
    "houses": _houses,
    "court": _court,
    "park": _park,
    "works": _works,
}
