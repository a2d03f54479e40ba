"""The kit fails every sampler that breaks a rule, for that rule and by that name."""

from __future__ import annotations

import pytest
from conformance import estimator_mutants, proposal_mutants
from conformance.estimator_mutants import MUTANTS
from conformance.mutant_plugin import write_distribution
from conformance.proposal_mutants import PROPOSAL_MUTANTS

from leco_plugin.conformance.cases import SAMPLER_RULES, check, pairs, sampler_cases
from leco_plugin.conformance.rules import apply

IN_THIS_PROCESS = tuple(rule for rule in SAMPLER_RULES if rule.name != "two-processes")
TWO_PROCESSES = tuple(rule for rule in SAMPLER_RULES if rule.name == "two-processes")
ALSO = {**estimator_mutants.ALSO, **proposal_mutants.ALSO}
ALL = [
    pytest.param(mutant, rule, id=f"{rule}-{mutant.__name__}")
    for mutants in (MUTANTS, PROPOSAL_MUTANTS)
    for rule, family in mutants.items()
    for mutant in family
]
PARALLEL = [mutant for mutant in ALL if "two-processes" in str(mutant.id)]
OTHERS = [mutant for mutant in ALL if "two-processes" not in str(mutant.id)]


@pytest.fixture(autouse=True, scope="module")
def plugin(tmp_path_factory):
    """The mutants are installed."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(write_distribution(tmp_path_factory.mktemp("mutants")))
        yield


def failing(name: str, rules) -> dict[str, str]:
    """Names of the rules that a sampler breaks, and what was found."""
    verdicts = [apply(rule, case) for rule, case in pairs(sampler_cases(name), rules)]
    return {verdict.rule.name: verdict.problem for verdict in verdicts if not verdict.passed}


@pytest.mark.parametrize("name", ["Sound", "SoundProposal"])
def test_what_mutants_are_made_of_keeps_all_rules(name):
    assert failing(name, IN_THIS_PROCESS) == {}


@pytest.mark.parametrize(("mutant", "rule"), OTHERS)
def test_a_mutant_fails_its_rule_and_no_other(mutant, rule):
    problems = failing(mutant.__name__, IN_THIS_PROCESS)
    assert set(problems) == {rule} | ALSO.get(mutant, set()), problems


@pytest.mark.parametrize(("mutant", "rule"), PARALLEL)
def test_a_mutant_that_only_two_processes_show_fails_there(mutant, rule):
    assert set(failing(mutant.__name__, TWO_PROCESSES)) == {rule}
    assert failing(mutant.__name__, IN_THIS_PROCESS) == {}


def test_every_rule_has_a_mutant_at_every_seam():
    for seam, mutants in (("estimator", MUTANTS), ("proposal", PROPOSAL_MUTANTS)):
        assert set(mutants) == {rule.name for rule in SAMPLER_RULES if seam in rule.checks}


def test_a_verdict_says_what_was_found_why_it_matters_and_what_to_do():
    verdict = next(v for v in check("KeepsAll") if not v.passed)
    line = verdict.line()
    assert line.startswith("FAIL  estimator  skips-only-what-it-may: ")
    assert "samples lie where the occupancy is empty, the first at [" in line
    assert verdict.rule.reason in line and verdict.rule.remedy in line
    assert "\n" not in line
