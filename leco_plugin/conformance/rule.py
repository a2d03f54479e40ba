"""What a rule is, and how one is applied so that a broken sampler cannot spoil the next rule."""

from __future__ import annotations

import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import torch

HERE = Path(__file__).resolve().parents[1]


class Broken(AssertionError):
    """Raised by a check: the rule does not hold, and this is what was found."""


def require(holds: bool, problem: str) -> None:
    """Raises `Broken` with `problem` unless the condition holds."""
    if not holds:
        raise Broken(problem)


class Case(Protocol):
    """What is checked: something known by name, at one of the seams of a host."""

    @property
    def name(self) -> str: ...
    @property
    def seam(self) -> str: ...
    def forget(self) -> None:
        """Drops whatever was built: a check that failed may have left it in any state."""


@dataclass(frozen=True)
class Rule:
    """A promise that hosts rely on."""

    name: str
    """What users see, in command lines and tests."""
    reason: str
    """Why it matters: what goes wrong in a host when it does not hold."""
    remedy: str
    """What to do about it."""
    checks: Mapping[str, Callable[[Any], None]]
    """By seam: takes the case, returns when the rule holds and raises when not (`Broken`; whatever
    else is raised counts as broken too)."""


@dataclass(frozen=True)
class Verdict:
    """Whether a rule holds for a case."""

    rule: Rule
    name: str
    seam: str
    error: Exception | None
    """What the check raised; None when the rule holds."""

    @property
    def passed(self) -> bool:
        return self.error is None

    @property
    def problem(self) -> str:
        """What was found, in one line; empty when the rule holds."""
        if self.error is None:
            return ""
        said = " ".join(str(self.error).split())
        if isinstance(self.error, Broken):
            return said
        return f"{type(self.error).__name__}: {said}{_place(self.error)}"

    @property
    def advice(self) -> str:
        """Problem, reason and remedy, in one line."""
        return f"{self.problem}. Why it matters: {self.rule.reason} Remedy: {self.rule.remedy}"

    def line(self) -> str:
        """What `leco check` prints."""
        start = f"{'pass' if self.passed else 'FAIL'}  {self.seam}  {self.rule.name}"
        return start if self.passed else f"{start}: {self.advice}"

    def to_dict(self) -> dict[str, str | bool]:
        """JSON values."""
        return {
            "rule": self.rule.name,
            "seam": self.seam,
            "passed": self.passed,
            "problem": self.problem,
            "reason": self.rule.reason,
            "remedy": self.rule.remedy,
        }


OTHERS = {"torch", "nerfstudio", "nerfacc"}
"""Packages in which errors come up that are not theirs."""


def _place(error: Exception) -> str:
    """Where in the code that is checked an error came up; empty where it did not."""
    for frame in reversed(traceback.extract_tb(error.__traceback__)):
        path = Path(frame.filename)
        if HERE not in path.parents and not OTHERS & set(path.parts):
            return f" ({path.name}, line {frame.lineno})"
    return ""


def apply(rule: Rule, case: Case) -> Verdict:
    """Whether `rule` holds for `case`, whose seam it must have a check for.

    The state of torch's random numbers and whether gradients are on are as before afterwards,
    whatever the case did to them.
    """
    error = None
    with torch.random.fork_rng(devices=[]), torch.enable_grad():
        try:
            rule.checks[case.seam](case)
        except Exception as caught:  # noqa: BLE001 (whatever a foreign sampler raises)
            case.forget()
            error = caught
    return Verdict(rule, case.name, case.seam, error)
