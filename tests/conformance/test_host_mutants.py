"""The kit fails every guided method that breaks a rule, for that rule and by that name."""

from __future__ import annotations

import functools

import pytest
from conformance.host_mutants import HOST_MUTANTS, METHODS, SOUND
from conformance.mutant_plugin import write_distribution
from nerfstudio.configs.method_configs import all_methods
from nerfstudio.plugins.registry import discover_methods

from leco_plugin.conformance.cases import HOST_RULES, host_cases, pairs
from leco_plugin.conformance.rules import apply
from leco_plugin.hosts import seams
from leco_plugin.samplers import registry

PARALLEL = "two-processes-step-alike"
IN_THIS_PROCESS = tuple(rule for rule in HOST_RULES if rule.name != PARALLEL)
TWO_PROCESSES = tuple(rule for rule in HOST_RULES if rule.name == PARALLEL)
OTHERS = [
    pytest.param(mutant, rule, id=f"{rule}-{mutant}")
    for rule, family in HOST_MUTANTS.items()
    for mutant in family
    if rule != PARALLEL
]


@pytest.fixture(autouse=True, scope="module")
def plugin(tmp_path_factory):
    """The mutants are installed."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(write_distribution(tmp_path_factory.mktemp("mutants")))
        found, _ = discover_methods()
        for name in METHODS:  # nerfstudio looks for methods once a process
            patch.setitem(all_methods, name, found[name])
        for module in (registry, seams):  # nobody is installed any more, and each look takes 30 ms
            patch.setattr(module, "foreign_entries", functools.cache(module.foreign_entries))
        yield


def failing(name: str, rules) -> dict[str, str]:
    """Names of the rules that a method breaks, and what was found."""
    verdicts = [apply(rule, case) for rule, case in pairs(host_cases(name), rules)]
    return {verdict.rule.name: verdict.problem for verdict in verdicts if not verdict.passed}


@pytest.mark.parametrize("name", SOUND)
def test_what_mutants_are_made_of_keeps_all_rules(name):
    assert failing(name, IN_THIS_PROCESS) == {}


@pytest.mark.parametrize(("mutant", "rule"), OTHERS)
def test_a_mutant_fails_its_rule_and_no_other(mutant, rule):
    problems = failing(mutant, IN_THIS_PROCESS)
    assert set(problems) == {rule}, problems


def test_a_mutant_that_only_two_processes_show_fails_there():
    (mutant,) = HOST_MUTANTS[PARALLEL]
    assert "field." in failing(mutant, TWO_PROCESSES)[PARALLEL]
    assert failing(mutant, IN_THIS_PROCESS) == {}


def test_every_rule_has_a_mutant():
    assert list(HOST_MUTANTS) == [rule.name for rule in HOST_RULES]
