"""Lines are said once for all processes; long work shows how far it is."""

from __future__ import annotations

import io
import logging
from contextlib import nullcontext
from types import SimpleNamespace

import pytest
from rich.console import Console

from leco_plugin import log


def test_in_a_log_it_is_a_line_early_then_one_a_minute_and_a_twentieth(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    written, seconds = io.StringIO(), iter([0.0, 5.0, 12.0, 60.0, 71.0, 80.0, 150.0])
    monkeypatch.setattr(log, "console", lambda: Console(file=written, width=120))
    monkeypatch.setattr(log, "time", SimpleNamespace(monotonic=lambda: next(seconds)))
    with log.bar("Guided") as show:
        for share in (0.0, 0.25, 0.26, 0.5, 0.29, 0.5):
            show(share, "9.9 dB")
    assert written.getvalue().splitlines() == [
        "Guided: 25% after 12 s, 9.9 dB, about 36 s left",
        "Guided: 50% after 2 min, 9.9 dB, about 2 min left",
    ]


def test_details_go_to_the_file_and_the_rest_to_both(capsys: pytest.CaptureFixture[str]) -> None:
    file = io.StringIO()
    with log.details_in(file):
        log.note("a table of [wide] things")
        log.say("a result")
        log.summarize(["in short"], ["at length"])
    log.note("afterwards")
    on_screen, in_file = capsys.readouterr().out, file.getvalue()
    assert on_screen.splitlines()[:2] == ["a result", "in short"] and "afterwards" in on_screen
    assert [line[9:] for line in in_file.splitlines()] == [
        *("a table of [wide] things", "a result", "at length", "in short")
    ]


@pytest.mark.parametrize("line", ["wrote /runs/scene [v2]/gate.pt", "/runs/[/x]", "/a:smile:/b"])
def test_names_of_files_are_said_as_they_are(line: str, capsys: pytest.CaptureFixture[str]) -> None:
    file = io.StringIO()
    for tell in (log.say, log.note, log.put):
        tell(line)
        assert line in capsys.readouterr().out
    with log.details_in(file):
        for tell in (log.say, log.note, log.put):
            tell(line)
    assert file.getvalue().count(line) == 3
    assert capsys.readouterr().out.count(line) == 2, "a note is for the file alone"


def test_on_a_terminal_it_is_a_bar(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = io.StringIO()
    drawn_on = Console(file=terminal, width=120, force_terminal=True)
    monkeypatch.setattr(log, "console", lambda: drawn_on)
    with log.bar("Guided") as show:
        show(0.5)
    assert "Guided" in terminal.getvalue() and "\x1b[" in terminal.getvalue()


def test_what_is_made_of_each_thing_comes_back_and_each_moves_the_bar(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    shares: list[float] = []
    monkeypatch.setattr(log, "bar", lambda what: nullcontext(shares.append))
    assert log.for_each("Squaring", [1, 2, 3, 4], lambda n: n * n) == [1, 4, 9, 16]
    assert shares == [0.25, 0.5, 0.75, 1.0]


@pytest.mark.parametrize("first", [True, False])
def test_only_the_first_speaks(
    first: bool, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(log, "is_first", lambda: first)
    log.say("hear, hear")
    assert ("[leco] hear, hear" in capsys.readouterr().out) == first


@pytest.fixture
def logged(monkeypatch: pytest.MonkeyPatch) -> logging.Logger:
    """The logger of a sampler, whose lines are said; the package's is put back afterwards."""
    ours = logging.getLogger("leco_plugin")
    monkeypatch.setattr(ours, "handlers", [])
    monkeypatch.setattr(ours, "level", ours.level)
    log.say_what_is_logged()
    log.say_what_is_logged()
    return logging.getLogger("leco_plugin.samplers.somewhere")


def test_what_samplers_log_is_said_once(
    logged: logging.Logger, capsys: pytest.CaptureFixture[str]
) -> None:
    logged.info("no fused gate: %s", "it is [wide]")
    assert capsys.readouterr().out.count("[leco] no fused gate: it is [wide]") == 1


def test_a_process_that_is_not_the_first_only_warns(
    logged: logging.Logger, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(log, "is_first", lambda: False)
    monkeypatch.setattr(log.distributed, "get_rank", lambda: 3)
    of_its_card = logging.getLogger("leco_plugin.samplers.kernels.fused")
    of_its_card.info("the fused gate answers")
    of_its_card.warning("the fused gate does not run")
    logged.warning("no cell cache in any process")
    said = capsys.readouterr().out
    assert "[leco] process 3: the fused gate does not run" in said
    assert "answers" not in said and "cell cache" not in said


def test_what_is_kept_back_is_not_on_the_screen(
    logged: logging.Logger, capsys: pytest.CaptureFixture[str]
) -> None:
    with log.kept_back() as kept:
        log.say("said")
        log.note("noted")
        logged.warning("warned of")
    assert kept == ["said", "noted", "warned of"] and not capsys.readouterr().out
    log.say("said again")
    assert "said again" in capsys.readouterr().out and len(kept) == 3


def test_one_thing_is_counted_without_an_s() -> None:
    assert [log.counted(count, "run") for count in (0, 1, 2)] == ["0 runs", "1 run", "2 runs"]
    assert log.counted(1, "mask has", "masks have") == "1 mask has"
    assert log.counted(3, "mask has", "masks have") == "3 masks have"


def test_a_duration_is_in_seconds_then_minutes_then_hours() -> None:
    said = {
        89.4: "89 s",
        90.0: "2 min",
        3569.0: "59 min",
        3590.0: "1 h 0 min",
        12000.0: "3 h 20 min",
    }
    assert {seconds: log.spell(seconds) for seconds in said} == said
