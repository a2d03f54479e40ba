"""Claims about docs/stability.md: its cases are those there are."""

from __future__ import annotations

from pathlib import Path

from leco_plugin.stability.cases import CASES
from leco_plugin.stability.contenders import SAMPLERS

PAGE = Path(__file__).parents[2] / "docs" / "stability.md"
BEGIN, END = "<!-- cases: generated -->", "<!-- end of the cases -->"


def cases_table() -> str:
    rows = [f"| `{case.name}` | {case.title} | {case.why} |" for case in CASES.values()]
    return "\n".join(["| name | case | why it is there |", "|---|---|---|", *rows])


def test_the_page_lists_the_cases_there_are() -> None:
    text = PAGE.read_text()
    assert text[text.index(BEGIN) + len(BEGIN) : text.index(END)].strip() == cases_table()


def test_the_page_names_every_sampler() -> None:
    assert all(f"`{name}`" in PAGE.read_text() for name in SAMPLERS)
