"""Checkpoints of guided runs that an earlier release began, with another name for the guide."""

from __future__ import annotations

from typing import Any

from torch import nn

EARLIER, NOW = "guide.", "leco_guide."


def read_earlier_guide(host: nn.Module) -> None:
    """Has a guided host find what guided it in such a checkpoint, too."""
    host._register_load_state_dict_pre_hook(_with_todays_names)


def _with_todays_names(state: dict[str, Any], prefix: str, *_: Any) -> None:
    """Renames the guide's values; those of a host with a guide of its own stay as they are."""
    before, now = f"{prefix}{EARLIER}", f"{prefix}{NOW}"
    if f"{before}_extra_state" in state and f"{now}_extra_state" not in state:
        for name in [name for name in state if name.startswith(before)]:
            state[f"{now}{name.removeprefix(before)}"] = state.pop(name)
