"""docs/method.md names code that exists, and figures that were measured."""

from __future__ import annotations

import importlib
import re
from pathlib import Path

import pytest
from suite_minutes import minutes_together

from leco_plugin.chart.protocol import FAST, SLOW, Protocol
from leco_plugin.chart.suites import SUITES
from leco_plugin.method_configs import ON_GPU

DOCS = Path(__file__).resolve().parent.parent / "docs"
PAGE = (DOCS / "method.md").read_text()

PLACE = re.compile(r"`((?:\w+/)*\w+)\.py: ([\w.]+)`")
LINK = re.compile(r"\]\(decisions\.md#([\w-]+)\)")
NUMBER = re.compile(r"(?<![\w.])\d+(?:\.\d+)?(?:e-\d+)?%?(?![\w.]*\w)")
SUITE_ROW = re.compile(
    r"^\| `([\w-]+)` \| (\d+) \| ([\d-]*) ?\| ([^|]*?) ?\| (\d+ to \d+) \|$", re.MULTILINE
)

PLACES = sorted(set(PLACE.findall(PAGE)))
REASONS = [
    cells[-1]
    for cells in (line.strip("| ").split(" | ") for line in PAGE.splitlines())
    if LINK.search(cells[-1])
]


def entries() -> dict[str, str]:
    """Text of each entry of docs/decisions.md, under the name that a link gives its heading."""
    parts = re.split(r"^### ", (DOCS / "decisions.md").read_text(), flags=re.MULTILINE)[1:]
    titles = [part.splitlines()[0] for part in parts]
    slugs = [re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles]
    return dict(zip(slugs, parts))


def test_the_page_was_read() -> None:
    assert len(PLACES) > 30 and len(REASONS) > 15
    assert PAGE.count(".py: ") == len(PLACE.findall(PAGE))


@pytest.mark.parametrize(("file", "name"), PLACES)
def test_each_function_that_is_named_exists(file: str, name: str) -> None:
    found = importlib.import_module(f"leco_plugin.{file.replace('/', '.')}")
    for part in name.split("."):
        found = getattr(found, part)


@pytest.mark.parametrize("reason", REASONS)
def test_each_figure_stands_in_an_entry_that_is_linked_beside_it(reason: str) -> None:
    linked = LINK.findall(reason)
    assert set(linked) <= entries().keys()
    figures = set(NUMBER.findall(re.sub(r"`[^`]*`|\(decisions[^)]*\)", "", reason)))
    recorded = set(NUMBER.findall(" ".join(entries()[slug] for slug in linked)))
    recorded |= {figure.rstrip("%") for figure in recorded}
    assert {figure.rstrip("%") for figure in figures} <= recorded


def test_the_table_of_suites_says_how_many_runs_they_have_and_how_long_they_take() -> None:
    rows = {name: cells for name, *cells in re.findall(SUITE_ROW, PAGE)}
    assert list(rows) == [*SUITES, "all"]
    made: set[tuple[str, Protocol]] = set()
    for name, one in SUITES.items():
        wanted = {(contender.alone().key, one.protocol) for contender in one.contenders}
        count, shared, _, minutes = rows[name]
        assert int(count) == len(wanted) and int(shared.replace("-", "0")) == len(wanted & made)
        assert minutes == f"{one.minutes(FAST):.0f} to {one.minutes(SLOW):.0f}"
        made |= wanted
    assert int(rows["all"][0]) == len(made)
    fast, slow = (minutes_together(list(SUITES), cores) for cores in (FAST, SLOW))
    assert rows["all"][3] == f"{fast:.0f} to {slow:.0f}"


@pytest.mark.parametrize("name", SUITES)
def test_the_table_of_suites_says_when_their_runs_end(name: str) -> None:
    (ends,) = (row[3] for row in re.findall(SUITE_ROW, PAGE) if row[0] == name)
    budget = SUITES[name].protocol.budget()
    if budget.seconds is None:
        assert ON_GPU or ends == f"{budget.steps} steps"
    else:
        learning = budget.learn_seconds
        assert ends == f"{budget.seconds:g} s, of which at most {learning:g} learn"
