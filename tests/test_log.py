"""Long work shows how far it is, on a terminal and in a log."""

from __future__ import annotations

import io
from types import SimpleNamespace

import pytest
from rich.console import Console

from leco_plugin import progress_bar


def test_in_a_log_it_is_a_line_a_minute(monkeypatch: pytest.MonkeyPatch) -> None:
    log, seconds = io.StringIO(), iter([0.0, 30.0, 61.0, 90.0, 125.0])
    monkeypatch.setattr(progress_bar, "CONSOLE", Console(file=log, width=120))
    monkeypatch.setattr(progress_bar, "time", SimpleNamespace(monotonic=lambda: next(seconds)))
    with progress_bar.bar("Guided") as show:
        for share in (0.1, 0.25, 0.3, 0.5):
            show(share)
    assert log.getvalue().splitlines() == ["Guided: 25% after 61 s", "Guided: 50% after 125 s"]


def test_on_a_terminal_it_is_a_bar(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = io.StringIO()
    monkeypatch.setattr(
        progress_bar, "CONSOLE", Console(file=terminal, width=120, force_terminal=True)
    )
    with progress_bar.bar("Guided") as show:
        show(0.5)
    assert "Guided" in terminal.getvalue() and "\x1b[" in terminal.getvalue()
