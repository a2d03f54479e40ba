"""One test a rule and seam: pytest --pyargs leco_plugin.conformance --leco-sampler NAME.

Of a guided host, --leco-method NAME.
"""

from __future__ import annotations

import warnings

import pytest

from leco_plugin.conformance.rules import Broken, Case, Rule, apply

with warnings.catch_warnings():
    warnings.simplefilter("default")  # what nerfstudio warns of at import is no error of theirs
    from leco_plugin.conformance.cases import host_cases, pairs, sampler_cases


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    samplers: list[str] = metafunc.config.getoption("--leco-sampler")
    methods: list[str] = metafunc.config.getoption("--leco-method")
    if not samplers and not methods:
        wanted = "--leco-sampler NAME or --leco-method NAME"
        raise pytest.Collector.CollectError(f"name what to check: {wanted}")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("default")  # no import of theirs is an error, whoever runs this
            cases = [case for name in samplers for case in sampler_cases(name)]
            cases += [case for name in methods for case in host_cases(name)]
    except ValueError as error:
        raise pytest.Collector.CollectError(str(error)) from None
    found = pairs(cases)
    labels = [f"{case.name}-{case.seam}-{rule.name}" for rule, case in found]
    metafunc.parametrize(("rule", "case"), found, ids=labels)


@pytest.mark.filterwarnings("default")
def test_rule(rule: Rule, case: Case) -> None:
    verdict = apply(rule, case)
    if isinstance(verdict.error, Broken):
        pytest.fail(verdict.advice, pytrace=False)
    if verdict.error is not None:
        raise AssertionError(verdict.advice) from verdict.error
