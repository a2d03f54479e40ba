"""Where everything stands: which blocks exist, their streets, poles and wires, the city's edge.

All chance comes from generators keyed by the seed and by what they decide, so that a city needs
nothing stored but its configuration.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from leco_plugin.scenes.city.blocks import GROUND_DEPTH, KERB, KINDS, Block
from leco_plugin.scenes.city.shapes import (
    CARS,
    Array,
    Canvas,
    Material,
    Palette,
    Shapes,
    add_prism,
    add_wire,
    square,
)

LARGE = 9
"""From so many blocks a side on, the city's outline wanders."""
POLE_LINE = 0.8
"""Distance of poles and wires from the lot's edge, metres."""
_EDGE_PARTS = 3


def choose_blocks(blocks: int, seed: int) -> NDArray[np.bool_]:
    """Which cells [blocks, blocks] are built: the rim has gaps or, from `LARGE` on, bays."""
    built = np.ones((blocks, blocks), bool)
    if blocks < 3:
        return built
    if blocks >= LARGE:
        return _wandering(blocks, seed)
    random = np.random.default_rng([seed, blocks, 1])
    rim = np.ones_like(built)
    rim[1:-1, 1:-1] = False
    corner = np.zeros_like(built)
    corner[[0, 0, -1, -1], [0, -1, 0, -1]] = True
    built[rim & ~corner] = random.random((rim & ~corner).sum()) > 0.04 * min(blocks, 6) - 0.12
    built[corner] = random.permutation([False, True, True, True]) & (random.random(4) > 0.2)
    for i, j in ((0, 0), (0, -1), (-1, 0), (-1, -1)):
        # A corner without a neighbour would be an island.
        built[i, j] &= built[i, 1 if j == 0 else -2] or built[1 if i == 0 else -2, j]
    return built


def _wandering(blocks: int, seed: int) -> NDArray[np.bool_]:
    """A connected city with bays and headlands, about 4/5 of its square."""
    from scipy import ndimage  # the GPU suite, which photographs no such city, does without

    random = np.random.default_rng([seed, blocks, 6])
    x, y = np.moveaxis((np.indices((blocks, blocks)) + 0.5) / blocks * 2 - 1, 0, 0)
    turn = np.arctan2(y, x)
    reach = np.full(turn.shape, 1.1)
    for waves, depth in ((3, 0.08), (5, 0.06), (9, 0.05)):
        reach -= depth * (1 + np.sin(waves * turn + random.uniform(0, 2 * np.pi)))
    # between a circle and a square
    islands, _ = ndimage.label((x**6 + y**6) ** (1 / 6) <= reach)
    return np.asarray(islands == islands[blocks // 2, blocks // 2])


def centres(built: NDArray[np.bool_], size: float) -> Array:
    """Centres [blocks, blocks, 2] of all cells in metres; the city is centred on the origin."""
    places = (np.arange(len(built)) - (len(built) - 1) / 2) * size
    return np.stack(np.meshgrid(places, places, indexing="ij"), -1)


def plan_city(
    built: NDArray[np.bool_], size: float, seed: int, far_terrain: bool
) -> tuple[Shapes, Palette]:
    """Builds all shapes of a city whose blocks are `size` metres apart."""
    shapes, palette = Shapes(), Palette()
    metal = palette.add(Material.METAL, (0.30, 0.31, 0.32))
    lamp = palette.add(Material.METAL, (0.85, 0.85, 0.80))
    earth = palette.add(Material.EARTH, (0.38, 0.30, 0.22))
    middle = centres(built, size)
    lot = round(0.7 * size, 2)
    kinds = _kinds(built, seed)
    for i, j in np.argwhere(built):
        x, y = (round(float(v), 2) for v in middle[i, j])
        random = np.random.default_rng([seed, int(i), int(j), 2])
        street = palette.add(Material.STREET, (0.29, 0.29, 0.31), (x, y, size))
        pavement = palette.add(Material.PAVEMENT, (0.62, 0.60, 0.57), (x, y, 0))
        grass = palette.add(Material.GRASS, (0.33, 0.46, 0.20), (x, y, 0))
        canvas = Canvas(square(lot / 2, x, y), street)
        canvas.stroke(square(lot / 2 - 0.2, x, y), KERB, pavement)
        block = Block(shapes, palette, random, x, y, lot, canvas, metal, earth, grass)
        KINDS[kinds[i, j]](block)
        _pavement(block, lamp)
        canvas.build(shapes, GROUND_DEPTH)
        _streets(block, size, street)
    _wires(shapes, built, middle, lot, metal)
    _edge(shapes, built, size, seed, palette)
    if far_terrain:
        _terrain(shapes, palette, float(np.abs(middle).max() + size), seed)
    return shapes, palette


def _kinds(built: NDArray[np.bool_], seed: int) -> NDArray[np.str_]:
    """Towers towards the middle, houses towards the rim, parks and works in between."""
    random = np.random.default_rng([seed, len(built), 3])
    places = np.argwhere(built)
    reach = np.linalg.norm(places - (len(built) - 1) / 2, axis=1) / max(len(built) / 2, 1)
    order = np.argsort(reach + random.uniform(-0.25, 0.25, len(reach)))
    wheel = np.array(
        ["towers", "court", "towers", "park", "court", "houses", "works", "houses", "houses"]
    )
    share = (np.arange(len(order)) * len(wheel) / max(len(order), 1)).astype(int)
    kinds = np.full(built.shape, "towers", dtype="<U8")
    kinds[tuple(places[order].T)] = wheel[share]
    return kinds


def _pavement(block: Block, lamp: int) -> None:
    """Poles for wires on the east and south side of the lot, lamps and trees on the others."""
    line, quarter = block.lot / 2 - POLE_LINE, 0.36 * block.lot
    for along in (-quarter, quarter):
        radius = round(float(block.random.uniform(0.10, 0.15)), 2)
        pole = [(radius, 0.0, block.metal), (radius, 9.9, block.metal)]
        block.turned(line, along, pole, block.earth)
        block.turned(along, -line, [*pole[:1], (radius, 8.7, block.metal)], block.earth)
        rod, head = [(0.08, 0.0), (0.08, 5.2)], [(0.35, 5.35), (0.3, 5.6)]
        post = [(*ring, block.metal) for ring in rod] + [(*ring, lamp) for ring in head]
        block.turned(-line, along, post, block.earth)
        block.turned(along, line, post, block.earth)
    for along in (-0.18 * block.lot, 0.0, 0.18 * block.lot):
        for place in ((-line - 0.1, along), (along, line + 0.1)):
            if block.random.random() < 0.75:
                block.tree(*place, block.random.uniform(0.8, 1.1))


def _streets(block: Block, size: float, street: int) -> None:
    """The four half-streets around the lot, turned around it like a windmill, and parked cars."""
    h, e = block.lot / 2, size / 2
    strips = [(-e, h, -e, -h), (h, e, -e, h), (-h, e, h, e), (-e, -h, -h, e)]
    for number, strip in enumerate(strips):
        canvas = Canvas(block.placed(strip), street)
        for along in np.arange(-0.35, 0.36, 0.175) * block.lot:
            if block.random.random() > 0.55:
                continue
            paint = block.palette.add(Material.METAL, block.pick(CARS))
            glass = block.palette.add(Material.METAL, (0.12, 0.15, 0.18))
            across = (h + 1.3) * (-1 if number in (0, 3) else 1)
            for length, width, top, colour in (
                (2.1, 0.9, 0.85, paint),
                (1.2, 0.8, 1.25, glass),
                (1.0, 0.75, 1.45, paint),
            ):
                dx, dy = (length, width) if number in (0, 2) else (width, length)
                x, y = (along, across) if number in (0, 2) else (across, along)
                x, y = x + block.x, y + block.y
                canvas.stroke((x - dx, x + dx, y - dy, y + dy), top, colour)
        canvas.build(block.shapes, GROUND_DEPTH)


def _wires(shapes: Shapes, built: NDArray[np.bool_], middle: Array, lot: float, metal: int) -> None:
    """Two sagging wires along every line of poles, as far as the blocks go without a gap."""
    line, quarter = lot / 2 - POLE_LINE, 0.36 * lot
    for axis, height in ((1, 9.6), (0, 8.4)):
        rows = built if axis == 1 else built.T
        for number, row in enumerate(rows):
            edges = np.flatnonzero(np.diff(np.concatenate([[0], row.astype(int), [0]])))
            for start, stop in edges.reshape(-1, 2):
                run = middle[number, start:stop] if axis == 1 else middle[start:stop, number]
                poles = np.sort(np.concatenate([run[:, axis] - quarter, run[:, axis] + quarter]))
                fixed = run[0, 1 - axis] + (line if axis == 1 else -line)
                for offset in (-0.4, 0.4):
                    path = _sagging(poles, height)
                    other = np.full(len(path), fixed + offset)
                    columns = (other, path[:, 0]) if axis == 1 else (path[:, 0], other)
                    add_wire(shapes, np.column_stack([*columns, path[:, 1]]), 0.05, metal)


def _sagging(poles: Array, height: float) -> Array:
    """Points [V, 2] (along, z) of a wire that hangs from `poles` [P] at `height`, by parabolas half
    a metre deep."""
    t = np.linspace(0, 1, 4)[:-1]
    low = height - 0.5 * 4 * t * (1 - t)
    spans = [np.column_stack([a + t * (b - a), low]) for a, b in pairwise(poles)]
    return np.concatenate([*spans, [[poles[-1], height]]])


def _edge(
    shapes: Shapes, built: NDArray[np.bool_], size: float, seed: int, palette: Palette
) -> None:
    """Aprons of irregular depth wherever a block has no neighbour: the outline of the city."""
    verge = palette.add(Material.GRASS, (0.45, 0.46, 0.24))
    earth = palette.add(Material.EARTH, (0.46, 0.36, 0.26))
    cells = np.argwhere(built).astype(float)
    there = set(map(tuple, cells))

    def depth(cell: Array, corner: Array) -> float:
        # The same corner seen from both its edges must get the same depth: key by place.
        key = np.rint(np.concatenate([cell * 12, corner * 12]) + 1200).astype(int)
        return float(np.random.default_rng([seed, 4, *key]).uniform(2.5, 9.0)) * min(1.0, size / 40)

    for cell in cells:
        for out in np.array([[1, 0], [0, 1], [-1, 0], [0, -1]], float):
            if tuple(cell + out) in there:
                continue
            along = np.array([-out[1], out[0]])
            inner, outer = [], []
            for part in np.linspace(-0.5, 0.5, _EDGE_PARTS + 1):
                node, step, owner = cell + 0.5 * out + part * along, out, cell * 0
                if abs(part) == 0.5:
                    side = 2 * part * along
                    if tuple(cell + out + side) in there:
                        step, owner = out - side, cell + out
                    elif tuple(cell + side) not in there:
                        step, owner = out + side, cell
                inner.append(node)
                outer.append(node + step * depth(owner, node) / size)
            for k in range(_EDGE_PARTS):
                polygon = np.array([inner[k], outer[k], outer[k + 1], inner[k + 1]])
                top = np.column_stack([(polygon - (len(built) - 1) / 2) * size, np.zeros(4)])
                add_prism(shapes, top, -GROUND_DEPTH, verge, [False, True, False, False], earth)


def _terrain(shapes: Shapes, palette: Palette, extent: float, seed: int) -> None:
    """A plain just below the city's plateau that rises to hills at several times its size."""
    land = palette.add(Material.TERRAIN, (0.38, 0.42, 0.26))
    random: Generator = np.random.default_rng([seed, 5])
    sectors = 48
    radii = extent * np.array([0.0, 1.5, 2.2, 3.0, 4.0, 5.0, 6.0])
    turn = 2 * np.pi * np.arange(sectors) / sectors
    waves = sum(np.sin(k * turn + random.uniform(0, 2 * np.pi)) / k for k in (2, 3, 5, 7, 11))
    rise = extent * np.array([0.0, 0.0, 0.08, 0.3, 0.5, 0.75, 0.6])
    level = -GROUND_DEPTH - 0.1

    def point(ring: int, sector: int) -> Array:
        s = sector % sectors
        rough = 1 + 0.5 * waves[s] if ring > 1 else 1.0
        wobble = np.sin(3.1 * ring + 7 * turn[s] + seed) * 0.25 * rise[ring]
        z = level + max(rise[ring] * rough * 0.6 + wobble, 0.0)
        return np.array([radii[ring] * np.cos(turn[s]), radii[ring] * np.sin(turn[s]), z])

    for sector in range(sectors):
        for ring in range(len(radii) - 1):
            a, b = point(ring, sector), point(ring + 1, sector)
            c, d = point(ring + 1, sector + 1), point(ring, sector + 1)
            last = ring == len(radii) - 2
            add_prism(shapes, np.array([a, b, c]), level - 20, land, [False, last, False], land)
            if ring:
                add_prism(shapes, np.array([a, c, d]), level - 20, land, [False] * 3, land)
