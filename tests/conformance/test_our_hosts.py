"""Our guided methods keep the rules that we ask of others', in the sizes in which they are used."""

from __future__ import annotations

import pytest

from leco_plugin.conformance.cases import HOST_RULES, check, host_cases
from leco_plugin.conformance.rules import apply
from leco_plugin.scenes.input_error import InputError


@pytest.mark.slow
@pytest.mark.parametrize("name", ["leco-ngp", "leco-nerfacto", "leco-switch-nerf", "switch-nerf"])
def test_our_hosts_keep_every_rule(name: str) -> None:
    verdicts = list(check(name))
    assert [verdict.line() for verdict in verdicts if not verdict.passed] == []
    assert [verdict.rule for verdict in verdicts] == list(HOST_RULES)


def test_what_learns_the_occupancy_is_no_host() -> None:
    with pytest.raises(InputError, match=r"leco-occupancy is no host: .* Check a guided method"):
        host_cases("leco-occupancy")


def test_a_method_without_a_seam_is_told_what_was_looked_for() -> None:
    with pytest.raises(InputError, match=r"no sampler that could be swapped.*HostAdapter"):
        host_cases("vanilla-nerf")


def test_a_case_goes_back_to_its_own_coordinates() -> None:
    (case,) = host_cases("leco-switch-nerf")
    (rule,) = (rule for rule in HOST_RULES if rule.name == "shades-only-what-is-kept")
    assert apply(rule, case).problem == ""
    assert not case.shared(moved=True).leco_guide.same_frame()
    assert case.shared().leco_guide.same_frame()
