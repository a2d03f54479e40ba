"""PSNR on held-out pixels while a run goes on, in about a hundredth of its time."""

from __future__ import annotations

import math
import time
from functools import cached_property
from typing import Any

import torch
from nerfstudio.cameras.rays import RayBundle
from torch import Tensor

from leco_plugin.evaluation.metrics import psnr, spread_evenly
from leco_plugin.learning.dense import evaluating
from leco_plugin.learning.quality import psnr_of_one_colour
from leco_plugin.log import note
from leco_plugin.scenes.learning_data import bundles_of_tests, held_out_bundle
from leco_plugin.scenes.pixels.held_out_pixels import held_out_sampler
from leco_plugin.studio.host_models import true_colours

FIRST_AFTER, BETWEEN = 8.0, 10.0
"""Seconds before PSNR is measured first, and the fewest between two measurements."""
SHARE_OF_TIME = 0.01
"""Of the time so far that all measurements may take; the first and the last may exceed it."""
OLD, SHARE_WHEN_OLD = 30.0, 0.03
"""Seconds after which PSNR is measured again where that takes at most so much of them."""
RAYS, FEWEST_LAST, MOST_LAST = 256, 1024, 8192
"""Rays of a measurement; the fewest and the most of the last one."""
OF = "on held-out pixels"
TEST_PHOTOGRAPHS = 8
"""That are looked at when a run is over."""


class HeldOutPsnr:
    """Measures the PSNR of nerfstudio's model on pixels of its training photographs that no step
    trains on. The model is trained exactly as it would be without.

    All measurements but the last are of the same pixels.

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
        self.began = time.monotonic()
        self.due = self.began + FIRST_AFTER

    @cached_property
    def has_pixels(self) -> bool:
        """Whether the data manager holds out pixels at all."""
        return held_out_sampler(self.manager) is not None

    def look(self) -> None:
        """Measures, if it is time and there is time to."""
        now = time.monotonic()
        old = now >= self.due - BETWEEN + OLD and self.cost <= SHARE_WHEN_OLD * OLD
        affordable = old or self.spent + self.cost <= SHARE_OF_TIME * (now - self.began)
        if now >= self.due and self.has_pixels and (affordable or self.latest is None):
            self._measure(RAYS)

    def look_last(self) -> int:
        """Measures once more, on as many pixels as there is time for; returns how many."""
        if not self.has_pixels:
            return 0
        free = SHARE_OF_TIME * (time.monotonic() - self.began) - self.spent
        affordable = int(RAYS * free / self.cost) if self.cost > 0.0 else 0
        return self._measure(max(FEWEST_LAST, min(affordable, MOST_LAST)))

    def _measure(self, count: int) -> int:
        """Measures on so many pixels, or as many as there are; returns how many.

        One ray comes before the clock starts: after a change of the occupancy it makes the model
        build the sampler that the next step needs as well, which takes seconds.
        """
        began = time.monotonic()
        if self.pixels is None or count != RAYS:  # of so many, the same are drawn once
            self.pixels = held_out_bundle(self.manager, count, share="all")
        bundle, truth = self.pixels
        drawn = time.monotonic()
        self._psnr_of([(bundle[:1], truth[:1])])
        started = time.monotonic()
        parts = [slice(i, i + FEWEST_LAST) for i in range(0, len(truth), FEWEST_LAST)]
        self.latest = self._psnr_of([(bundle[part], truth[part]) for part in parts])
        now = time.monotonic()
        self.cost = now - started
        self.spent += drawn - began + self.cost
        self.due = now + BETWEEN
        note(f"{self.words()}, measured in {self.cost:.2f} s; {self.spent:.2f} s in all")
        return len(truth)

    @torch.no_grad()
    def _psnr_of(self, pixels: list[tuple[RayBundle, Tensor]]) -> float:
        """PSNR, dB, of rendered rays, in chunks with true colours [R, 3 or 4]; sets
        `of_one_colour`."""
        device = self.model.device
        devices = [device] if torch.device(device).type == "cuda" else []
        with torch.random.fork_rng(devices), evaluating(self.model):
            rgb = torch.cat(
                [self.model(rays.to(device))["rgb"][:, :3].float() for rays, _ in pixels]
            )
            truth = torch.cat([truth for _, truth in pixels]).to(device).float()
            colours = true_colours(self.model, truth)
        self.of_one_colour = psnr_of_one_colour(colours)
        return psnr(rgb.clamp(0.0, 1.0), colours)

    def words(self) -> str:
        """The latest figure in words; nothing where there is none."""
        return "" if self.latest is None else f"{self.latest:.1f} dB {OF}"

    def look_at_tests(self) -> float | None:
        """PSNR, dB, on pixels of up to `TEST_PHOTOGRAPHS` test photographs that no lens or mask
        hides; None without any. From now on `of_one_colour` is of these pixels.

        They are new views: a field can be good on photographs that it was trained on and fail here.
        """
        dataset: Any = getattr(self.manager, "eval_dataset", None)
        if dataset is None or len(dataset) == 0:
            return None
        chosen = spread_evenly(len(dataset), TEST_PHOTOGRAPHS)
        found = [*bundles_of_tests(self.manager, chosen, FEWEST_LAST // len(chosen))]
        return self._psnr_of(found) if found else None
