"""PSNR on held-out pixels while a run goes on, in at most a hundredth of its time."""

from __future__ import annotations

import math
import time
from functools import cached_property
from typing import Any

import torch
from nerfstudio.cameras.rays import RayBundle
from torch import Tensor

from leco_plugin.evaluation.metrics import psnr
from leco_plugin.learning.dense import evaluating
from leco_plugin.learning.quality import doubts_of_field, psnr_of_one_colour
from leco_plugin.log import note
from leco_plugin.scenes.learning_data import held_out_bundle
from leco_plugin.scenes.pixels.held_out_pixels import held_out_sampler
from leco_plugin.studio.host_models import true_colours

FIRST_AFTER, BETWEEN = 8.0, 10.0
"""Seconds before PSNR is measured first, and the fewest between two measurements."""
SHARE_OF_TIME = 0.01
"""Of the time so far that all measurements may have taken; the first and the last may exceed it."""
RAYS, FEWEST_LAST, MOST_LAST = 256, 1024, 8192
"""Rays of a measurement; of the last one, the fewest and the most."""
OF = "on held-out pixels"


class HeldOutPsnr:
    """Measures the PSNR of a model on pixels of the training photographs that no step trains on.

    The model is trained exactly as it would be without. All measurements but the last are of the
    same pixels.

    Args:
        model: nerfstudio's, in training.
        manager: the data manager that it learns from.

    Attributes:
        latest: dB, None until it was measured.
        of_one_colour: dB of their mean colour on the same pixels.
        spent: seconds that measuring has taken.
    """

    def __init__(self, model: Any, manager: Any) -> None:
        self.model, self.manager = model, manager
        self.spent = self.cost = 0.0
        self.begin()
        self.latest: float | None = None
        self.of_one_colour = math.inf
        self.pixels: tuple[RayBundle, Tensor] | None = None

    def begin(self) -> None:
        """The time that counts begins now."""
        self.began = time.monotonic()
        self.due = self.began + FIRST_AFTER

    @cached_property
    def has_pixels(self) -> bool:
        """Whether the data manager holds out pixels at all."""
        return held_out_sampler(self.manager) is not None

    def look(self) -> None:
        """Measures where that is due."""
        now = time.monotonic()
        affordable = self.spent + self.cost <= SHARE_OF_TIME * (now - self.began)
        if now >= self.due and self.has_pixels and (affordable or self.latest is None):
            self._measure(RAYS)

    def look_last(self) -> int:
        """Measures once more, on as many pixels as there is time for; returns how many."""
        if not self.has_pixels:
            return 0
        free = SHARE_OF_TIME * (time.monotonic() - self.began) - self.spent
        affordable = int(RAYS * free / self.cost) if self.cost > 0.0 else 0
        count = max(FEWEST_LAST, min(affordable, MOST_LAST))
        return self._measure(count)

    def _drawn(self, count: int) -> tuple[RayBundle, Tensor]:
        """Rays and their true colours [R, 3 or 4]; the same are drawn once."""
        if self.pixels is None or count != RAYS:
            self.pixels = held_out_bundle(self.manager, count, share="all")
        return self.pixels

    @torch.no_grad()
    def _measure(self, count: int) -> int:
        """Measures on so many pixels, or as many as there are; returns how many."""
        began = time.monotonic()
        bundle, truth = self._drawn(count)
        started = time.monotonic()
        device = self.model.device
        cards = [device] if torch.device(device).type == "cuda" else []
        with torch.random.fork_rng(cards), evaluating(self.model):
            chunks = [
                bundle[at : at + FEWEST_LAST].to(device) for at in range(0, len(truth), FEWEST_LAST)
            ]
            rgb = torch.cat([self.model(chunk)["rgb"][:, :3].float() for chunk in chunks])
            colours = true_colours(self.model, truth.to(device).float())
            self.latest = psnr(rgb.clamp(0.0, 1.0), colours)
            self.of_one_colour = psnr_of_one_colour(colours)
        now = time.monotonic()
        self.cost = now - started
        self.spent += now - began
        self.due = now + BETWEEN
        note(f"{self.words()}, measured in {self.cost:.2f} s; {self.spent:.2f} s in all")
        return len(truth)

    def words(self) -> str:
        """The latest figure in words; nothing where there is none."""
        return "" if self.latest is None else f"{self.latest:.1f} dB {OF}"

    def doubts(self) -> list[str]:
        """Two lines where the latest figure is hardly above that of one colour for all pixels."""
        return [] if self.latest is None else doubts_of_field(self.latest, self.of_one_colour)
