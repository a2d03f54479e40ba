"""Which rules apply to a name, and applying them: what the command and the tests share."""

from __future__ import annotations

from collections.abc import Iterator

from leco_plugin.conformance.estimator_case import EstimatorCase
from leco_plugin.conformance.proposal_case import ProposalCase
from leco_plugin.conformance.rule import Case, Rule, Verdict, apply
from leco_plugin.conformance.sampler_rules import SAMPLER_RULES
from leco_plugin.samplers.registry import sampler_spec


def sampler_cases(name: str) -> list[Case]:
    """A registered sampler at each seam that it serves.

    Raises:
        ValueError: there is no such sampler, or it serves no seam.
    """
    spec = sampler_spec(name)
    cases: list[Case] = []
    if spec.estimator is not None:
        cases.append(EstimatorCase(name))
    if spec.proposal is not None:
        cases.append(ProposalCase(name))
    if not cases:
        raise ValueError(f"sampler {name!r} builds neither an estimator nor a proposal sampler")
    return cases


def pairs(cases: list[Case], rules: tuple[Rule, ...]) -> list[tuple[Rule, Case]]:
    """Each rule with each case at whose seam it has something to check."""
    return [(rule, case) for case in cases for rule in rules if case.seam in rule.checks]


def check_sampler(name: str) -> Iterator[Verdict]:
    """Applies the rules for samplers one after another.

    Raises:
        ValueError: at once, as `sampler_cases`.
    """
    found = pairs(sampler_cases(name), SAMPLER_RULES)
    return (apply(rule, case) for rule, case in found)
