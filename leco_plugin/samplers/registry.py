"""Samplers by name, ours and those of other packages (entry-point group `leco_plugin.samplers`).

An entry point names a `SamplerSpec`. Ours are listed here too, so that a checkout that is not
installed knows them, and modules are imported when a sampler is built, not when it is listed.
"""

from __future__ import annotations

import importlib
import inspect
import warnings
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from importlib.metadata import EntryPoint, entry_points
from typing import Any, TypeVar

from torch import nn

from leco_plugin.names import known_names, unknown_name
from leco_plugin.scenes.input_error import one_line

Kind = TypeVar("Kind")

GROUP = "leco_plugin.samplers"
GIVEN = {"aabb", "occupancy", "num_samples", "initial_sampler", "single_jitter", "frame"}
"""What hosts give a builder; whatever else it takes is an option."""
HOSTS = {"estimator": "packed", "proposal": "proposal"}
"""The hosts that call each of the two kinds of samplers."""


@dataclass(frozen=True)
class SamplerSpec:
    """How to build a sampler for each of the two kinds of hosts."""

    description: str
    """One line for lists and help."""
    estimator: Callable[..., nn.Module] | str | None = None
    """Builds what a packed host calls (`base.Estimator`), or "module:attribute" of such. Called
    with `aabb` (the host's box, [6], which is that of its grid and not the scene's end),
    `occupancy` (None when there is none) and options, which are its other parameters. One that asks
    no gate and has a parameter `levels` is given the number of the host's nested boxes, unless the
    options set it."""
    proposal: Callable[..., nn.Module] | str | None = None
    """Builds what a proposal host calls (`proposal.LearnedOccupancySampler`), likewise. Called with
    `occupancy`, with the host's `num_samples`, `initial_sampler` and `single_jitter`, and where
    the host's coordinates are not those of the occupancy with `frame`, [3, 4], which takes them
    there."""
    needs_occupancy: bool = False
    """Whether it asks a frozen gate."""
    gate_encoding: str | None = None
    """The kind of features that this gate must be on; None is any."""
    check_options: Mapping[str, Any] = field(default_factory=dict)
    """Options with which `leco check` builds it: what saves time and changes no decision."""


DENSE = SamplerSpec(
    description="every candidate is kept: the reference; option levels doubles the box",
    estimator="leco_plugin.samplers.registry:build_dense",
)
DENSE_PROPOSAL = SamplerSpec(
    description="samples spread as a host spreads its first ones: the reference; option samples",
    proposal="leco_plugin.hosts.proposal:DenseSampler",
)
OCCUPANCY_GRID = SamplerSpec(
    description="Instant-NGP's occupancy grid as in nerfacc; options resolution, levels",
    estimator="leco_plugin.samplers.registry:build_grid",
)
LEARNED_OCCUPANCY = SamplerSpec(
    description="a frozen gate with a cell cache; options cache_bytes, for packed hosts tolerance, "
    "for proposal hosts num_candidates",
    estimator="leco_plugin.samplers.registry:build_learned",
    proposal="leco_plugin.hosts.proposal:LearnedOccupancySampler",
    needs_occupancy=True,
    check_options={"cache_bytes": 1 << 16},
)


LEARNED_OCCUPANCY_HASH, LEARNED_OCCUPANCY_VM, LEARNED_OCCUPANCY_K_PLANES, LEARNED_GRID = (
    replace(
        LEARNED_OCCUPANCY,
        description=f"learned occupancy whose gate is on {features}, for comparison",
        gate_encoding=kind,
    )
    for features, kind in (
        ("hash-grid features", "hash"),
        ("TensoRF's vector-matrix features", "vm"),
        ("K-planes features", "k-planes"),
        ("one grid of features", "grid"),
    )
)
OURS = {
    "dense": DENSE,
    "dense-proposal": DENSE_PROPOSAL,
    "occupancy-grid": OCCUPANCY_GRID,
    "learned-occupancy": LEARNED_OCCUPANCY,
    "learned-occupancy-hash": LEARNED_OCCUPANCY_HASH,
    "learned-occupancy-vm": LEARNED_OCCUPANCY_VM,
    "learned-occupancy-k-planes": LEARNED_OCCUPANCY_K_PLANES,
    "learned-occupancy-grid": LEARNED_GRID,
}


def samplers() -> dict[str, SamplerSpec]:
    """All samplers by name. A broken entry point of another package is left out with a warning."""
    return {**foreign_entries(GROUP, SamplerSpec, frozenset(OURS)), **OURS}


def build_estimator(name: str, **options: Any) -> nn.Module:
    """What a packed host calls; see `SamplerSpec.estimator` for the options.

    Raises:
        ValueError: there is no such sampler, it does not serve packed hosts or has no such option,
            or it needs an occupancy and none is given, or one whose gate is on other features.
    """
    return _build(name, "estimator", options)


def build_proposal(name: str, **options: Any) -> nn.Module:
    """What a proposal host calls; options and errors as for `build_estimator`."""
    return _build(name, "proposal", options)


def sampler_spec(name: str) -> SamplerSpec:
    """The sampler of that name, or the spec at "module:attribute", registered or not. ValueError if
    there is none, or what is registered under it is of no use."""
    if ":" in name:
        found: object = _load(name)
        if not isinstance(found, SamplerSpec):
            raise ValueError(f"{name} is a {type(found).__name__}, not a SamplerSpec")
        return found
    if name in OURS:  # to look for others is to read what every installed package says of itself
        return OURS[name]
    known = samplers()
    if name not in known:
        why = why_left_out(name)
        if why is not None:
            raise ValueError(f"the sampler {name!r} is registered, but {why}")
        raise ValueError(unknown_name("sampler", name, sorted(known)))
    return known[name]


def spec_for(name: str, kind: str, options: Collection[str]) -> SamplerSpec:
    """The sampler of that name, which serves hosts that call this kind and takes these options.
    ValueError if there is none, or it does not."""
    spec = sampler_spec(name)
    if getattr(spec, kind) is None:
        raise ValueError(f"sampler {name!r} has nothing for {HOSTS[kind]} hosts")
    refuse_unknown_options(name, options, (kind,))
    return spec


def _build(name: str, kind: str, options: dict[str, Any]) -> nn.Module:
    spec, occupancy = spec_for(name, kind, options.keys() - GIVEN), options.get("occupancy")
    if spec.needs_occupancy:
        if occupancy is None:
            raise ValueError(f"sampler {name!r} needs an occupancy")
        check_gate(name, getattr(getattr(occupancy, "gate", None), "config", None))
    build = _load(getattr(spec, kind))
    for needed, parameter in (_parameters(build) or {}).items():
        if parameter.default is parameter.empty and needed not in options:
            raise ValueError(f"sampler {name!r} needs {needed}")
    return build(**options)


def _load(builder: Callable[..., nn.Module] | str) -> Callable[..., nn.Module]:
    """A builder, imported where a spec gives "module:attribute"."""
    if not isinstance(builder, str):
        return builder
    module, _, attribute = builder.partition(":")
    try:
        made: Callable[..., nn.Module] = getattr(importlib.import_module(module), attribute)
    except (Exception, SystemExit) as error:  # noqa: BLE001 (whatever a foreign module raises)
        said = one_line(error) or type(error).__name__
        raise ValueError(f"{builder} cannot be imported: {said}") from None
    return made


def _parameters(builder: Callable[..., nn.Module]) -> dict[str, inspect.Parameter] | None:
    """Parameters of a builder by name; None if it takes any, or they are unknown."""
    try:
        found = inspect.signature(builder).parameters
    except ValueError:  # a class of a compiled extension
        return None
    if any(each.kind is each.VAR_KEYWORD for each in found.values()):
        return None
    by_name = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)
    return {name: each for name, each in found.items() if each.kind in by_name}


def has_option(name: str, kind: str, option: str) -> bool:
    """Whether the builder of a sampler, for hosts that call this kind, names such a parameter.
    ValueError as of `sampler_spec`."""
    builder = getattr(sampler_spec(name), kind)
    return builder is not None and option in (_parameters(_load(builder)) or {})


def refuse_unknown_options(
    name: str, options: Collection[str], kinds: tuple[str, ...] = tuple(HOSTS)
) -> None:
    """ValueError if there is no such sampler, or it does not take one of these options in hosts
    that call one of these kinds. A builder that takes any (`**options`) is not checked."""
    spec = sampler_spec(name)
    if not options:
        return
    builders = [getattr(spec, kind) for kind in kinds]
    takes = [_parameters(_load(builder)) for builder in builders if builder is not None]
    if None in takes:
        return
    known = {option for parameters in takes if parameters for option in parameters} - GIVEN
    if unknown := sorted(set(options) - known):
        here = f" in {HOSTS[kinds[0]]} hosts" if len(kinds) == 1 else ""
        others = known_names(unknown[0], sorted(known))
        raise ValueError(f"the sampler {name!r} has no option {unknown[0]!r}{here}; {others}")


def check_gate(name: str, config: Any) -> None:
    """ValueError if there is no such sampler, or it asks gates on other features than those of this
    config (`GateConfig`; None is no gate)."""
    wanted = sampler_spec(name).gate_encoding
    found = config.encoding.kind if config is not None else "no"
    if wanted not in (None, found):
        raise ValueError(
            f"sampler {name!r} asks a gate on {wanted} features, and this occupancy's is on "
            f"{found} features; learn one with `ns-train leco-occupancy "
            f"--pipeline.model.sizes.gate.encoding.kind {wanted} --data SCENE`"
        )


def build_dense(aabb: Any = None, occupancy: Any = None, levels: int = 1) -> nn.Module:
    """`base.DenseEstimator` in the host's box, or in the outermost of so many nested ones."""
    from leco_plugin.samplers.base import DenseEstimator
    from leco_plugin.samplers.boxes import nested_boxes

    return DenseEstimator(aabb if aabb is None else nested_boxes(aabb, levels)[-1])


def build_grid(
    aabb: Any, occupancy: Any = None, resolution: int = 128, levels: int = 1
) -> nn.Module:
    """`grid.OccupancyGridEstimator` whose innermost level is the host's box."""
    from leco_plugin.samplers.grid import OccupancyGridEstimator

    return OccupancyGridEstimator(aabb, resolution, levels)


def build_learned(
    occupancy: Any, aabb: Any = None, cache_bytes: int = 1 << 20, tolerance: float = 1e-4
) -> nn.Module:
    """`estimator.LearnedOccupancyEstimator`; it needs no box, so the host's is left aside: that of
    its grid would cut a scene off. Build the class itself to clip rays to a box."""
    from leco_plugin.samplers.estimator import LearnedOccupancyEstimator

    return LearnedOccupancyEstimator(occupancy, cache_bytes=cache_bytes, tolerance=tolerance)


def foreign_entries(
    group: str, kind: type[Kind], ours: frozenset[str] = frozenset()
) -> dict[str, Kind]:
    """Loads the entries of a group, which name things of this kind, but for `ours`; a broken one,
    or one whose name is taken, is left out with a warning."""
    loaded: dict[str, Kind] = {}
    for entry in entry_points(group=group):
        if entry.name in ours and entry.value.startswith("leco_plugin."):
            continue
        taken = entry.name in ours or entry.name in loaded
        found = f"{entry.value} has a name that is taken" if taken else _load_entry(entry, kind)
        if isinstance(found, kind):
            loaded[entry.name] = found
        else:
            warnings.warn(f"{group} {entry.name!r} is left out: {found}", stacklevel=3)
    return loaded


def why_left_out(name: str) -> str | None:
    """What is wrong with a registered sampler; None where nothing is, or none has this name."""
    for entry in entry_points(group=GROUP):
        found = _load_entry(entry, SamplerSpec) if entry.name == name else None
        if isinstance(found, str):
            return found
    return None


def _load_entry(entry: EntryPoint, kind: type[Kind]) -> Kind | str:
    """What an entry names, or in one line why that is of no use."""
    try:
        found = entry.load()
    except (Exception, SystemExit) as error:  # noqa: BLE001 (whatever a foreign module raises)
        said = ": ".join([type(error).__name__, *str(error).splitlines()[:1]])
        return f"{entry.value} cannot be loaded: {said}"
    if isinstance(found, kind):
        return found
    return f"{entry.value} is of type {type(found).__name__}, where a {kind.__name__} is expected"
