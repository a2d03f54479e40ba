"""How the bytes of a sound file are damaged: three ways, each drawn at random."""

from __future__ import annotations

import numpy as np
from numpy.random import Generator


def flip(data: bytes, random: Generator) -> bytes:
    changed = np.frombuffer(data, np.uint8).copy()
    places = random.integers(len(changed), size=random.integers(1, 9))
    changed[places] ^= (1 << random.integers(8, size=len(places))).astype(np.uint8)
    return changed.tobytes()


def cut(data: bytes, random: Generator) -> bytes:
    return data[: random.integers(len(data))]


def splice(data: bytes, random: Generator) -> bytes:
    """A part of it is missing, doubled, or of another value."""
    start, stop = sorted(random.integers(len(data), size=2))
    middle = (b"", 2 * data[start:stop], bytes([random.integers(256)]) * (stop - start))
    return data[:start] + middle[random.integers(3)] + data[stop:]
