"""Edges and numbers of candidates against float64 and against counting them."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from leco_plugin.samplers.marching.edges import candidate_counts, candidate_edges


@pytest.mark.parametrize("cone_angle", [0.0, 0.02])
def test_float32_edges_stay_within_rounding_of_float64(cone_angle):
    t_mins = torch.rand(50, 1) * 0.1
    steps = torch.arange(2000.0)
    edges = candidate_edges(t_mins, steps, 1e-3, cone_angle)
    exact = candidate_edges(t_mins.double(), steps.double(), 1e-3, cone_angle)
    torch.testing.assert_close(edges.double(), exact, rtol=5e-6, atol=1e-7)


@settings(deadline=None)
@given(seed=st.integers(0, 2**16), cone_angle=st.sampled_from([0.0, 0.003]))
def test_the_last_candidate_is_the_last_midpoint_in_front_of_the_end(seed, cone_angle):
    torch.manual_seed(seed)
    t_mins = torch.rand(100)
    t_maxs = t_mins + torch.rand(100) * 5.0
    counts = candidate_counts(t_mins, t_maxs, 0.01, cone_angle)
    edges = candidate_edges(t_mins[:, None], torch.arange(1003.0), 0.01, cone_angle)
    midpoints = (edges[:, :-1] + edges[:, 1:]) * 0.5
    assert counts.equal((midpoints < t_maxs[:, None]).sum(dim=-1).float())
    ends = torch.stack([t_maxs, t_mins - 1.0])
    assert candidate_counts(t_mins, ends, 0.01, cone_angle).equal(
        torch.stack([counts, torch.zeros(100)])
    )
