"""Configs of runs that an earlier release began: its `config.yml` lacks the fields added since."""

from __future__ import annotations

from dataclasses import MISSING, fields
from typing import Any


class GrowingConfig:
    """Base of a config dataclass; fields that a stored one lacks take their defaults.

    Of plain defaults Python sees to that by itself; of those that are made anew for each instance a
    stored instance would simply lack the attribute.
    """

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Called by yaml and pickle with the fields that were stored."""
        known: Any = self
        made = {
            each.name: each.default_factory()
            for each in fields(known)
            if each.name not in state and each.default_factory is not MISSING
        }
        self.__dict__.update(made | state)
