"""Where hosts keep their samplers, and what is taken away when those are swapped."""

from __future__ import annotations

import copy

import nerfacc
import pytest
import torch
from nerfstudio.model_components.ray_samplers import (
    ProposalNetworkSampler,
    UniformSampler,
    VolumetricSampler,
)
from torch import nn

from leco_plugin.hosts.guide import Guide
from leco_plugin.hosts.guided import GuidedHost
from leco_plugin.hosts.guided_start import OccupancyConfig
from leco_plugin.hosts.seams import no_density, swap_sampler
from leco_plugin.hosts.stand_ins import GuidedEstimator, GuidedProposal
from leco_plugin.scenes.input_error import InputError


class Host(nn.Module):
    """What a seam is sought in."""

    def get_param_groups(self) -> dict[str, list[nn.Parameter]]:
        return {}

    def get_loss_dict(self, *_: object) -> dict[str, torch.Tensor]:
        return {}


class Packed(Host):
    def __init__(self) -> None:
        super().__init__()
        self.gatekeeper = nerfacc.OccGridEstimator(torch.tensor([-1.0] * 3 + [1.0] * 3), 8, 1)
        self.walker = VolumetricSampler(self.gatekeeper)


@pytest.mark.parametrize("sampler", ["dense", "occupancy-grid"])
@pytest.mark.parametrize("options", [{}, {"levels": 2}], ids=["as the host", "as asked"])
def test_a_grid_has_as_many_boxes_as_the_hosts_own_unless_asked_otherwise(
    sampler: str, options: dict[str, int]
):
    host = Packed()
    own = nerfacc.OccGridEstimator(torch.tensor([-1.0] * 3 + [1.0] * 3), 8, 3)
    host.gatekeeper = host.walker.occupancy_grid = own
    swap_sampler(host, Guide(sampler, options))
    expected = own.aabbs[options.get("levels", 3) - 1]
    assert torch.equal(host.gatekeeper.bounds(), expected)


class Network(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.layer = nn.Linear(3, 1)

    def density_fn(self, positions: torch.Tensor) -> torch.Tensor:
        return self.layer(positions)


class Proposal(Host):
    def __init__(self) -> None:
        super().__init__()
        self.field = Network()
        self.scouts = nn.ModuleList([Network(), Network()])
        self.alone = Network()
        self.opinions = [net.density_fn for net in (*self.scouts, self.alone)]
        self.chooser = ProposalNetworkSampler(
            num_nerf_samples_per_ray=21, initial_sampler=UniformSampler(single_jitter=True)
        )

    def get_param_groups(self) -> dict[str, list[nn.Parameter]]:
        return {
            "scouts": list(self.scouts.parameters()),
            "fields": list(self.field.parameters()),
        }

    def get_loss_dict(self, *_: object) -> dict[str, torch.Tensor]:
        constant = torch.tensor(0.5)
        return {"rgb": self.field.layer.weight.sum(), "scouting": constant}


class GuidedProposals(GuidedHost, Proposal):
    """A proposal host as it is guided."""


def test_a_packed_host_is_found_under_any_name(guide: Guide):
    host = Packed()
    assert swap_sampler(host, guide) == "packed"
    assert isinstance(host.gatekeeper, GuidedEstimator)
    assert host.walker.occupancy_grid is host.gatekeeper
    assert not any("occs" in name for name in host.state_dict())


def test_a_proposal_host_keeps_nothing_of_its_networks(guide: Guide):
    host = GuidedProposals()
    host.begin_guided(guide, OccupancyConfig())
    assert isinstance(host.chooser, GuidedProposal)
    assert host.chooser._options["num_samples"] == 21
    assert host.chooser._options["single_jitter"] is True
    assert isinstance(host.chooser._options["initial_sampler"], UniformSampler)
    assert not [*host.scouts.parameters(), *host.alone.parameters()]
    assert host.opinions == [no_density] * 3
    assert set(host.get_param_groups()) == {"fields"}
    assert {name.split(".")[0] for name in host.state_dict()} == {"field", "leco_guide"}


class WithStages(Proposal):
    """Holds its own methods in a list, too."""

    def __init__(self) -> None:
        super().__init__()
        self.stages = [self.get_loss_dict, self.get_param_groups]


def test_a_list_of_the_hosts_own_methods_is_none_of_proposal_densities(guide: Guide):
    host = WithStages()
    before = list(host.stages)
    swap_sampler(host, guide)
    assert host.stages == before
    assert host.opinions == [no_density] * 3


class WithHeads(Proposal):
    """Holds methods of other parts in lists, too; its field has another name."""

    def __init__(self) -> None:
        super().__init__()
        self.semantics = nn.Linear(3, 4)
        self.heads = [self.semantics.forward]
        self.matter, self.field = self.field, None
        self.opinions.append(self.matter.density_fn)
        self.alike = (self.scouts[0].density_fn, self.matter.density_fn)

    def get_param_groups(self) -> dict[str, list[nn.Parameter]]:
        return {
            "semantics": list(self.semantics.parameters()),
            "matter": list(self.matter.parameters()),
            "scouts": list(self.scouts.parameters()),
        }


def test_a_list_of_other_methods_stays_and_so_does_a_field_among_the_densities(guide: Guide):
    host = WithHeads()
    semantics, matter, heads = host.semantics, host.matter, list(host.heads)
    swap_sampler(host, guide)
    assert host.semantics is semantics and host.heads == heads
    assert host.matter is matter and host.opinions == [no_density] * 3 + [matter.density_fn]
    assert host.alike == (no_density, matter.density_fn)
    assert not [*host.scouts.parameters(), *host.alone.parameters()]


def test_a_field_that_is_listed_first_stays(guide: Guide):
    host = WithHeads()
    host.opinions.insert(0, host.opinions.pop())
    matter = host.matter
    swap_sampler(host, guide)
    assert host.matter is matter and host.opinions == [matter.density_fn] + [no_density] * 3


def test_networks_of_several_groups_alike_need_an_adapter(guide: Guide):
    host = WithHeads()
    host.opinions, host.alike = [host.matter.density_fn, host.scouts[0].density_fn], ()
    with pytest.raises(InputError, match=r"several parameter groups.* HostAdapter"):
        swap_sampler(host, guide)


class Boxless(nerfacc.OccGridEstimator):
    """An estimator whose boxes are called otherwise."""

    def __init__(self) -> None:
        super().__init__(torch.tensor([-1.0] * 3 + [1.0] * 3), 8, 1)
        del self.aabbs


def test_an_estimator_without_boxes_needs_an_adapter(guide: Guide):
    host = Packed()
    host.gatekeeper = host.walker.occupancy_grid = Boxless()
    with pytest.raises(ValueError, match="has no sampler that could be swapped"):
        swap_sampler(host, guide)


def test_a_loss_that_reaches_nothing_is_left_out_in_training_only(guide: Guide):
    host = GuidedProposals()
    host.begin_guided(guide, OccupancyConfig())
    assert set(host.train().get_loss_dict({}, {})) == {"rgb"}
    assert set(host.eval().get_loss_dict({}, {})) == {"rgb", "scouting"}


def test_a_copy_of_a_guided_host_is_a_host_of_its_own(guide: Guide):
    host = GuidedProposals()
    host.begin_guided(guide, OccupancyConfig())
    copied = copy.deepcopy(host)
    assert copied.leco_guide is not guide and copied.chooser._guide[0] is copied.leco_guide
    with torch.no_grad():
        host.field.layer.weight.fill_(torch.nan)  # what happens to one does not reach the other
    with pytest.raises(FloatingPointError):
        host.get_loss_dict({}, {})
    assert bool(copied.get_loss_dict({}, {})["rgb"].isfinite())


def test_a_grid_has_nothing_for_a_proposal_host():
    with pytest.raises(ValueError, match="occupancy-grid"):
        swap_sampler(Proposal(), Guide("occupancy-grid"))


def test_a_host_without_a_seam_is_told_what_was_looked_for(guide: Guide):
    with pytest.raises(ValueError, match=r"OccGridEstimator.*ProposalNetworkSampler.*HostAdapter"):
        swap_sampler(Host(), guide)


class SamplesWith(Host):
    """A host that cuts its rays itself and takes any estimator."""

    def sample_with(self, estimator: nn.Module | None) -> None:
        self.estimator = estimator


def test_a_host_that_takes_any_estimator_is_given_one_without_a_box(guide: Guide):
    host = SamplesWith()
    assert swap_sampler(host, guide) == "sample-with"
    assert isinstance(host.estimator, GuidedEstimator)
    dense = SamplesWith()
    swap_sampler(dense, Guide("dense"))
    far = torch.tensor([[50.0, 0.0, 0.0]])
    samples = dense.estimator.sampling(far, torch.eye(3)[:1], far_plane=1.0, render_step_size=0.1)
    assert len(samples[0]) == 10


def test_such_a_host_has_a_grid_of_its_own():
    with pytest.raises(ValueError, match="sampling occupancy-grid"):
        swap_sampler(SamplesWith(), Guide("occupancy-grid"))
