"""The occupancy of a host: its checkpoints, its sampler, and what is said when there is none."""

from __future__ import annotations

import pytest
import torch
from ball_occupancy import BOX, MARCH, ball, rays
from nerfstudio.viewer_legacy.server.viewer_utils import IOChangeException

from leco_plugin.models.hosts.guide import Guide
from leco_plugin.samplers import registry
from leco_plugin.samplers.registry import SamplerSpec
from leco_plugin.scenes.input_error import InputError

pytestmark = pytest.mark.usefixtures("without_cache")


def test_without_an_occupancy_one_line_says_how_to_get_one():
    with pytest.raises(RuntimeError, match=r"occupancy\.path"):
        Guide().estimator(BOX).sampling(*rays(), **MARCH)


def test_before_there_is_an_occupancy_the_viewer_has_no_picture_and_goes_on():
    with pytest.raises(IOChangeException):
        Guide().proposal(num_samples=3)(None)


def test_an_unknown_sampler_is_named():
    with pytest.raises(ValueError, match="no-such"):
        _ = Guide("no-such").needs_occupancy


def test_a_sampler_without_a_gate_is_built_in_the_hosts_box():
    grid = Guide("occupancy-grid").estimator(BOX)
    torch.testing.assert_close(grid.aabbs[0], BOX)


def test_a_builder_that_asks_no_gate_is_told_so(monkeypatch: pytest.MonkeyPatch):
    def estimator(aabb: torch.Tensor, occupancy: None) -> torch.nn.Module:
        return torch.nn.Identity()

    def proposal(occupancy: None, **options: object) -> torch.nn.Module:
        return torch.nn.Identity()

    spec = SamplerSpec("as documented", estimator=estimator, proposal=proposal)
    monkeypatch.setitem(registry.OURS, "documented", spec)
    guide = Guide("documented")
    assert isinstance(guide.estimator(BOX), torch.nn.Identity)
    assert guide.proposal(num_samples=4)(5) == 5


@pytest.mark.parametrize("already", [False, True], ids=["empty", "with another gate"])
def test_a_checkpoint_brings_its_own_occupancy(guide: Guide, already: bool):
    guide.frame.copy_(2.0 * torch.eye(3, 4))
    fresh = Guide()
    if already:
        fresh.set_occupancy(ball("vm"))
        stand_in = fresh.estimator(BOX)
        stand_in.sampling(*rays(), **MARCH)  # built on the gate that gives way
    fresh.load_state_dict(guide.state_dict())
    probe = torch.rand(500, 3) * 3.0
    assert torch.equal(fresh.the_occupancy().query(probe), ball().query(probe))
    assert torch.equal(fresh.frame, guide.frame)
    assert fresh.the_occupancy().report == ball().report
    if already:
        expected = guide.estimator(BOX).sampling(*rays(), **MARCH)
        assert torch.equal(stand_in.sampling(*rays(), **MARCH)[1], expected[1])


def test_the_state_of_a_host_holds_the_gate_once(guide: Guide):
    host = torch.nn.Module()
    host.guide, host.grid = guide, guide.estimator(BOX)
    host.grid.sampling(*rays(), **MARCH)
    assert all(name.startswith("guide.") for name in host.state_dict())
    assert not any(parameter.requires_grad for parameter in host.parameters())


def test_the_options_of_a_sampler_reach_it(guide: Guide):
    grid = Guide("occupancy-grid", {"resolution": 7, "levels": 2}).estimator(BOX)
    assert grid.binaries.shape == (2, 7, 7, 7)
    own = Guide(options={"cache_bytes": 0})
    own.set_occupancy(ball())
    assert own.estimator(BOX).sampler.cache_bytes == 0
    assert own.proposal(num_samples=3).sampler.estimator.cache_bytes == 0


def test_options_that_a_host_of_its_kind_cannot_use_are_named():
    packed, proposal = Guide(options={"tolerance": 1e-3}), Guide(options={"num_candidates": 9})
    packed.estimator(BOX), proposal.proposal(num_samples=3)
    with pytest.raises(InputError, match="'tolerance' in proposal hosts; there are cache_bytes, "):
        packed.proposal(num_samples=3)
    with pytest.raises(InputError, match="'num_candidates' in packed hosts; there are cache_"):
        proposal.estimator(BOX)


@pytest.mark.parametrize(
    ("sampler", "kind", "options", "said"),
    [
        ("occupancy-grid", "estimator", {"resolution": 0}, "a grid needs whole positive sizes"),
        ("occupancy-grid", "estimator", {"resolution": 0.5}, "a grid needs whole positive sizes"),
        ("dense-proposal", "proposal", {"samples": 0}, "samples"),
    ],
)
def test_an_option_with_which_nothing_can_be_built_is_said_in_a_line_before_the_first_step(
    sampler: str, kind: str, options: dict[str, float], said: str
):
    given = {"aabb": BOX} if kind == "estimator" else {}
    with pytest.raises(InputError, match=f"{sampler}.* cannot be built: .*{said}") as error:
        getattr(Guide(sampler, options), kind)(**given)
    assert "\n" not in str(error.value) and str(options) in str(error.value)
