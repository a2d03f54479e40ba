"""Whether a fused kernel answers instead of its torch twin; the one place that imports kernels.

They run where Triton and CUDA are. A kernel that is missing, fails, or decides otherwise than its
twin is said once, in one line of the log, and the twin answers from then on.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any, NamedTuple, TypeVar
from weakref import WeakKeyDictionary

import torch
from torch import Tensor, nn

from leco_plugin.samplers.cache import CellCache
from leco_plugin.samplers.gate_weights import (
    MOST_WIDTH,
    MOST_WIDTH_BUT_HOPPER,
    MOST_WIDTH_FLOAT32,
    GateWeights,
    gate_weights,
    why_not,
)
from leco_plugin.samplers.growth import MOST_POWERS, powers_needed
from leco_plugin.samplers.marching import Candidates, Samples, TooManyCandidates

_log = logging.getLogger(__name__)

WIDEST_MARCH = 128
"""Compiled, a march around a wider gate spills its registers; the twin asks the fused gate then."""

CHECKED, MOST_OTHERWISE = 4096, 20
"""Positions that a gate's kernel is tried on before it is trusted, and of how many it may decide
otherwise than the twin; a steep gate turns single roundings into decisions."""
NEAR_THRESHOLD = {True: 0.02, False: 2e-4}
"""Distance of o(x) from the threshold within which a decision is not counted; by whether products
are bfloat16."""

Answer = TypeVar("Answer")
PlanFn = Callable[[], Candidates]


class _Switch:
    """Whether kernels are used in this process; off for good once one has failed."""

    def __init__(self) -> None:
        self.off = False


class _Packed(NamedTuple):
    """The weights of an occupancy, and what they were packed from."""

    state: tuple[Tensor, ...]
    """Held, so that nothing else comes to lie at the same address."""
    now: tuple[tuple[int, int], ...]
    """Address and version of each."""
    weights: GateWeights | None


_switch = _Switch()
_packed: WeakKeyDictionary[nn.Module, _Packed] = WeakKeyDictionary()
_checked: WeakKeyDictionary[nn.Module, GateWeights] = WeakKeyDictionary()


@contextmanager
def twins_only() -> Iterator[None]:
    """Within it torch answers everything: what kernels are compared with."""
    before, _switch.off = _switch.off, True
    try:
        yield
    finally:
        _switch.off = before


def ready(device: torch.device) -> bool:
    """Whether kernels may be tried on this device."""
    return device.type == "cuda" and torch.version.cuda is not None and not _switch.off


def decisions(occupancy: nn.Module, positions: Tensor) -> Tensor | None:
    """The fused gate's decisions about positions [N, 3], bool [N]; None: ask the torch twin.

    Args:
        occupancy: an `Occupancy` on the device of the positions.
    """
    if not ready(positions.device) or positions.dtype != torch.float32:
        return None
    weights = weights_of(occupancy)
    if weights is None or not trusted(occupancy, weights):
        return None

    def ask() -> Tensor:
        from leco_plugin.samplers.gate_kernel import gate_decisions

        return gate_decisions(weights, positions)

    return tried("gate", ask, positions.device)


def trusted(occupancy: nn.Module, weights: GateWeights) -> bool:
    """Whether the kernel decides as the twin with these weights; tried once, on random positions.

    A kernel that does not is switched off, and the log says so.
    """
    if _checked.get(occupancy) is weights:
        return True

    def compare() -> bool:
        from leco_plugin.samplers.gate_kernel import gate_decisions

        centre, half_extent = weights.facts[:3], weights.facts[3]
        unit = torch.rand(CHECKED, 3, generator=torch.Generator().manual_seed(0)) * 2.4 - 1.2
        positions = centre + half_extent * unit.to(centre)
        o, threshold = occupancy.query(positions), weights.facts[10]  # type: ignore[operator]
        kept = gate_decisions(weights, positions)
        far = (o - threshold).abs() > NEAR_THRESHOLD[weights.half]
        wrong = int((far & (kept != (o >= threshold))).sum())
        if wrong > MOST_OTHERWISE:
            raise ValueError(f"it decides otherwise about {wrong} of {CHECKED} positions")
        return True

    if tried("gate", compare, weights.facts.device) is None:
        return False
    _checked[occupancy] = weights
    return True


def march(
    occupancy: object, cache: CellCache | None, device: torch.device, plan: PlanFn
) -> Samples | None:
    """The fused march of an estimator's rays; None: ask the torch twin.

    Without cells every candidate would ask the gate in both launches: the twin asks it once.

    Args:
        occupancy: an `Occupancy`, or anything else that an estimator asks.
        cache: the cells of its decisions.
        device: where the rays are.
        plan: numbers the candidates of the rays, without waiting for the device.

    Raises:
        ValueError: as `marching.march`.
    """
    if cache is None or not ready(device) or not isinstance(occupancy, nn.Module):
        return None
    weights = weights_of(occupancy)
    if weights is None or weights.padded_width > WIDEST_MARCH or not trusted(occupancy, weights):
        return None
    candidates = plan()
    if candidates.counts.dtype != torch.float32 or not growth_fits(candidates):
        return None

    def ask() -> Samples:
        from leco_plugin.samplers.march_kernel import march_kept

        return march_kept(cache, weights, candidates)

    return tried("march", ask, device)


def growth_fits(candidates: Candidates) -> bool:
    """Whether the powers of a growing step fit their table."""
    step_size, cone_angle = candidates.step_size, candidates.cone_angle
    return cone_angle <= 0.0 or powers_needed(step_size, cone_angle) <= MOST_POWERS


def tried(name: str, kernel: Callable[[], Answer], device: torch.device) -> Answer | None:
    """What a kernel answers, or None after it failed, which the log says once."""
    try:
        with on(device):
            return kernel()
    except (torch.cuda.OutOfMemoryError, TooManyCandidates):
        raise
    except Exception as error:  # noqa: BLE001 - a compiler and its driver raise what they like
        _switch.off = True
        reason = next(iter(str(error).splitlines()), "") or type(error).__name__
        _log.warning("the fused %s does not run, torch answers in its place: %s", name, reason)
        return None


def on(device: torch.device) -> AbstractContextManager[object]:
    """Triton launches on the current device, wherever the tensors are."""
    return torch.cuda.device(device) if device.type == "cuda" else nullcontext()


def weights_of(occupancy: nn.Module) -> GateWeights | None:
    """The packed weights of an occupancy, packed anew when it has changed; None if none fit."""
    state = (*occupancy.parameters(), *occupancy.buffers())
    now = tuple((value.data_ptr(), _version(value)) for value in state)
    found = _packed.get(occupancy)
    if found is None or found.now != now:
        device = state[0].device if state else torch.device("cpu")
        reason = why_not(occupancy, _most_width(occupancy, device))
        if reason is not None and found is None:  # else it has been said
            _log.info("no fused gate: %s", reason)
        held = tuple(value.detach() for value in state)
        found = _Packed(held, now, gate_weights(occupancy) if reason is None else None)
        _packed[occupancy] = found
    return found.weights


def _most_width(occupancy: Any, device: torch.device) -> int:
    if device.type != "cuda":
        return MOST_WIDTH
    if getattr(occupancy, "precision", None) == "float32":
        return MOST_WIDTH_FLOAT32
    return MOST_WIDTH if torch.cuda.get_device_capability(device)[0] == 9 else MOST_WIDTH_BUT_HOPPER


def _version(value: Any) -> int:
    return 0 if value.is_inference() else value._version
