"""Where a host asks for samples, and how that is replaced (entry-point group `leco_plugin.hosts`).

A seam is found by its type, wherever the host keeps it and whatever it calls it. A host that
samples in another way brings a `HostAdapter`.
"""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from torch import nn

from leco_plugin.hosts.guide import Guide
from leco_plugin.samplers.base import Estimator
from leco_plugin.samplers.nerfacc_cpu import install_for
from leco_plugin.samplers.registry import foreign_entries
from leco_plugin.scenes.input_error import InputError

if TYPE_CHECKING:
    from nerfstudio.models.base_model import Model

GROUP = "leco_plugin.hosts"


@dataclass(frozen=True)
class HostAdapter:
    """How the sampler of a kind of host is replaced.

    Of a model with the attributes `my_sampler` and `my_grid`:

        def swap(host, guide):
            host.my_sampler = guide.estimator(host.scene_box.aabb.flatten())
            del host.my_grid

        ADAPTER = HostAdapter("my grid", lambda host: isinstance(host, MyModel), swap)

    and in that package's `pyproject.toml`:

        [project.entry-points."leco_plugin.hosts"]
        my-method = "my_package.adapting:ADAPTER"
    """

    description: str
    """What it looks for, for the error that nothing was found."""
    fits: Callable[[Model], bool]
    """Whether a model is such a host."""
    swap: Callable[[Model, Guide], None]
    """Puts `guide.estimator(...)` or `guide.proposal(...)` in the place of the host's own sampling,
    and takes away what that makes superfluous."""


def adapters() -> dict[str, HostAdapter]:
    """All adapters by name, those of other packages first."""
    ours = {"sample-with": SAMPLE_WITH, "packed": PACKED, "proposal": PROPOSAL}
    return {**foreign_entries(GROUP, HostAdapter, frozenset(ours)), **ours}


def swap_sampler(host: Model, guide: Guide) -> str:
    """Replaces the host's sampling by the guide's; returns the name of the adapter that did.
    InputError if the host has no seam that any adapter knows."""
    install_for(None)
    known = adapters()
    for name, adapter in known.items():
        if _fits(name, adapter, host):
            adapter.swap(host, guide)
            return name
    looked_for = "; ".join(f"{name}: {adapter.description}" for name, adapter in known.items())
    raise InputError(
        f"{type(host).__name__} has no sampler that could be swapped. Looked for: {looked_for}. "
        f"A package can bring a HostAdapter in the entry-point group {GROUP}: "
        "see help(leco_plugin.hosts.seams.HostAdapter)"
    )


def _fits(name: str, adapter: HostAdapter, host: Model) -> bool:
    """Whether an adapter takes this host; one that cannot tell does not keep others from it."""
    try:
        return adapter.fits(host)
    except Exception as error:  # noqa: BLE001 (whatever a foreign adapter raises)
        warnings.warn(f"{GROUP} {name!r} is left out: {error!r}", stacklevel=3)
        return False


def _sample_with(host: Any, guide: Guide) -> None:
    """Such a host cuts its rays itself, at bounds that it may not know yet: it needs no box."""
    if guide.sampler == "occupancy-grid":
        raise InputError(
            f"{type(host).__name__} makes a grid that fits its bounds itself: with "
            "--pipeline.model.sampling occupancy-grid of the method that is not guided"
        )
    host.sample_with(guide.estimator(None))


SAMPLE_WITH = HostAdapter(
    "a method sample_with(estimator), as switch-nerf has",
    lambda host: callable(getattr(host, "sample_with", None)),
    _sample_with,
)


def replace_module(host: nn.Module, old: nn.Module, new: nn.Module) -> None:
    """Puts `new` wherever the host or a module in it holds `old`."""
    for parent in list(host.modules()):
        for name, child in list(parent._modules.items()):
            if child is old:
                setattr(parent, name, new)


def _estimators(host: nn.Module) -> list[nn.Module]:
    """What marches rays through boxes in a host."""
    from nerfacc.estimators.base import AbstractEstimator
    from nerfacc.estimators.prop_net import PropNetEstimator

    return [
        module
        for module in host.modules()
        if isinstance(module, AbstractEstimator | Estimator)
        and not isinstance(module, PropNetEstimator)
        and len(getattr(module, "aabbs", ())) > 0
    ]


def _swap_packed(host: Model, guide: Guide) -> None:
    for old in _estimators(host):
        boxes: Any = old.aabbs
        # of nested boxes the first is the scene's, and nothing is sampled outside the last
        new = guide.estimator(boxes[0].detach(), boxes[-1].detach(), len(boxes))
        replace_module(host, old, new)


PACKED = HostAdapter(
    "an estimator of nerfacc (OccGridEstimator) that a volumetric sampler asks",
    lambda host: bool(_estimators(host)),
    _swap_packed,
)


def _proposal_samplers(host: nn.Module) -> list[Any]:
    from nerfstudio.model_components.ray_samplers import ProposalNetworkSampler

    return [module for module in host.modules() if isinstance(module, ProposalNetworkSampler)]


def _swap_proposal(host: Model, guide: Guide) -> None:
    for old in _proposal_samplers(host):
        new = guide.proposal(
            num_samples=old.num_nerf_samples_per_ray,
            initial_sampler=old.initial_sampler,
            single_jitter=bool(getattr(old.initial_sampler, "single_jitter", False)),
        )
        replace_module(host, old, new)
    _remove_density_networks(host)
    guide.without_proposals = True


PROPOSAL = HostAdapter(
    "a ProposalNetworkSampler of nerfstudio",
    lambda host: bool(_proposal_samplers(host)),
    _swap_proposal,
)


def no_density(*_: Any, **__: Any) -> None:
    """Stands in a host's list of proposal densities: their number is asked for, not they.
    RuntimeError if it is called after all."""
    raise RuntimeError("a guided host has no proposal networks to ask for a density")


DENSITIES = ("density_fn", "get_density")
"""Names of the methods by which nerfstudio's fields answer with a density."""


def _is_density_of_a_part(item: Any, host: nn.Module) -> bool:
    """Whether this is such a method of a module in the host; its own are for something else."""
    owner = getattr(item, "__self__", None)
    named = getattr(item, "__name__", None) in DENSITIES
    return named and isinstance(owner, nn.Module) and owner is not host


def _density_lists(host: nn.Module) -> Iterator[tuple[str, list[Any] | tuple[Any, ...]]]:
    """Lists of densities of modules in the host, as proposal hosts hand to their sampler."""
    for name, value in vars(host).items():
        listed = isinstance(value, list | tuple) and len(value) > 0
        if listed and all(_is_density_of_a_part(item, host) for item in value):
            yield name, value


def _proposal_networks(host: Model) -> list[nn.Module]:
    """Listed networks but the host's `field`, and but those that another parameter group trains
    than most of them. InputError where no group trains most."""
    listed = (density.__self__ for _, densities in _density_lists(host) for density in densities)
    networks = [each for each in dict.fromkeys(listed) if each is not getattr(host, "field", None)]
    groups = host.get_param_groups()
    group_of = {id(parameter): name for name, group in groups.items() for parameter in group}
    trained = [frozenset(group_of.get(id(p)) for p in each.parameters()) for each in networks]
    counts = Counter(names - {None} for names in trained if names - {None}).most_common(2)
    if len(counts) == 2 and counts[0][1] == counts[1][1]:
        raise InputError(
            f"{type(host).__name__} lists densities of networks in several parameter groups, and "
            "which are its proposal networks is not known: write a HostAdapter (docs/hosts.md)"
        )
    most = counts[0][0] if counts else frozenset()
    return [each for each, names in zip(networks, trained) if names - {None} <= most]


def _remove_density_networks(host: Model) -> None:
    """Drops the proposal networks from memory, state dict and parameter groups. An empty module
    takes their places: a host may go on listing their parameters. The host's `field` stays, and so
    does what is trained in another group."""
    networks = _proposal_networks(host)
    for name, densities in list(_density_lists(host)):
        left = [no_density if each.__self__ in networks else each for each in densities]
        setattr(host, name, type(densities)(left))
    for network in networks:
        replace_module(host, network, nn.Module())
