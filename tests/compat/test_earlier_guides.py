"""Guided runs that an earlier release began are opened, whatever the host calls its own parts."""

from __future__ import annotations

import torch
from ball_occupancy import ball
from torch import nn

from leco_plugin.compat.earlier_guides import read_earlier_guide
from leco_plugin.models.hosts.guide import Guide


def host(of_its_own: nn.Module | None = None) -> nn.Module:
    """A guided host that has no occupancy yet."""
    made = nn.Module()
    made.field, made.leco_guide = nn.Linear(2, 2), Guide()
    if of_its_own is not None:
        made.guide = of_its_own
    read_earlier_guide(made)
    return made


def test_a_guide_is_read_under_the_name_that_it_had():
    begun, now = host(), host()
    begun.leco_guide.set_occupancy(ball(), 2.0 * torch.eye(3, 4))
    state = {name.removeprefix("leco_"): value for name, value in begun.state_dict().items()}
    assert "guide.frame" in state
    now.load_state_dict(state)
    probe = torch.rand(100, 3) * 3.0
    assert torch.equal(now.leco_guide.the_occupancy().query(probe), ball().query(probe))
    assert torch.equal(now.leco_guide.frame, 2.0 * torch.eye(3, 4))
    assert torch.equal(now.field.weight, begun.field.weight)


def test_a_guide_of_the_hosts_own_stays_its_own():
    begun, now = host(nn.Linear(3, 1)), host(nn.Linear(3, 1))
    begun.leco_guide.set_occupancy(ball())
    now.load_state_dict(begun.state_dict())
    assert torch.equal(now.guide.weight, begun.guide.weight)
    assert now.leco_guide.occupancy is not None
