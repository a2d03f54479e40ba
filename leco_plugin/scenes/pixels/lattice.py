"""Which training pixels are never trained on: a thin lattice over every picture.

It needs no memory, and is the same on every process and after every resume.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from leco_plugin.scenes.input_error import InputError

PERIODS = (11, 9, 7, 5)
"""Pixels between two that are held out, in both directions: 1 in 121 where pictures have enough, 1
in 25 at most."""
WANTED = 12_000
"""Held-out pixels of all pictures together: some more than calibrating and checking ask for."""
Share = Literal["calibration", "recheck", "all"]
"""Which held-out pixels: those that the threshold is calibrated with, those that it is checked with
later, a quarter of all, or either."""


@dataclass(frozen=True)
class Lattice:
    """One pixel of `period` x `period`."""

    period: int = PERIODS[0]

    def __post_init__(self) -> None:
        if self.period < 2:
            raise InputError(
                f"of {self.period} pixels in both directions none is left to train on; "
                "held-out-period is 2 or more"
            )

    @property
    def offset(self) -> int:
        """Row and column of a picture's first held-out pixel."""
        return self.period // 2

    def holds_out(self, pixels: Tensor) -> Tensor:
        """Whether pixels (image, row, column) [N, 3] are held out: bool [N]."""
        return (pixels[:, 1:] % self.period == self.offset).all(dim=-1)

    def is_of(self, pixels: Tensor, share: Share) -> Tensor:
        """Whether held-out pixels (image, row, column) [N, 3] belong to a share: bool [N]."""
        if share == "all":
            return torch.ones(len(pixels), dtype=torch.bool)
        checks = (pixels[:, 1:] // self.period).sum(dim=-1) % 4 == 3
        return checks if share == "recheck" else ~checks

    def counts(self, sizes: Tensor) -> Tensor:
        """Held-out pixels of pictures of sizes [P, 2] (height, width): [P, 2] (rows, columns). Of
        a picture that is too small for one, its last counts."""
        return ((sizes - self.offset - 1) // self.period + 1).clamp(min=1)

    def draw(self, sizes: Tensor, count: int, generator: torch.Generator) -> Tensor:
        """Held-out pixels [N, 3] int64 (image, row, column) in random order, each once: up to so
        many of pictures of sizes [P, 2] (height, width)."""
        counts = self.counts(sizes)
        ends = counts.prod(dim=-1).cumsum(dim=0)
        total = int(ends[-1])
        if total <= count:
            numbers = torch.randperm(total, generator=generator)
        else:
            numbers = torch.randint(total, (count,), generator=generator).unique()
            numbers = numbers[torch.randperm(len(numbers), generator=generator)]
        which = torch.searchsorted(ends, numbers, right=True)
        numbers = numbers - (ends - counts.prod(dim=-1))[which]
        columns = counts[which, 1]
        places = torch.stack([numbers // columns, numbers % columns], dim=-1)
        places = torch.minimum(places * self.period + self.offset, sizes[which] - 1)
        return torch.cat([which[:, None], places], dim=-1)


def lattice_for(sizes: Sequence[Sequence[int]] | Tensor) -> Lattice:
    """The thinnest lattice that holds out as many pixels as are wanted, of pictures of sizes [P, 2]
    (height, width); the densest where none does."""
    sizes = torch.as_tensor(sizes)
    for period in PERIODS:
        if int(Lattice(period).counts(sizes).prod(dim=-1).sum()) >= WANTED:
            return Lattice(period)
    return Lattice(PERIODS[-1])
