"""The options of `pytest --pyargs leco_plugin.conformance`, which pytest must know before it looks
for tests. It is loaded in every run of pytest on a machine that has leco_plugin: it adds options
and does nothing else.
"""

from __future__ import annotations

import pytest


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.getgroup("leco", "conformance of leco_plugin").addoption(
        "--leco-sampler",
        action="append",
        default=[],
        metavar="NAME",
        help="sampler to hold to the rules, with --pyargs leco_plugin.conformance; may be repeated",
    )
