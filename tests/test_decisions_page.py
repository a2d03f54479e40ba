"""What docs/decisions.md says of the design's leads stands in the entries that it points to."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

PAGE = (Path(__file__).resolve().parent.parent / "docs" / "decisions.md").read_text()
OVERVIEW, _, ENTRIES = PAGE.partition("\n## Entries\n")
ROWS = [line for line in OVERVIEW.splitlines() if "](#" in line]

LINK = re.compile(r"\]\(#([\w-]+)\)")
FIGURE = re.compile(r"(?<![\w.^])\d+\.\d+|\d+%|\d{3,}")
OF_THE_PROTOTYPE = "28%"


def entries() -> dict[str, str]:
    """Text of each entry under the name that a link gives its heading."""
    parts = re.split(r"^### ", ENTRIES, flags=re.MULTILINE)[1:]
    titles = [part.splitlines()[0] for part in parts]
    slugs = [re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles]
    return dict(zip(slugs, parts))


@pytest.mark.parametrize("row", ROWS)
def test_a_lead_has_an_entry_with_its_figures(row: str) -> None:
    found = entries()
    text = "\n".join(found[slug] for slug in LINK.findall(row))
    said = row.split(" | ")[1]
    for figure in FIGURE.findall(said):
        whole = rf"(?<![\d.]){re.escape(figure.rstrip('%'))}(?!\d|\.\d)"
        assert figure == OF_THE_PROTOTYPE or re.search(whole, text), figure


def test_every_lead_is_named() -> None:
    leads = ["cheaper than the field", "Unseen space", "behind opaque", "denser", "Larger fields"]
    for lead in leads:
        assert any(lead in row for row in ROWS), lead
