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

from leco_plugin.samplers.cells.cache import CellCache
from leco_plugin.samplers.changes import Seen
from leco_plugin.samplers.kernels.gate_weights import (
    MOST_WIDTH,
    MOST_WIDTH_BUT_HOPPER,
    MOST_WIDTH_FLOAT32,
    GateWeights,
    gate_weights,
    why_not,
)
from leco_plugin.samplers.kernels.off import kernels_off
from leco_plugin.samplers.marching import Candidates, Samples, TooManyCandidates
from leco_plugin.samplers.marching.growth import MOST_POWERS, powers_needed

_log = logging.getLogger(__name__)

WIDEST_MARCH = 128
"""Compiled, a march around a wider gate spills its registers; the twin asks the fused gate then."""

ALL = frozenset({"gate", "march"})

Answer = TypeVar("Answer")
PlanFn = Callable[[], Candidates]


class _Switch:
    """The kernels that are not used in this process; for good once one has failed."""

    def __init__(self) -> None:
        self.off: frozenset[str] = frozenset()


class _Packed(NamedTuple):
    """The weights of an occupancy, and what they were packed from."""

    seen: Seen
    weights: GateWeights | None


_switch = _Switch()
_packed: WeakKeyDictionary[nn.Module, _Packed] = WeakKeyDictionary()
_passed: dict[str, WeakKeyDictionary[nn.Module, GateWeights]] = {
    name: WeakKeyDictionary() for name in ("gate", "march", "march with growing steps")
}
"""The weights with which each kernel passed its trial: of an occupancy, or of its cells."""


@contextmanager
def twins_only() -> Iterator[None]:
    """Within it torch answers everything: what kernels are compared with."""
    before, _switch.off = _switch.off, ALL
    try:
        yield
    finally:
        _switch.off = before


def ready(device: torch.device, name: str = "gate") -> bool:
    """Whether a kernel, `gate` or `march`, may be tried on this device."""
    if device.type != "cuda" or torch.version.cuda is None:
        return False
    return name not in _switch.off and name not in kernels_off()


def decisions(occupancy: nn.Module, positions: Tensor) -> Tensor | None:
    """The fused gate's decisions about positions [N, 3], bool [N]; None: ask the torch twin.

    Args:
        occupancy: an `Occupancy` on the device of the positions.
    """
    if not ready(positions.device) or positions.dtype != torch.float32:
        return None
    weights = weights_of(occupancy)
    if weights is None or weights.facts.device != positions.device:  # torch names the mismatch
        return None
    if not trusted(occupancy, weights):
        return None

    def ask() -> Tensor:
        from leco_plugin.samplers.kernels.gate_kernel import gate_decisions

        return gate_decisions(weights, positions)

    return tried("gate", ask, positions.device)


def trusted(occupancy: nn.Module, weights: GateWeights) -> bool:
    """Whether the gate's kernel decides as the twin with these weights; tried once.

    A kernel that does not is switched off, and the log says so.
    """
    from leco_plugin.samplers.kernels.trials import try_gate

    return _passes("gate", "gate", occupancy, weights, lambda: try_gate(occupancy, weights))


def _passes(
    name: str, kind: str, owner: nn.Module, weights: GateWeights, trial: Callable[[], None]
) -> bool:
    """Whether a kernel has passed a trial with these weights, now or before."""
    if _passed[kind].get(owner) is weights:
        return True

    def passes() -> bool:
        trial()
        return True

    if tried(name, passes, weights.facts.device) is None:
        return False
    if not _passed[kind]:
        _log.info("the fused %s answers on %s", kind, weights.facts.device)
    _passed[kind][owner] = weights
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
    if cache is None or not isinstance(occupancy, nn.Module):
        return None
    if not (ready(device) and ready(device, "march")):
        return None
    weights = weights_of(occupancy)
    if weights is None or weights.facts.device != device or weights.padded_width > WIDEST_MARCH:
        return None
    if not trusted(occupancy, weights):
        return None
    candidates = plan()
    if candidates.counts.dtype != torch.float32 or not growth_fits(candidates):
        return None

    coned = candidates.cone_angle > 0.0
    kind = "march with growing steps" if coned else "march"

    def trial() -> None:
        from leco_plugin.samplers.kernels.trials import try_march

        try_march(occupancy, cache, weights, coned)

    if not _passes("march", kind, cache, weights, trial):
        return None

    def ask() -> Samples:
        from leco_plugin.samplers.kernels.march_kernel import march_kept

        return march_kept(cache, weights, candidates)

    return tried("march", ask, device)


def growth_fits(candidates: Candidates) -> bool:
    """Whether the powers of a growing step fit their table."""
    step_size, cone_angle = candidates.step_size, candidates.cone_angle
    return cone_angle <= 0.0 or powers_needed(step_size, cone_angle) <= MOST_POWERS


def tried(name: str, kernel: Callable[[], Answer], device: torch.device) -> Answer | None:
    """What a kernel answers, or None after it failed, which the log says once.

    Where the gate fails the march, which holds it, is not tried; not the other way round.
    """
    try:
        with on(device):
            return kernel()
    except (torch.cuda.OutOfMemoryError, TooManyCandidates):
        raise
    except Exception as error:  # noqa: BLE001 - a compiler and its driver raise what they like
        _switch.off |= {name, "march"}
        reason = next(iter(str(error).splitlines()), "") or type(error).__name__
        _log.warning("the fused %s does not run, torch answers in its place: %s", name, reason)
        return None


def on(device: torch.device) -> AbstractContextManager[object]:
    """Triton launches on the current device, wherever the tensors are."""
    return torch.cuda.device(device) if device.type == "cuda" else nullcontext()


def weights_of(occupancy: nn.Module) -> GateWeights | None:
    """The packed weights of an occupancy, packed anew when it has changed; None if none fit."""
    found = _packed.get(occupancy)
    if found is None or not found.seen.is_still(occupancy):
        state = (*occupancy.parameters(), *occupancy.buffers())
        device = state[0].device if state else torch.device("cpu")
        reason = _why_not(occupancy, device)
        if reason is not None and found is None:  # else it has been said
            _log.info("no fused gate: %s", reason)
        found = _Packed(Seen(occupancy), gate_weights(occupancy) if reason is None else None)
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
