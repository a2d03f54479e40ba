"""Sharpening: a small gate that the field teaches anew, and that skips more than the learned one.

While a gate is learned, haze teaches it too, and it also routes points to experts. Late in a run
the field's rendering weights along training rays, a `Lesson`, teach a fresh gate of seven thousand
values, which only says what is empty. It is calibrated like the first one, and skips in its place
if it skips more. The large gate goes on routing.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import softplus

from leco_plugin.learning.calibration import (
    LOSSES,
    CalibrationConfig,
    Measured,
    calibrate,
    lost_by_each,
    measure,
    promise,
    worst_so_far,
)
from leco_plugin.learning.dense import (
    DenseRendering,
    Reference,
    dense_rendering,
    evaluating,
    in_chunks,
    reference_of,
)
from leco_plugin.learning.schedule import RATES
from leco_plugin.models.encodings import EncodingConfig
from leco_plugin.models.gate import Gate, GateConfig, check_sizes, occupancy_logit
from leco_plugin.models.losses import widen
from leco_plugin.models.mixture import Mixture
from leco_plugin.models.objective import GateLossConfig
from leco_plugin.models.rendering import Intervals, Rays, backdrop_of, mapped_middles
from leco_plugin.occupancy import CAMERAS_THAT_VOUCH, TESTS_LOSE, Precision, gate_precision
from leco_plugin.scenes.input_error import InputError, require

BATCH = 1 << 11
"""Positions of a step. In the same time many steps of few teach more than few of many."""
LAST_RATE = 0.05
"""Of the learning rate, after a half cosine."""


class Lesson(NamedTuple):
    """How much each position speaks for being kept, and for being skipped."""

    mapped: Tensor
    """[M, 3] in [-1, 1]."""
    keep: Tensor
    """[M] weight of -log o(x)."""
    skip: Tensor
    """[M] weight of -log(1 - o(x))."""


def lesson_from_weights(
    mapped: Tensor, weights: Tensor, of_rays: Tensor, losses: GateLossConfig
) -> Lesson:
    """The targets of the contribution loss, with its w_0 and k, at samples along rays: positions
    [M, 3] in [-1, 1], in the order of rays, then distance; rendering weights [M]; and rays [M]."""
    wide = widen(weights, of_rays[1:] == of_rays[:-1])
    target = (wide / losses.weight_at_full).clamp(max=1.0)
    return Lesson(mapped, losses.emphasis * target, 1.0 - target)


def teach(
    config: GateConfig,
    lesson: Lesson,
    steps: int,
    precision: Precision,
    seed: int = 0,
    on_progress: Callable[[float], None] | None = None,
) -> Gate:
    """A new gate, taught by a lesson in `precision` and rounded to bfloat16.

    Minimises mean[-keep log o - skip log(1 - o)], the contribution loss with given targets, in
    steps of Adam on `BATCH` positions each.
    """
    with torch.random.fork_rng(devices=[]):
        torch.default_generator.manual_seed(seed)  # `torch.manual_seed` seeds all cards too
        gate = Gate(config).to(lesson.mapped.device)
    rate = 2.0 * RATES["gate"]  # of networks; tables learn at least as fast as those of a field
    tables = list(gate.encoding.parameters())
    known = {id(table) for table in tables}
    groups = [{"params": [p for p in gate.parameters() if id(p) not in known], "lr": rate}]
    groups += [{"params": tables, "lr": max(rate, RATES["encoding"])}] if tables else []
    optimizer = torch.optim.Adam(groups, eps=1e-15, fused=True)
    schedule = torch.optim.lr_scheduler.LambdaLR(
        optimizer,
        lambda step: LAST_RATE + (1 - LAST_RATE) * 0.5 * (1 + math.cos(math.pi * step / steps)),
    )
    generator = torch.Generator().manual_seed(seed)
    for step in range(steps):
        drawn = torch.randint(len(lesson.mapped), (BATCH,), generator=generator)
        mapped, keep, skip = (part[drawn.to(part.device)] for part in lesson)
        with gate_precision(mapped.device.type, precision):
            occupied = occupancy_logit(gate(mapped))
        value = (keep * softplus(-occupied) + skip * softplus(occupied)).mean()
        optimizer.zero_grad(set_to_none=True)
        value.backward()
        optimizer.step()
        schedule.step()
        if on_progress is not None:
            on_progress((step + 1) / steps)
    round_weights(gate.requires_grad_(False))
    return gate.eval()


@torch.no_grad()
def round_weights(gate: torch.nn.Module) -> None:
    """Rounds all numbers of a gate, or of a part of it, to bfloat16."""
    for parameter in gate.parameters():
        parameter.copy_(parameter.bfloat16().float())


@dataclass(frozen=True)
class SharpeningConfig:
    """When and how a small gate is taught by the field."""

    steps: int = 2000
    """Of teaching, each with 2,048 positions; 0 never sharpens."""
    least_steps: int = 1500
    """Guided steps from which on it pays: a gate is sharpened when nine tenths of a run are over,
    if the field has had so many. Earlier it would have skipped what the field has not found yet."""
    rays: int = 1 << 15
    """Training rays that teach. With a quarter of them a gate learns the rays, not the scene."""
    gate: GateConfig = field(
        default_factory=lambda: GateConfig(EncodingConfig(octaves=6), 64, 2, 1, normed=False)
    )
    """The small gate."""

    def __post_init__(self) -> None:
        require(self.steps >= 0, "sharpening.steps", self.steps, "at least 0")
        require(self.least_steps >= 0, "sharpening.least-steps", self.least_steps, "at least 0")
        require(self.rays >= 1, "sharpening.rays", self.rays, "at least 1")
        try:
            check_sizes(self.gate)
        except ValueError as error:
            raise InputError(f"sharpening.gate: {error}; no size of it is automatic") from None


class Sharpened(NamedTuple):
    """A small gate, and what it does on held-out rays."""

    gate: Gate
    measured: Measured
    before: Measured
    """The same of what has guided so far."""
    promised: dict[str, Any] | None
    """What photographs say of it and of what has guided so far, see `calibration.promise`."""
    tests_lose: Sequence[float] = ()
    """What each of some test photographs loses to both; empty where that is not known."""

    @property
    def pays(self) -> bool:
        """Whether it skips more, within the same bounds."""
        return self.measured.empty_fraction > self.before.empty_fraction

    @property
    def params(self) -> int:
        """Learned values of the gate."""
        return sum(parameter.numel() for parameter in self.gate.parameters())

    def line(self, report: Mapping[str, Any]) -> str:
        """What it does, in the words of the log. The costs of what has guided so far, whose report
        this is, are among its own."""
        end = "" if self.pays else "; that is no more, and the gate stays"
        return self.measured.line_beside(report, self.before.empty_fraction) + end

    def report(self, before: dict[str, Any], learned: GateConfig) -> dict[str, Any]:
        """The report of an occupancy of this gate.

        Args:
            before: of what has guided so far. The losses that it declares are added, for the field
                has been trained without what it skips.
            learned: the gate that routes. It stays in the report, with what it did, as `learned`.
        """
        found = self.measured.on_top_of(before)._asdict()
        found |= {CAMERAS_THAT_VOUCH: self.promised, TESTS_LOSE: self.tests_lose}
        kept = {name: before[name] for name in ("threshold", "params", "empty_fraction", *LOSSES)}
        known = {"learned": {"gate": learned.to_dict(), **kept}}
        return known | before | found | {"params": self.params}


def sharpen(
    mixture: Mixture,
    taught: Rays,
    held_out: tuple[Rays, Tensor],
    cameras: list[Rays],
    tests: list[Rays],
    losses: GateLossConfig,
    calibration: CalibrationConfig,
    config: SharpeningConfig,
) -> Sharpened | None:
    """Teaches a small gate by the field of a mixture that was trained guided, and calibrates it;
    changes nothing. None where no ray has a candidate to teach with.

    The field knows only what has been kept, so the rest counts as empty, and prices are of skipping
    more than before. Together with what that has cost they are held to the bounds.

    Args:
        taught: training rays, cut to the region.
        held_out: rays that nothing was trained on, and their colours [R, 3].
        cameras: rays of each photograph that vouched for what has skipped so far; they lower the
            threshold, and have trained the field.
        tests: of each test photograph; they say what new views lose.
        losses: whose contribution loss teaches.
    """
    at_once = calibration.rays_at_once
    with evaluating(mixture):
        lesson = lesson_from_field(mixture, taught, losses, 1.0, at_once)
        if not len(lesson.mapped):
            return None
        gate = teach(config.gate, lesson, config.steps, mixture.precision)
        rendering = dense_rendering(mixture, *held_out, at_once, guided_reference)
        before = measure(rendering, float(mixture.threshold))
        score = partial(mixture.occupancies, gate=gate)
        by_small = rescore_rendering(mixture, score, in_chunks(held_out[0], at_once), rendering)
        of_cameras, of_tests = (
            [_rescore(mixture, score, rays, guided_reference(mixture, rays)) for rays in some]
            for some in (cameras, tests)
        )
        spent = mixture.report
        measured = calibrate(by_small, calibration, cameras=of_cameras, spent=spent)
        lost = lost_by_each(of_cameras, measured.threshold)
        promised = promise([worst_so_far(spent) + one for one in lost], calibration, taught=True)
        pairs = zip(spent.get(TESTS_LOSE, ()), lost_by_each(of_tests, measured.threshold))
        tests_lose = [sum(pair) for pair in pairs]
        promised = promise(tests_lose, calibration) or promised
        return Sharpened(gate, measured, before, promised, tests_lose)


@torch.no_grad()
def lesson_from_field(
    mixture: Mixture, rays: Rays, losses: GateLossConfig, share: float, rays_at_once: int
) -> Lesson:
    """The targets of the contribution loss at all candidates of rays, cut to the mixture's region.
    Candidates with o(x) below this share of the threshold are not rendered, and have weight 0."""
    lessons = []
    for chunk in in_chunks(rays, rays_at_once):
        intervals, mapped, occupancies, drawn, some = _candidates_of(mixture, chunk, share)
        before = ~backdrop_of(intervals, chunk)
        weights = torch.zeros_like(occupancies)
        weights[drawn] = mixture.weigh(chunk, some)
        of_rays = intervals.ray_indices[before]
        lessons.append(lesson_from_weights(mapped[before], weights[before], of_rays, losses))
    return Lesson(*(torch.cat(parts) for parts in zip(*lessons)))


@torch.no_grad()
def _candidates_of(
    mixture: Mixture, rays: Rays, share: float
) -> tuple[Intervals, Tensor, Tensor, Tensor, Intervals]:
    """Candidates and backdrops of rays, where they lie [M, 3] in [-1, 1], their o(x) [M], which of
    them are rendered, bool [M], and the rendered ones alone."""
    intervals = mixture.with_backdrops(rays, mixture.candidates(rays))
    mapped = mapped_middles(mixture.region.space, rays, intervals)
    occupancies = mixture.occupancies(mapped)
    drawn = (occupancies >= share * mixture.threshold) | backdrop_of(intervals, rays)
    some = Intervals(*(part[drawn] for part in intervals))
    return intervals, mapped, occupancies, drawn, some


@torch.no_grad()
def guided_reference(mixture: Mixture, rays: Rays) -> Reference:
    """As `dense_reference`, where candidates below the threshold are not rendered and have no
    weight. Guided training has not taught the field what is there."""
    intervals, _, occupancies, drawn, some = _candidates_of(mixture, rays, 1.0)
    small = reference_of(mixture.shade(rays, some), some, rays)
    weights, surface = torch.zeros_like(occupancies), torch.zeros_like(drawn)
    weights[drawn], surface[drawn] = small.weights.float(), small.near_surface
    backdrops = backdrop_of(intervals, rays)
    return Reference(intervals, weights, occupancies, surface, small.rgb, backdrops)


Score = Callable[[Tensor], Tensor]
"""Mapped positions [M, 3] in [-1, 1] to o(x), or another score, [M]."""


def rescore_rendering(
    mixture: Mixture, score: Score, chunks: list[Rays], rendering: DenseRendering
) -> DenseRendering:
    """The same rendering of rays, with the scores of another gate, or of a grid, as its o(x)."""
    pairs = zip(chunks, rendering.references, strict=True)
    return rendering._replace(references=[_rescore(mixture, score, *pair) for pair in pairs])


def _rescore(mixture: Mixture, score: Score, rays: Rays, reference: Reference) -> Reference:
    mapped = mapped_middles(mixture.region.space, rays, reference.intervals)
    return reference._replace(occupancies=score(mapped))
