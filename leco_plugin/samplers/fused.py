"""Whether a fused kernel answers instead of its torch twin; the one place that imports kernels.

They run where Triton and CUDA are. A kernel that is missing or fails is said once, in one line of
the log, and the twin answers from then on.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar
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

Answer = TypeVar("Answer")
PlanFn = Callable[[], Candidates]


class _Switch:
    """Whether kernels are used in this process; off for good once one has failed."""

    def __init__(self) -> None:
        self.off = False


_switch = _Switch()
_packed: WeakKeyDictionary[nn.Module, tuple[object, GateWeights | None]] = WeakKeyDictionary()


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
    if weights is None:
        return None

    def ask() -> Tensor:
        from leco_plugin.samplers.gate_kernel import gate_decisions

        return gate_decisions(weights, positions)

    return tried("gate", ask)


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
    if weights is None or weights.padded_width > WIDEST_MARCH:
        return None
    candidates = plan()
    if candidates.counts.dtype != torch.float32 or not growth_fits(candidates):
        return None

    def ask() -> Samples:
        from leco_plugin.samplers.march_kernel import march_kept

        return march_kept(cache, weights, candidates)

    return tried("march", ask)


def growth_fits(candidates: Candidates) -> bool:
    """Whether the powers of a growing step fit their table."""
    step_size, cone_angle = candidates.step_size, candidates.cone_angle
    return cone_angle <= 0.0 or powers_needed(step_size, cone_angle) <= MOST_POWERS


def tried(name: str, kernel: Callable[[], Answer]) -> Answer | None:
    """What a kernel answers, or None after it failed, which the log says once."""
    try:
        return kernel()
    except (torch.cuda.OutOfMemoryError, TooManyCandidates):
        raise
    except Exception as error:  # noqa: BLE001 - a compiler and its driver raise what they like
        _switch.off = True
        reason = next(iter(str(error).splitlines()), "") or type(error).__name__
        _log.warning("the fused %s does not run, torch answers in its place: %s", name, reason)
        return None


def weights_of(occupancy: nn.Module) -> GateWeights | None:
    """The packed weights of an occupancy, packed anew when it has changed; None if none fit."""
    state = (*occupancy.parameters(), *occupancy.buffers())
    now = tuple((value.data_ptr(), _version(value)) for value in state)
    found = _packed.get(occupancy)
    if found is None or found[0] != now:
        device = state[0].device if state else torch.device("cpu")
        reason = why_not(occupancy, _most_width(occupancy, device))
        if reason is not None and found is None:  # else it has been said
            _log.info("no fused gate: %s", reason)
        found = now, gate_weights(occupancy) if reason is None else None
        _packed[occupancy] = found
    return found[1]


def _most_width(occupancy: Any, device: torch.device) -> int:
    if device.type != "cuda":
        return MOST_WIDTH
    if getattr(occupancy, "precision", None) == "float32":
        return MOST_WIDTH_FLOAT32
    return MOST_WIDTH if torch.cuda.get_device_capability(device)[0] == 9 else MOST_WIDTH_BUT_HOPPER


def _version(value: Any) -> int:
    return 0 if value.is_inference() else value._version
