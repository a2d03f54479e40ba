"""The published table of rules is that of the rules."""

from __future__ import annotations

from pathlib import Path

from leco_plugin.conformance.cases import SAMPLER_RULES, with_table

PAGE = Path(__file__).resolve().parents[2] / "docs" / "conformance.md"


def test_the_page_holds_the_rules_as_they_are():
    page = PAGE.read_text()
    remedy = "renew it with: python -m leco_plugin.conformance.cases docs/conformance.md"
    assert with_table(page) == page, remedy
    assert all(page.count(f"| `{rule.name}` |") == 1 for rule in SAMPLER_RULES)


def test_what_stands_around_the_table_is_left_alone():
    page = "# A\n<!-- rules: generated -->\n| a stale row |\n<!-- end of the rules -->\nB\n"
    renewed = with_table(page)
    assert renewed.startswith("# A\n<!-- rules") and renewed.endswith("rules -->\nB\n")
    assert "stale" not in renewed
