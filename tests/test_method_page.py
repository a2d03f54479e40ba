"""docs/method.md names code that exists, and figures that were measured."""

from __future__ import annotations

import importlib
import re
from pathlib import Path

import pytest

DOCS = Path(__file__).resolve().parent.parent / "docs"
PAGE = (DOCS / "method.md").read_text()

PLACE = re.compile(r"`((?:\w+/)*\w+)\.py: ([\w.]+)`")
LINK = re.compile(r"\]\(decisions\.md#([\w-]+)\)")
NUMBER = re.compile(r"(?<![\w.])\d+(?:\.\d+)?(?:e-\d+)?%?(?![\w.]*\w)")

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
