"""Ray marching: which steps along a ray are kept, by one rule for every sampler of packed hosts."""

from leco_plugin.samplers.marching.candidates import (
    Candidates,
    TooManyCandidates,
    check_longest,
    number,
    plan,
)
from leco_plugin.samplers.marching.rule import NearFn, OccupiedFn, Samples, join, keep, march

__all__ = [
    "Candidates",
    "NearFn",
    "OccupiedFn",
    "Samples",
    "TooManyCandidates",
    "check_longest",
    "join",
    "keep",
    "march",
    "number",
    "plan",
]
