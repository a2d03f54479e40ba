"""Applying a rule: what counts as broken, what is left behind."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from leco_plugin.conformance.estimators import _check_uniform
from leco_plugin.conformance.proposals import all_kept_equals_dense
from leco_plugin.conformance.rules import Broken, Rule, apply, require


class Case:
    """One thing to check."""

    name, seam = "it", "somewhere"

    def __init__(self) -> None:
        self.forgot = 0

    def forget(self) -> None:
        self.forgot += 1


def rule(check) -> Rule:
    return Rule("a-rule", "things break.", "mend it.", {"somewhere": check})


def test_a_rule_that_holds_passes_and_keeps_what_was_built():
    case = Case()
    verdict = apply(rule(lambda case: require(True, "")), case)
    assert verdict.passed and verdict.problem == "" and case.forgot == 0
    assert verdict.line() == "pass  somewhere  a-rule"


def fails(case):
    require(False, "two of\nthree are wrong")


def raises(case):
    raise KeyError("t_min")


def ends(case):
    raise SystemExit("bye")


@pytest.mark.parametrize(
    ("check", "problem"),
    [
        (fails, "two of three are wrong"),
        (raises, f"KeyError: 't_min' (test_rule.py, line {raises.__code__.co_firstlineno + 1})"),
        (ends, f"SystemExit: bye (test_rule.py, line {ends.__code__.co_firstlineno + 1})"),
    ],
)
def test_what_is_found_or_raised_is_told_in_one_line(check, problem):
    case = Case()
    verdict = apply(rule(check), case)
    assert not verdict.passed and case.forgot == 1
    assert verdict.line() == (
        f"FAIL  somewhere  a-rule: {problem}. Why it matters: things break. Remedy: mend it."
    )
    assert json.loads(json.dumps(verdict.to_dict()))["problem"] == problem


def test_an_error_of_a_library_is_told_where_the_code_that_is_checked_asked_for_it():
    verdict = apply(rule(lambda case: torch.nn.Linear(3, 1)(torch.ones(2))), Case())
    assert verdict.problem.endswith(f"(test_rule.py, line {line_of('Linear(3, 1)')})")
    assert apply(rule(lambda: None), Case()).problem.endswith("given")  # nothing of theirs ran


def test_an_error_is_told_where_it_came_up_not_where_that_was_called():
    def looks_up(case):
        return {}["t_min"]

    verdict = apply(rule(lambda case: looks_up(case)), Case())
    assert verdict.problem.endswith(f"(test_rule.py, line {line_of('return {}[')})")


def line_of(text: str) -> int:
    lines = Path(__file__).read_text().splitlines()
    return 1 + next(number for number, line in enumerate(lines) if text in line)


def test_random_numbers_and_gradients_are_as_before():
    def meddles(case):
        torch.manual_seed(5)
        torch.set_grad_enabled(False)

    torch.manual_seed(1)
    expected = torch.rand(3)
    torch.manual_seed(1)
    apply(rule(meddles), Case())
    assert torch.is_grad_enabled()
    assert torch.rand(3).equal(expected)
    with torch.no_grad():
        apply(rule(meddles), Case())
        assert not torch.is_grad_enabled()


@pytest.mark.parametrize("usable, cards", [(True, [0, 1]), (False, [])])
def test_random_numbers_of_all_usable_cards_are_as_before(monkeypatch, usable, cards):
    fork, kept = torch.random.fork_rng, []
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(torch.random, "fork_rng", lambda cards: kept.extend(cards) or fork([]))
    monkeypatch.setattr(torch.cuda, "is_available", lambda: usable)
    assert apply(rule(lambda case: torch.manual_seed(5)), Case()).passed
    assert kept == cards


@pytest.mark.gpu
def test_a_card_draws_the_same_numbers_whatever_a_case_has_seeded():
    torch.manual_seed(1)
    expected = torch.rand(3, device="cuda")
    torch.manual_seed(1)
    apply(rule(lambda case: torch.manual_seed(5)), Case())
    assert torch.rand(3, device="cuda").equal(expected)


def test_shifts_of_neighbours_are_neither_alike_nor_opposite():
    generator = torch.Generator().manual_seed(0)
    _check_uniform(torch.rand(20_000, generator=generator))
    even = torch.linspace(0.0, 1.0, 10_000)[torch.randperm(10_000, generator=generator)]
    _check_uniform(0.039 + (1.0 - 0.039) * even)  # of 10,000 they may be 4 / 100 away
    with pytest.raises(Broken, match="away from uniform"):
        _check_uniform(0.041 + (1.0 - 0.041) * even)
    shares = torch.rand(10_000, generator=generator)
    for other in (shares, 1.0 - shares):
        with pytest.raises(Broken, match="correlate by"):
            _check_uniform(torch.stack([shares, other], dim=1).flatten())


@pytest.mark.parametrize(("low", "high"), [(0.09, 0.91), (0.12, 1.0), (0.0, 0.88)])
def test_a_proposal_sampler_of_its_own_reaches_both_ends_of_each_ray(low, high):
    """One of three rays is sampled from `low` to `high` only."""
    edges = torch.linspace(0.0, 1.0, 9).repeat(3, 1)
    edges[1] = low + (high - low) * edges[1]
    samples = SimpleNamespace(spacing_starts=edges[:, :-1, None], spacing_ends=edges[:, 1:, None])
    case = SimpleNamespace(
        shared=lambda scene: None,
        answer=lambda *given: (samples, [], []),
        needs_occupancy=False,
    )
    if low <= 0.1 and high >= 0.9:
        all_kept_equals_dense(case)
    else:
        with pytest.raises(Broken, match=f"from {low:.0%} to {high:.0%} of it only"):
            all_kept_equals_dense(case)
