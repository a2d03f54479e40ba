"""Names that a user gives: of options, and what is said of an unknown one."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from difflib import get_close_matches

LIKE = 0.7
"""Likeness, 0 to 1, from which on an unknown name is taken for a misspelt one."""


def options_in(words: Sequence[str]) -> list[str]:
    """Names of the options among words that were typed, with their dashes, as help has them."""
    named = [word.partition("=")[0] for word in words if word.startswith("--")]
    return [name.replace("_", "-") for name in named if name != "--"]


def unknown_name(kind: str, name: str, known: Iterable[str]) -> str:
    """What is said where there is nothing of a name."""
    return f"there is no {kind} {name!r}; {known_names(name, known)}"


def known_names(name: str, known: Iterable[str]) -> str:
    """What to say after an unknown name: the known one that it resembles, and all of them."""
    names = {each.lower(): each for each in known}
    near = get_close_matches(name.lower(), names, 1, LIKE)
    meant = f"did you mean {names[near[0]]}? There are" if near else "there are"
    return f"{meant} {', '.join(names.values()) or 'none'}"


def is_like(name: str, known: Iterable[str]) -> bool:
    """Whether a name is a known one, or resembles one."""
    return bool(get_close_matches(name, list(known), 1, LIKE))
