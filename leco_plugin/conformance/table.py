"""The table of rules in docs/conformance.md: python -m leco_plugin.conformance.table PAGE."""

from __future__ import annotations

import sys
from pathlib import Path

from leco_plugin.conformance.sampler_rules import SAMPLER_RULES

BEGIN, END = "<!-- rules: generated -->", "<!-- end of the rules -->"


def rules_table() -> str:
    """The rules in Markdown."""
    rows = ["| rule | seams | why it matters | remedy |", "|---|---|---|---|"]
    rows += [
        f"| `{rule.name}` | {', '.join(rule.checks)} | {rule.reason} | {rule.remedy} |"
        for rule in SAMPLER_RULES
    ]
    return "\n".join(rows)


def with_table(page: str) -> str:
    """A page with the table between its two marks renewed."""
    before, _, rest = page.partition(BEGIN)
    return f"{before}{BEGIN}\n{rules_table()}\n{END}{rest.partition(END)[2]}"


if __name__ == "__main__":
    path = Path(sys.argv[1])
    path.write_text(with_table(path.read_text()))
