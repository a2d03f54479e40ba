"""Links between the project's pages lead to files and headings that are there."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")])
LINK = re.compile(r"\]\((?!https?:|mailto:)([^)#\s]*)(?:#([^)\s]+))?\)")
HEADING = re.compile(r"^#+ (.*)$", re.MULTILINE)


def anchors_of(page: Path) -> set[str]:
    """Names that a page's headings have in links."""
    titles = HEADING.findall(page.read_text())
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_link_leads_somewhere(page: Path) -> None:
    missing = []
    for name, anchor in LINK.findall(page.read_text()):
        target = page if not name else (page.parent / name).resolve()
        if not target.exists() or (anchor and anchor not in anchors_of(target)):
            missing.append(f"{name}#{anchor}")
    assert not missing


def test_there_is_something_to_follow() -> None:
    links = [link for page in PAGES for link in LINK.findall(page.read_text())]
    assert len(links) > 100 and sum(bool(anchor) for _, anchor in links) > 50
