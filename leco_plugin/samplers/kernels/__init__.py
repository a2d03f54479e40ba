"""Fused kernels: which are on, and (`fused`) when one for CUDA replaces its torch twin.

Modules named `*_kernel` import Triton and are imported by `fused` alone.
"""

from __future__ import annotations

import os

VARIABLE = "LECO_KERNELS_OFF"
"""The environment variable that turns kernels off, for a comparison or on a suspicion. Unlike an
option it reaches every process that a command starts, and loops that know no options of ours."""
NAMES = frozenset({"gate", "march", "experts", "native"})
"""What it may name. The march holds the gate, and is off with it; `native` is C on a CPU."""


def kernels_off() -> frozenset[str]:
    """Names of the kernels that are not to be used, separated by commas or spaces; `all` is all.
    ValueError if there is no kernel of such a name."""
    names = frozenset(os.environ.get(VARIABLE, "").replace(",", " ").split())
    if unknown := sorted(names - NAMES - {"all"}):
        known = ", ".join(sorted(NAMES))
        raise ValueError(f"{VARIABLE} names {', '.join(unknown)}; it takes {known}, or all")
    return NAMES if "all" in names else names
