"""Whether a fused kernel answers instead of its torch twin; the one place that imports kernels.

Kernels need Triton and CUDA. Before its first answer a kernel is compared with its twin on random
positions and rays, once for each gate, threshold and cell cache. If a kernel is missing, fails or
decides otherwise, one line of the log says so, and the twin answers from then on.
"""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any, NamedTuple, TypeVar
from weakref import WeakKeyDictionary

import torch
from torch import Tensor, nn

from leco_plugin.samplers import marching
from leco_plugin.samplers.base import Snapshot
from leco_plugin.samplers.cells.cache import CellCache
from leco_plugin.samplers.kernels import kernels_off
from leco_plugin.samplers.kernels.gate_weights import (
    MOST_WIDTH,
    MOST_WIDTH_BUT_HOPPER,
    MOST_WIDTH_FLOAT32,
    GateWeights,
    gate_weights,
    why_not,
)
from leco_plugin.samplers.marching import Samples
from leco_plugin.samplers.rays import Candidates, March, Rays, TooManyCandidates, number
from leco_plugin.scenes.input_error import first_line

_log = logging.getLogger(__name__)

WIDEST_MARCH = 128
"""Compiled, a march around a wider gate spills its registers; the twin asks the fused gate then."""

COMPARED = 4096
"""Positions on which a gate's kernel is compared."""
OTHERWISE = 0.02
"""Share of what the twin keeps that a kernel may decide otherwise; a steep gate turns single
roundings into decisions."""
NEAR_THRESHOLD = {True: 0.02, False: 2e-4}
"""Distance of o(x) from the threshold within which a decision is not counted; by whether products
are bfloat16."""
RAYS, STEPS = 64, 128
"""Rays on which the march is compared, and the most candidates of each."""

Answer = TypeVar("Answer")


class _Packed(NamedTuple):
    """The weights of an occupancy, and what they were packed from."""

    snapshot: Snapshot
    weights: GateWeights | None


_off: set[str] = set()
"""The kernels that are not used in this process; for good once one has failed."""
_packed: WeakKeyDictionary[nn.Module, _Packed] = WeakKeyDictionary()
_passed: dict[str, WeakKeyDictionary[nn.Module, GateWeights]] = {
    name: WeakKeyDictionary() for name in ("gate", "march", "march with growing steps")
}
"""The weights with which each kernel passed its comparison: of an occupancy, or of its cells."""


@contextmanager
def twins_only() -> Iterator[None]:
    """Within it torch answers everything: what kernels are compared with."""
    before = _off.copy()
    _off.update(("gate", "march"))
    try:
        yield
    finally:
        _off.intersection_update(before)


def is_ready(device: torch.device, name: str = "gate") -> bool:
    """Whether a kernel, `gate` or `march`, may be tried on this device."""
    if device.type != "cuda" or torch.version.cuda is None:
        return False
    return name not in _off and name not in kernels_off()


def decide(occupancy: nn.Module, positions: Tensor) -> Tensor | None:
    """The fused gate's decisions about positions [N, 3], bool [N], of an `Occupancy` on their
    device; None: ask the torch twin."""
    weights = _trusted_weights(occupancy, positions)
    if weights is None:
        return None
    answer = functools.partial(_gate_decisions, weights, positions)
    return attempt("gate", answer, positions.device)


def march(occupancy: object, cache: CellCache | None, rays: Rays, rule: March) -> Samples | None:
    """The fused march of an estimator's rays; None: ask the torch twin.

    Without cells every candidate would ask the gate in both launches: the twin asks it once.

    Args:
        occupancy: an `Occupancy`, or anything else that an estimator asks.
        cache: the cells of its decisions.
    Raises:
        ValueError: as `marching.march`.
    """
    device, growing = rays.origins.device, rule.cone_angle > 0.0
    if cache is None or not isinstance(occupancy, nn.Module) or not is_ready(device, "march"):
        return None
    weights = _trusted_weights(occupancy, rays.origins)
    if weights is None or weights.padded_width > WIDEST_MARCH:
        return None
    candidates = number(rays, rule)
    if not rule.fits_kernels:
        return None
    kind = "march with growing steps" if growing else "march"
    compare = functools.partial(compare_march, occupancy, cache, weights, growing)
    if not _passes("march", kind, cache, weights, compare):
        return None
    return attempt("march", functools.partial(_march_kept, cache, weights, candidates), device)


def attempt(name: str, kernel: Callable[[], Answer], device: torch.device) -> Answer | None:
    """What a kernel answers, or None after it failed, which the log says once.

    Where the gate fails the march, which holds it, is not tried; not the other way round.
    """
    try:
        with on(device):
            return kernel()
    except (torch.cuda.OutOfMemoryError, TooManyCandidates):
        raise
    except Exception as error:  # noqa: BLE001 - a compiler and its driver raise what they like
        _off.update((name, "march"))
        reason = first_line(error)
        _log.warning("the fused %s does not run, torch answers in its place: %s", name, reason)
        return None


def on(device: torch.device) -> AbstractContextManager[object]:
    """Triton launches on the current device, wherever the tensors are."""
    return torch.cuda.device(device) if device.type == "cuda" else nullcontext()


def weights_of(occupancy: nn.Module) -> GateWeights | None:
    """The packed weights of an occupancy, packed anew when it has changed; None if none fit."""
    found = _packed.get(occupancy)
    if found is None or not found.snapshot.matches(occupancy):
        state = (*occupancy.parameters(), *occupancy.buffers())
        device = state[0].device if state else torch.device("cpu")
        reason = _why_not(occupancy, device)
        if reason is not None and found is None:  # else it has been said
            _log.info("no fused gate: %s", reason)
        found = _Packed(Snapshot(occupancy), gate_weights(occupancy) if reason is None else None)
        _packed[occupancy] = found
    return found.weights


def _why_not(occupancy: Any, device: torch.device) -> str | None:
    """Why a device gets no kernel for this occupancy's gate, or None if it does."""
    if device.type != "cuda":
        return why_not(occupancy)
    capability = torch.cuda.get_device_capability(device)
    if capability < (8, 0):
        return f"compute capability {capability[0]}.{capability[1]} is below 8.0"
    if getattr(occupancy, "precision", None) == "float32":
        return why_not(occupancy, MOST_WIDTH_FLOAT32)
    return why_not(occupancy, MOST_WIDTH if capability[0] == 9 else MOST_WIDTH_BUT_HOPPER)


def _trusted_weights(occupancy: nn.Module, positions: Tensor) -> GateWeights | None:
    """The weights with which the gate's kernel answers where positions are; None if it does not."""
    device = positions.device
    if not is_ready(device) or positions.dtype != torch.float32:
        return None
    weights = weights_of(occupancy)
    if weights is None or weights.facts.device != device:  # torch names the mismatch
        return None
    compare = functools.partial(compare_gate, occupancy, weights)
    return weights if _passes("gate", "gate", occupancy, weights, compare) else None


def _passes(
    name: str, kind: str, owner: nn.Module, weights: GateWeights, compare: Callable[[], None]
) -> bool:
    """Whether a kernel has passed a comparison with these weights, now or before.

    A kernel that does not is switched off, and the log says so.
    """
    if _passed[kind].get(owner) is weights:
        return True

    def passes() -> bool:
        compare()
        return True

    if attempt(name, passes, weights.facts.device) is None:
        return False
    if not _passed[kind]:
        _log.info("the fused %s answers on %s", kind, weights.facts.device)
    _passed[kind][owner] = weights
    return True


def _gate_decisions(weights: GateWeights, positions: Tensor) -> Tensor:
    from leco_plugin.samplers.kernels.gate_kernel import gate_decisions

    return gate_decisions(weights, positions)


def _march_kept(cache: CellCache, weights: GateWeights, candidates: Candidates) -> Samples:
    from leco_plugin.samplers.kernels.march_kernel import march_kept

    return march_kept(cache, weights, candidates)


def compare_gate(occupancy: nn.Module, weights: GateWeights) -> None:
    """ValueError if the gate's kernel decides otherwise than `Occupancy.query`."""
    positions = _places(weights, COMPARED)
    kept = _gate_decisions(weights, positions)
    o = occupancy.query(positions)  # type: ignore[operator]
    by_twin = o >= weights.facts[10]
    wrong = int((_is_far(o, weights) & (kept != by_twin)).sum())
    if wrong > _most_otherwise(int(by_twin.sum())):
        raise ValueError(f"it decides otherwise about {wrong} of {COMPARED} positions")


def compare_march(
    occupancy: nn.Module, cache: CellCache, weights: GateWeights, growing: bool
) -> None:
    """ValueError if the march's kernel keeps other candidates than `marching.march` on rays of
    unequal lengths, or in another order; where the step is `growing`, it is another kernel."""

    def occupied(positions: Tensor) -> Tensor:
        decided, left_open = cache.decide(positions)
        o = occupancy.query(positions.index_select(0, left_open))  # type: ignore[operator]
        return decided.index_put_((left_open,), o >= weights.facts[10])

    origins = _places(weights, RAYS)
    directions = torch.nn.functional.normalize(_places(weights, RAYS) - origins.flip(0), dim=-1)
    rule = March(float(weights.facts[3]) / 48.0, 1.0 / 64.0 if growing else 0.0)
    t_maxs = torch.linspace(
        0.0, STEPS * rule.step_size, RAYS, dtype=origins.dtype, device=origins.device
    )
    rays = Rays(origins, directions, torch.zeros_like(t_maxs), t_maxs)
    ours = _march_kept(cache, weights, number(rays, rule))
    theirs = marching.march(rays, rule, occupied, cache.near)
    if wrong := _count_differing(occupancy, weights, rays, rule.step_size, ours, theirs):
        raise ValueError(f"it keeps otherwise {wrong} of {RAYS * STEPS} candidates")


def _count_differing(
    occupancy: nn.Module,
    weights: GateWeights,
    rays: Rays,
    step_size: float,
    ours: Samples,
    theirs: Samples,
) -> int:
    """How many candidates only one of the two keeps, away from the threshold; 0 for a few."""
    numbers, others = _numbers(ours, step_size), _numbers(theirs, step_size)
    if bool((numbers[1:] <= numbers[:-1]).any()):
        return len(numbers)
    single = [
        torch.stack(list(map(torch.Tensor.double, samples)))[:, ~torch.isin(those, these)]
        for samples, those, these in ((ours, numbers, others), (theirs, others, numbers))
    ]
    ray_indices, t_starts, t_ends = torch.cat(single, dim=1)
    which = ray_indices.long()
    middles = ((t_starts + t_ends) * 0.5).float()[:, None]
    positions = rays.origins[which] + rays.directions[which] * middles
    o = occupancy.query(positions)  # type: ignore[operator]
    wrong = int(_is_far(o, weights).sum())
    return wrong if wrong > _most_otherwise(len(others)) else 0


def _most_otherwise(kept: int) -> int:
    """Decisions that may differ where the twin keeps so many."""
    return max(2, int(OTHERWISE * kept))


def _numbers(samples: Samples, step_size: float) -> Tensor:
    """One number for each sample, in the order of rays and distance; roundings leave it alone."""
    ray_indices, t_starts, t_ends = samples
    starts, ends = ((t * (16.0 / step_size)).round().long() for t in (t_starts, t_ends))
    return (ray_indices << 40) + (starts << 20) + ends


def _places(weights: GateWeights, count: int) -> Tensor:
    """Positions in the gate's cube and a little beyond, [count, 3]; always the same ones."""
    generator = torch.Generator("cpu").manual_seed(0)
    unit = torch.rand(count, 3, device="cpu", generator=generator) * 2.4 - 1.2
    return weights.facts[:3] + weights.facts[3] * unit.to(weights.facts)


def _is_far(o: Tensor, weights: GateWeights) -> Tensor:
    return (o - weights.facts[10]).abs() > NEAR_THRESHOLD[weights.half]
