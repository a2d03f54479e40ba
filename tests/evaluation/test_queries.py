"""Claims about counting what fields are asked, and updates of grids."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
import torch
from ball_occupancy import ball
from nerfstudio.cameras.rays import Frustums, RaySamples
from nerfstudio.fields.base_field import Field
from nerfstudio.fields.density_fields import HashMLPDensityField
from torch import Tensor, nn

from leco_plugin.evaluation.queries import GridUpdates, count_queries
from leco_plugin.models import front_to_back
from leco_plugin.models.encodings import EncodingConfig
from leco_plugin.models.field import FieldConfig, HMoEField
from leco_plugin.models.rendering import Intervals
from leco_plugin.occupancy import Occupancy
from leco_plugin.samplers.grid import OccupancyGridEstimator


class Fog(Field):
    """The same density everywhere."""

    def get_density(self, ray_samples: RaySamples) -> tuple[Tensor, Tensor]:
        density = torch.ones(*ray_samples.frustums.shape, 1)
        return density, density

    def get_outputs(self, ray_samples: RaySamples, density_embedding: Any = None) -> dict[Any, Any]:
        return {}


class ThickFog(Fog):
    """Asks the field that it is made from."""

    def get_density(self, ray_samples: RaySamples) -> tuple[Tensor, Tensor]:
        density, features = super().get_density(ray_samples)
        return 2.0 * density, features


class Plain(nn.Module):
    """A field that is simply called."""

    def forward(self, positions: Tensor, noise: float = 0.0) -> Tensor:
        return positions[..., 0] + noise


class Host(nn.Module):
    def __init__(self, field: nn.Module, proposals: int = 0) -> None:
        super().__init__()
        self.field = field
        self.proposal_networks = nn.ModuleList(
            HashMLPDensityField(
                torch.tensor([[-1.0] * 3, [1.0] * 3]),
                num_levels=1,
                log2_hashmap_size=4,
                implementation="torch",
            )
            for _ in range(proposals)
        )
        self.density_fns = [network.density_fn for network in self.proposal_networks]


def samples(rays: int, each: int) -> RaySamples:
    ones = torch.ones(rays, each, 3)
    return RaySamples(frustums=Frustums(ones, ones, ones[..., :1], ones[..., :1], ones[..., :1]))


def hmoe() -> HMoEField:
    encoding = EncodingConfig("hash", levels=1, log2_table=4)
    return HMoEField(FieldConfig(encoding, appearance_dim=0), num_images=1)


def ask(field: HMoEField, count: int) -> None:
    field.density(torch.zeros(count, 3), torch.ones(count).long(), torch.ones(count))


def test_shading_pruning_and_updating_are_all_counted() -> None:
    host = Host(Fog())
    with count_queries(host) as queries:
        host.field(samples(5, 7))
        host.field.density_fn(torch.zeros(11, 3))
        host.field.get_density(samples(2, 3))
    assert queries == {"field": 35 + 11 + 6, "proposal": 0, "learning": 0, "gate": 0}


def test_proposal_networks_are_counted_apart() -> None:
    host = Host(Fog(), proposals=2)
    with count_queries(host) as queries:
        host.field(samples(5, 7))
        for density_fn in host.density_fns:
            density_fn(torch.zeros(4, 6, 3))
    assert queries == {"field": 35, "proposal": 48, "learning": 0, "gate": 0}


def test_a_field_that_asks_its_parent_class_or_is_called_is_asked_once() -> None:
    host, called = Host(ThickFog()), Host(Plain())
    host.other = Fog()  # type: ignore[assignment]
    with count_queries(host) as queries:
        host.field.density_fn(torch.zeros(9, 3))
    assert queries["field"] == 9
    with count_queries(called) as queries:
        called.field(torch.zeros(13, 3), noise=1.0)
        called.field(torch.zeros(4, 6, 3))
    assert queries["field"] == 13 + 24


def test_a_field_that_learns_for_a_host_is_counted_apart() -> None:
    own = hmoe()
    with count_queries(Host(own)) as queries:
        ask(own, 3)
        ask(hmoe(), 4)
    assert queries == {"field": 3, "proposal": 0, "learning": 4, "gate": 0}


def test_a_frozen_gate_is_counted_once_whatever_is_asked_of_it() -> None:
    occupancy = ball()
    with count_queries(Host(Plain())) as queries:
        occupancy.query(torch.zeros(3, 3))
        occupancy.occupied(torch.zeros(4, 3))
    assert queries == {"field": 0, "proposal": 0, "learning": 0, "gate": 7}


def test_afterwards_nothing_is_counted_and_the_classes_are_as_they_were() -> None:
    own = {owner: dict(vars(owner)) for owner in (Fog, ThickFog, Plain, HMoEField, Occupancy)}
    host = Host(ThickFog())
    with pytest.raises(RuntimeError), count_queries(host) as queries:
        raise RuntimeError
    host.field(samples(5, 7))
    ask(hmoe(), 4)
    assert queries == {"field": 0, "proposal": 0, "learning": 0, "gate": 0}
    assert all(dict(vars(owner)) == before for owner, before in own.items())


class GridHost(torch.nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.grid = OccupancyGridEstimator([-1.0, -1.0, -1.0, 1.0, 1.0, 1.0], 8, 1)


def ball_density(positions: torch.Tensor) -> torch.Tensor:
    return (positions.norm(dim=-1) < 0.5).float()


@pytest.mark.parametrize(
    ("step", "said", "warming_up"),
    [(255, {}, True), (256, {}, False), (63, {"warmup_steps": 64}, True)],
)
def test_the_host_says_how_long_it_warms(step: int, said: dict[str, Any], warming_up: bool) -> None:
    host = GridHost()
    updates = GridUpdates(host)
    assert updates.grids == [host.grid] and updates.warming_up is None
    host.grid.update_every_n_steps(step=step, occ_eval_fn=ball_density, **said)
    assert updates.warming_up is warming_up


@pytest.mark.parametrize(("share", "asked_cells"), [(0.05, 512), (0.07, 256)])
def test_a_warm_up_ends_with_a_sixteenth_of_the_run(share: float, asked_cells: int) -> None:
    host, asked = GridHost(), []

    def nothing(positions: torch.Tensor) -> torch.Tensor:
        asked.append(len(positions))
        return torch.zeros(len(positions))

    updates = GridUpdates(host, {0: 0.0, 32: share}.__getitem__)
    for step in (0, 32):
        host.grid.update_every_n_steps(step=step, occ_eval_fn=nothing)
    assert asked[0] == 512 and asked[1] <= asked_cells
    assert updates.warming_up is (asked[1] == 512) is (asked_cells == 512)


def test_updates_are_made_and_their_time_is_counted() -> None:
    host = GridHost()
    updates = GridUpdates(host)
    host.grid.update_every_n_steps(0, ball_density)
    assert 0 < int(host.grid.binaries.sum()) < 512 and updates.clock.seconds > 0.0
    nothing = GridUpdates(torch.nn.Linear(2, 2))
    assert nothing.grids == [] and nothing.warming_up is None and nothing.clock.seconds == 0.0


def test_a_grid_that_does_not_say_when_it_is_warm_is_updated_all_the_same() -> None:
    calls: list[int] = []
    host = GridHost()
    vars(host.grid)["update_every_n_steps"] = lambda step, occ_eval_fn: calls.append(step)
    updates = GridUpdates(host)
    host.grid.update_every_n_steps(3, ball_density)
    assert calls == [3] and updates.warming_up is None


def test_what_c_asks_of_a_field_is_counted_by_its_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    field, seen = hmoe(), Intervals(torch.zeros(7).long(), torch.zeros(7), torch.ones(7))
    monkeypatch.setattr(front_to_back, "shade_natively", lambda *_: (None, seen))
    shade = front_to_back.shade_natively
    with count_queries(Host(field)) as queries:
        front_to_back.shade_natively(SimpleNamespace(field=field))  # type: ignore[call-arg, arg-type]
    assert queries["field"] == 7
    assert front_to_back.shade_natively is shade
