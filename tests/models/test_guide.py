"""The occupancy of a host: its samplers, its checkpoints, its coordinates."""

from __future__ import annotations

import inspect

import pytest
import torch
from ball_occupancy import CENTRE, ball
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.viewer.utils import parse_object
from nerfstudio.viewer.viewer_elements import ViewerElement
from nerfstudio.viewer_legacy.server.viewer_utils import IOChangeException

from leco_plugin.models.guide import Guide
from leco_plugin.samplers import registry
from leco_plugin.samplers.base import Estimator
from leco_plugin.samplers.estimator import LearnedOccupancyEstimator
from leco_plugin.samplers.registry import SamplerSpec

BOX = torch.tensor([-1.0, -1.0, -1.0, 3.0, 4.0, 2.0])
MARCH = {"render_step_size": 0.05, "near_plane": 0.0, "far_plane": 8.0}


@pytest.fixture(autouse=True)
def without_cache(monkeypatch: pytest.MonkeyPatch) -> None:
    """A cell cache takes seconds to build, and is tested where it lives."""

    def refuse(*_: object, **__: object) -> None:
        raise ValueError("no cache in this test")

    monkeypatch.setattr("leco_plugin.samplers.estimator.build_cache", refuse)


@pytest.fixture
def guide() -> Guide:
    made = Guide()
    made.set_occupancy(ball())
    return made


def rays(count: int = 30) -> tuple[torch.Tensor, torch.Tensor]:
    """Rays towards the ball and beside it, from outside its space."""
    generator = torch.Generator().manual_seed(0)
    origins = torch.tensor(CENTRE) + torch.tensor([0.0, 0.0, 4.0])
    aims = torch.tensor(CENTRE) + 1.5 * torch.randn(count, 3, generator=generator)
    directions = torch.nn.functional.normalize(aims - origins, dim=-1)
    return origins.expand(count, 3).contiguous(), directions


def test_a_host_samples_as_with_the_estimator_itself(guide: Guide):
    own = LearnedOccupancyEstimator(ball()).eval()
    origins, directions = rays()
    expected = own.sampling(origins, directions, **MARCH)
    found = guide.estimator(BOX).eval().sampling(origins, directions, **MARCH)
    assert len(expected[0]) > 0
    for a, b in zip(found, expected):
        assert torch.equal(a, b)


def test_the_signature_is_that_of_estimators(guide: Guide):
    stand_in = inspect.signature(type(guide.estimator(BOX)).sampling)
    assert stand_in == inspect.signature(Estimator.sampling)


def test_a_host_in_other_coordinates_gets_the_same_samples(guide: Guide):
    turn, scale = torch.linalg.qr(torch.randn(3, 3))[0], 2.5
    turn = turn * torch.det(turn)
    shift = torch.tensor([0.3, -1.0, 0.2])
    origins, directions = rays()
    expected = guide.estimator(BOX).eval().sampling(origins, directions, **MARCH)
    # where the host sees what the occupancy sees at p: (p - shift) turned back and shrunk
    host_origins, host_directions = (origins - shift) @ turn / scale, directions @ turn
    guide.set_occupancy(ball(), torch.cat([scale * turn, shift[:, None]], dim=1))
    shorter = {name: value / scale for name, value in MARCH.items()}
    found = guide.estimator(BOX).eval().sampling(host_origins, host_directions, **shorter)
    assert abs(len(found[0]) - len(expected[0])) <= 2  # rounding at the ball's edge
    both = min(len(found[0]), len(expected[0]))
    torch.testing.assert_close(
        found[1][:both].sort()[0] * scale, expected[1][:both].sort()[0], atol=0.06, rtol=0.0
    )


def test_boxes_and_cells_are_answered_in_the_hosts_coordinates(guide: Guide):
    shift = torch.tensor([0.3, -1.0, 0.2])
    here = guide.estimator(BOX)
    boxes, opacities, decisions = here.aabbs, here.occs, here.binaries
    guide.set_occupancy(ball(), torch.cat([2.0 * torch.eye(3), shift[:, None]], dim=1))
    there = guide.estimator(BOX)
    torch.testing.assert_close(there.aabbs, (boxes - shift.repeat(2)) / 2.0)
    torch.testing.assert_close(there.occs, opacities, atol=0.02, rtol=0.0)
    assert (there.binaries != decisions).float().mean() < 1e-3
    assert 0.01 < decisions.float().mean() < 0.5


def wall_behind(x: float):
    """A host's density: opaque beyond the plane z < x of the occupancy's coordinates."""
    return lambda positions: 1e3 * (positions[:, 2:] < x).float()


@pytest.mark.parametrize("scale", [1.0, 2.0], ids=["same frame", "another"])
@pytest.mark.parametrize("sampler", ["learned-occupancy", "dense"])
def test_rendering_front_to_back_hands_out_nothing_behind_a_wall(scale: float, sampler: str):
    made = Guide(sampler, front_to_back=True)
    made.set_occupancy(ball(), torch.cat([scale * torch.eye(3), torch.zeros(3, 1)], dim=1))
    middle = CENTRE[2] / scale
    estimator = made.estimator(BOX / scale, density_fn=wall_behind(middle)).eval()
    origins, _ = rays(1)
    march = {name: value / scale for name, value in MARCH.items()}

    def depths() -> torch.Tensor:
        down = torch.tensor([[0.0, 0.0, -1.0]])
        _, starts, ends = estimator.sampling(origins / scale, down, **march)
        return origins[0, 2] / scale - 0.5 * (starts + ends)

    step = march["render_step_size"]
    assert middle - 2 * step < depths().min() < middle
    estimator.train()
    assert depths().min() < middle - 0.5 / scale


def test_a_proposal_host_in_other_coordinates_samples_the_ball(guide: Guide):
    turn = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    origins, directions = rays(3)
    directions = torch.nn.functional.normalize(torch.tensor(CENTRE) - origins, dim=-1)
    guide.set_occupancy(ball(), torch.cat([turn, torch.zeros(3, 1)], dim=1))
    bundle = RayBundle(
        origins=origins @ turn,
        directions=directions @ turn,
        pixel_area=torch.ones(3, 1),
        nears=torch.zeros(3, 1),
        fars=torch.full((3, 1), 8.0),
    )
    samples, _, _ = guide.proposal(num_samples=16).eval()(bundle)
    inside = (samples.frustums.get_positions() @ turn.T - torch.tensor(CENTRE)).norm(dim=-1)
    assert (inside < 1.3).float().mean() > 0.9


def test_without_an_occupancy_one_line_says_how_to_get_one():
    with pytest.raises(RuntimeError, match=r"occupancy\.path"):
        Guide().estimator(BOX).sampling(*rays(), **MARCH)


def test_the_viewer_looks_for_its_elements_before_there_is_an_occupancy():
    host = torch.nn.Module()
    host.guide = Guide()
    host.grid, host.chooser = host.guide.estimator(BOX), host.guide.proposal(num_samples=3)
    assert parse_object(host, ViewerElement, "Custom Elements") == []


def test_the_viewer_does_not_ask_a_gate_when_it_looks_for_its_elements(guide: Guide):
    host = torch.nn.Module()
    host.guide, host.grid = guide, guide.estimator(BOX)
    parse_object(host, ViewerElement, "Custom Elements")
    assert host.grid._built[0] is None


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


def test_a_host_in_half_precision_moves_its_rays_in_full(guide: Guide):
    turn = torch.linalg.qr(torch.randn(3, 3))[0]
    guide.set_occupancy(ball(), torch.cat([turn * torch.det(turn), torch.ones(3, 1)], dim=1))
    origins, directions = rays()
    expected = guide.estimator(BOX).sampling(origins, directions, **MARCH)
    with torch.autocast("cpu", torch.bfloat16):
        found = guide.estimator(BOX).sampling(origins, directions, **MARCH)
    assert torch.equal(found[1], expected[1])
