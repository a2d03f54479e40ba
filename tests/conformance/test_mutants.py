"""The kit fails every sampler and guided method that breaks a rule, for that rule, by that name."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from typing import Any

import pytest
from conformance import batch_mutants, estimator_mutants, host_mutants, proposal_mutants
from conformance.estimator_mutants import MUTANTS
from conformance.host_mutants import HOST_MUTANTS, METHODS, SOUND
from conformance.mutant_plugin import write_distribution
from conformance.proposal_mutants import PROPOSAL_MUTANTS
from nerfstudio.configs.method_configs import all_methods
from nerfstudio.plugins.registry import discover_methods

from leco_plugin.conformance import host_training  # noqa: F401 (registers the checks of hosts)
from leco_plugin.conformance.cases import RULES, cases_of, check, pairs
from leco_plugin.conformance.rules import Rule, apply
from leco_plugin.hosts import seams
from leco_plugin.samplers import registry

PARALLEL = ("two-processes", "two-processes-step-alike")
IN_THIS_PROCESS = tuple(rule for rule in RULES if rule.name not in PARALLEL)
TWO_PROCESSES = tuple(rule for rule in RULES if rule.name in PARALLEL)
BY_SEAM: dict[str, Any] = {
    "estimator": {
        rule: family + batch_mutants.MUTANTS.get(rule, ()) for rule, family in MUTANTS.items()
    },
    "proposal": PROPOSAL_MUTANTS,
    "host": HOST_MUTANTS,
}
FAMILIES = estimator_mutants, batch_mutants, proposal_mutants, host_mutants
ALSO: Any = {mutant: rules for family in FAMILIES for mutant, rules in family.ALSO.items()}
ALL = [
    pytest.param(getattr(mutant, "__name__", mutant), {rule} | ALSO.get(mutant, set()), id=rule)
    for by_rule in BY_SEAM.values()
    for rule, mutants in by_rule.items()
    for mutant in mutants
]


@pytest.fixture(autouse=True, scope="module")
def plugin(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """The mutants are installed."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(write_distribution(tmp_path_factory.mktemp("mutants")))
        found, _ = discover_methods()
        for name in METHODS:  # nerfstudio looks for methods once a process
            patch.setitem(all_methods, name, found[name])
        for module in (registry, seams):  # nobody is installed any more, and each look takes 30 ms
            patch.setattr(module, "foreign_entries", functools.cache(module.foreign_entries))
        yield


def failing(name: str, rules: tuple[Rule, ...]) -> dict[str, str]:
    """Names of the rules that a sampler or a method breaks, and what was found."""
    verdicts = [apply(rule, case) for rule, case in pairs(cases_of(name)) if rule in rules]
    return {verdict.rule.name: verdict.problem for verdict in verdicts if not verdict.passed}


@pytest.mark.parametrize("name", ["Sound", "SoundProposal", *SOUND, "Unguided"])
def test_what_mutants_are_made_of_keeps_all_rules(name: str) -> None:
    assert failing(name, IN_THIS_PROCESS) == {}


@pytest.mark.parametrize(("mutant", "broken"), [one for one in ALL if one.id not in PARALLEL])
def test_a_mutant_fails_its_rule_and_no_other(mutant: str, broken: set[str]) -> None:
    problems = failing(mutant, IN_THIS_PROCESS)
    assert set(problems) == broken, problems


@pytest.mark.xdist_group("forks")
@pytest.mark.usefixtures("forks")
@pytest.mark.parametrize(("mutant", "broken"), [one for one in ALL if one.id in PARALLEL])
def test_a_mutant_that_only_two_processes_show_fails_there(mutant: str, broken: set[str]) -> None:
    problems = failing(mutant, TWO_PROCESSES)
    assert set(problems) == broken
    assert mutant not in METHODS or "field." in problems["two-processes-step-alike"]
    assert failing(mutant, IN_THIS_PROCESS) == {}


@pytest.mark.parametrize("seam", BY_SEAM)
def test_every_rule_has_a_mutant_at_every_seam(seam: str) -> None:
    assert list(BY_SEAM[seam]) == [rule.name for rule in RULES if seam in rule.checks]


def test_a_verdict_says_what_was_found_why_it_matters_and_what_to_do() -> None:
    verdict = next(v for v in check("KeepsAll") if not v.passed)
    line = verdict.line()
    assert line.startswith("FAIL  estimator  skips-only-what-it-may: ")
    assert "samples lie where the occupancy is empty, the first at [" in line
    assert verdict.rule.reason in line and verdict.rule.remedy in line
    assert "\n" not in line
