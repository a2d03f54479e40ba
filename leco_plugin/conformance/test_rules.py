"""One test a rule and seam: pytest --pyargs leco_plugin.conformance --leco-sampler NAME."""

from __future__ import annotations

import warnings

import pytest

from leco_plugin.conformance.checking import pairs, sampler_cases
from leco_plugin.conformance.rule import Broken, Case, Rule, apply
from leco_plugin.conformance.sampler_rules import SAMPLER_RULES


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    names: list[str] = metafunc.config.getoption("--leco-sampler")
    if not names:
        raise pytest.Collector.CollectError("name what to check: --leco-sampler NAME")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("default")  # no import of theirs is an error, whoever runs this
            cases = [case for name in names for case in sampler_cases(name)]
    except ValueError as error:
        raise pytest.Collector.CollectError(str(error)) from None
    found = pairs(cases, SAMPLER_RULES)
    labels = [f"{case.name}-{case.seam}-{rule.name}" for rule, case in found]
    metafunc.parametrize(("rule", "case"), found, ids=labels)


@pytest.mark.filterwarnings("default")
def test_rule(rule: Rule, case: Case) -> None:
    verdict = apply(rule, case)
    if isinstance(verdict.error, Broken):
        pytest.fail(verdict.advice, pytrace=False)
    if verdict.error is not None:
        raise AssertionError(verdict.advice) from verdict.error
