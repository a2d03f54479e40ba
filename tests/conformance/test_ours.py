"""Our samplers and guided methods keep the rules that we ask of others', in the sizes in use."""

from __future__ import annotations

from importlib.metadata import EntryPoint

import nerfacc
import pytest
from nerfstudio.model_components.ray_samplers import ProposalNetworkSampler

from leco_plugin.conformance import host_training  # noqa: F401 (registers the checks of hosts)
from leco_plugin.conformance.cases import (
    RULES,
    cases_of,
    check,
    host_cases,
    pairs,
    sampler_cases,
)
from leco_plugin.conformance.rules import Case, Rule, Verdict, apply
from leco_plugin.hosts.proposal import LearnedOccupancySampler
from leco_plugin.samplers import nerfacc_cpu, registry
from leco_plugin.samplers.registry import SamplerSpec
from leco_plugin.scenes.input_error import InputError

HOST_RULES = [rule for rule in RULES if "host" in rule.checks]
SAMPLER_RULES = [rule for rule in RULES if rule not in HOST_RULES]


def in_forks(test):
    """Marks a test whose rules start two processes."""
    return pytest.mark.xdist_group("forks")(pytest.mark.usefixtures("forks")(test))


def kept(cases: list[Case], rules: list[Rule] = SAMPLER_RULES) -> list[Verdict]:
    """The verdicts on cases, which keep all rules."""
    verdicts = [apply(rule, case) for rule, case in pairs(cases) if rule in rules]
    assert [verdict.line() for verdict in verdicts if not verdict.passed] == []
    return verdicts


@in_forks
@pytest.mark.slow  # `learned-occupancy` builds cell caches, also in two processes
@pytest.mark.parametrize(("seam", "rules"), [("estimator", 14), ("proposal", 12)])
def test_the_learned_occupancy_keeps_every_rule(seam, rules):
    cases = [case for case in sampler_cases("learned-occupancy") if case.seam == seam]
    assert len(kept(cases)) == rules


@in_forks
@pytest.mark.parametrize(
    ("name", "seam"),
    [("dense", "estimator"), ("occupancy-grid", "estimator"), ("dense-proposal", "proposal")],
)
def test_the_baselines_keep_every_rule(name, seam):
    assert {verdict.seam for verdict in kept(sampler_cases(name))} == {seam}


@pytest.mark.parametrize("features", ["hash", "vm", "k-planes", "grid"])
def test_a_gate_on_other_features_is_known_too(features):
    (case, _) = sampler_cases(f"learned-occupancy-{features}")
    kept([case], [rule for rule in SAMPLER_RULES if rule.name == "skips-only-what-it-may"])


def nerfaccs_grid(aabb, occupancy):
    nerfacc_cpu.install()
    return nerfacc.OccGridEstimator(aabb, resolution=64)


def nerfstudios_proposals(**_):
    return ProposalNetworkSampler((256, 96), num_nerf_samples_per_ray=48)


@pytest.mark.parametrize(
    "spec",
    [
        SamplerSpec("nerfacc's", estimator=nerfaccs_grid),
        SamplerSpec("nerfstudio's", proposal=nerfstudios_proposals),
    ],
    ids=["nerfacc", "nerfstudio"],
)
def test_those_whose_places_are_taken_keep_the_rules_too(spec, monkeypatch):
    monkeypatch.setitem(registry.OURS, "stock", spec)
    rules = [rule for rule in SAMPLER_RULES if rule.name != "two-processes"]
    try:
        kept(sampler_cases("stock"), rules)
    finally:
        nerfacc_cpu.uninstall()


def test_rules_have_names_of_their_own_and_say_why_and_what_to_do():
    assert len({rule.name for rule in SAMPLER_RULES}) == len(SAMPLER_RULES)
    for rule in SAMPLER_RULES:
        assert rule.reason.endswith(".") and rule.remedy.endswith(".")
        assert rule.checks


def without_jitter(occupancy, num_samples, initial_sampler, frame=None):
    return LearnedOccupancySampler(occupancy, num_samples)


def ends(aabb, occupancy):
    raise SystemExit(3)


@pytest.mark.parametrize(
    ("spec", "said"),
    [
        (
            SamplerSpec("typo", estimator="leco_plugin.samplers.registry:build_dens"),
            "the estimator of sampler 'crooked' cannot be built: ValueError: .*build_dens",
        ),
        (
            SamplerSpec("no jitter", proposal=without_jitter, needs_occupancy=True),
            "the proposal of sampler 'crooked' cannot be built: TypeError: .*'single_jitter'",
        ),
        (
            SamplerSpec("ends", estimator=ends),
            "the estimator of sampler 'crooked' cannot be built: SystemExit",
        ),
    ],
    ids=["typo", "no jitter", "ends"],
)
def test_what_cannot_be_built_is_said_once_and_not_rule_by_rule(spec, said, monkeypatch):
    monkeypatch.setitem(registry.OURS, "crooked", spec)
    with pytest.raises(ValueError, match=said):
        cases_of("crooked")


def test_a_registered_sampler_that_cannot_be_loaded_is_no_unknown_name(monkeypatch):
    entry = EntryPoint("broken", "no_such_module:SPEC", registry.GROUP)
    monkeypatch.setattr(registry, "entry_points", lambda group: [entry])
    with (
        pytest.warns(UserWarning, match="'broken' is left out"),
        pytest.raises(ValueError, match="'broken' is registered, but no_such_module:SPEC cannot"),
    ):
        cases_of("broken")


def test_a_sampler_that_serves_no_seam_is_refused(monkeypatch):
    monkeypatch.setitem(registry.OURS, "hollow", SamplerSpec("nothing"))
    with pytest.raises(ValueError, match="builds neither an estimator nor a proposal"):
        sampler_cases("hollow")
    with pytest.raises(ValueError, match="no sampler 'hollov'"):
        sampler_cases("hollov")


@in_forks
@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        "leco-ngp",
        "leco-nerfacto",
        "leco-switch-nerf",
        # the host of `leco-switch-nerf` with another routing, and swapped instead of guided
        pytest.param("leco-mega-nerf", marks=pytest.mark.long),
        pytest.param("switch-nerf", marks=pytest.mark.long),
    ],
)
def test_our_hosts_keep_every_rule(name: str) -> None:
    verdicts = list(check(name))
    assert [verdict.line() for verdict in verdicts if not verdict.passed] == []
    assert [verdict.rule for verdict in verdicts] == HOST_RULES


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
