"""The occupancy of a host: its checkpoints, its sampler, and what is said when there is none."""

from __future__ import annotations

from importlib.metadata import EntryPoint

import pytest
import torch
from ball_occupancy import BOX, MARCH, ball, rays
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.viewer_legacy.server.viewer_utils import IOChangeException

from leco_plugin.hosts.guide import Guide
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


def test_a_host_that_asks_in_every_step_has_packages_looked_through_once(
    monkeypatch: pytest.MonkeyPatch,
):
    entry = EntryPoint("mine", "leco_plugin.samplers.registry:DENSE", registry.GROUP)
    looks = []

    def entry_points(group: str) -> list[EntryPoint]:
        looks.append(group)
        return [entry]

    monkeypatch.setattr(registry, "entry_points", entry_points)
    guide = Guide("mine")
    assert not any(guide.needs_occupancy for _ in range(3))
    assert looks == [registry.GROUP]


def test_only_a_sampler_that_has_levels_is_given_those_of_the_host(
    monkeypatch: pytest.MonkeyPatch,
):
    def nested(aabb: torch.Tensor, occupancy: None, levels: int = 1) -> torch.nn.Module:
        return torch.nn.ModuleList([torch.nn.Identity()] * levels)

    def other(aabb: torch.Tensor, occupancy: None, **options: object) -> torch.nn.Module:
        return torch.nn.ModuleList([torch.nn.Identity()] * len(options))

    for builder, expected in ((nested, 3), (other, 0)):
        monkeypatch.setitem(registry.OURS, "other", SamplerSpec("one", estimator=builder))
        assert len(Guide("other").estimator(BOX, levels=3)) == expected


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


@pytest.mark.parametrize("below", [False, True], ids=["guide", "watched"])
@pytest.mark.parametrize("more", [False, True], ids=["lacks", "has"])
def test_a_state_of_another_version_is_refused_in_a_line(guide: Guide, below: bool, more: bool):
    extra = guide.get_extra_state()
    held = extra["watched"] if below else extra
    if more:
        held["of_old"] = 3
    else:
        del held[next(reversed(held))]
    fresh = Guide()
    with pytest.raises(InputError, match="another version of leco_plugin: train again") as caught:
        fresh.load_state_dict({**guide.state_dict(), "_extra_state": extra})
    assert "\n" not in str(caught.value) and fresh.occupancy is None


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


def test_seen_backdrops_do_not_depend_on_the_hosts_coordinates():
    """Nor on how long directions are: they carry the scale."""
    turn = 0.5 * torch.tensor([[0.6, 0.8, 0.0], [-0.8, 0.6, 0.0], [0.0, 0.0, 1.0]])
    frame = torch.cat([turn, torch.tensor([[1.0], [2.0], [3.0]])], dim=1)
    pose = torch.tensor([[1.0, 0.0, 0.0, 0.0], [0.0, 0.6, 0.8, 0.0], [0.0, -0.8, 0.6, 2.0]])
    of_occupancy = Cameras(pose[None], 20.0, 20.0, 10.0, 10.0, 20, 20)
    back = torch.linalg.inv(turn)
    place = back @ (pose[:, 3] - frame[:, 3])
    of_host = torch.cat([2.0 * 0.5 * 0.5 * back @ pose[:, :3], place[:, None]], dim=1)
    here, there = Guide(), Guide()
    for guide, cameras, its_frame in (
        (here, of_occupancy, torch.eye(3, 4)),
        (there, Cameras(of_host[None], 20.0, 20.0, 10.0, 10.0, 20, 20), frame),
    ):
        guide.set_occupancy(ball(), its_frame)
        guide.look(cameras)
    torch.testing.assert_close(there.backdrops.limits, here.backdrops.limits)
    directions = torch.nn.functional.normalize(torch.randn(256, 3), dim=-1)
    origins = torch.tensor([[1.0, 1.0, 2.0]]).expand(256, 3)
    lacking = here.lacks_backdrop(origins, directions)
    assert 0 < int(lacking.sum()) < 256
    assert torch.equal(there.lacks_backdrop(origins, 0.5 * directions), lacking)


def test_a_checkpoint_from_before_backdrops_were_noted_shows_them_all(guide: Guide):
    state = {name: value for name, value in guide.state_dict().items() if "backdrops" not in name}
    fresh = Guide()
    fresh.load_state_dict(state)
    assert bool((fresh.backdrops.limits == 2.0).all())
