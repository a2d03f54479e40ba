"""What nerfstudio would list of this package: its entry and its page."""

from __future__ import annotations

import re
import runpy
from importlib.metadata import entry_points, metadata
from pathlib import Path
from typing import Any

import pytest
import upstream_page
from chart_sections import stored
from nerfstudio.configs import external_methods
from nerfstudio.configs.method_configs import merge_methods
from nerfstudio.plugins.types import MethodSpecification
from rich.text import Text

from leco_plugin.chart.summary import lines_of

FOLDER = Path(__file__).resolve().parents[1] / "docs" / "upstream"
PAGE = FOLDER / "leco_nerf.md"


def registered() -> dict[str, MethodSpecification]:
    """The methods of this package, as its entry points name them."""
    entries = entry_points(group="nerfstudio.method_configs")
    return {entry.name: entry.load() for entry in entries if entry.value.startswith("leco_plugin.")}


@pytest.fixture
def entry(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The entry, as the only one that nerfstudio knows."""
    listed: list[external_methods.ExternalMethod] = []
    monkeypatch.setattr(external_methods, "external_methods", listed)
    runpy.run_path(str(FOLDER / "external_method.py"))
    (only,) = listed
    return only


def test_the_entry_lists_the_registered_methods_by_their_own_descriptions(entry: Any) -> None:
    ours = registered()
    assert dict(entry.configurations) == {name: spec.description for name, spec in ours.items()}
    assert all(name == spec.config.method_name for name, spec in ours.items())


def test_the_entry_installs_this_package_and_names_this_page(entry: Any) -> None:
    assert entry.pip_package == metadata("leco-plugin")["Name"]
    shown = Text.from_markup(entry.instructions).plain.splitlines()
    assert f"  pip install {entry.pip_package}" in shown
    assert any(line.endswith(f"/nerfology/methods/{PAGE.stem}.html") for line in shown)


def test_nerfstudio_offers_what_is_not_installed_and_keeps_what_is(entry: Any) -> None:
    offered, said = external_methods.get_external_methods()
    assert offered.keys() == said.keys() == registered().keys()
    assert all("to install" in text for text in said.values())
    own = {"leco-ngp": registered()["leco-ngp"].config}
    methods, _ = merge_methods(own, {"leco-ngp": "ours"}, offered, said, overwrite=False)
    assert methods["leco-ngp"] is own["leco-ngp"] and methods.keys() == offered.keys()


def test_another_row_that_ends_better_than_the_one_shown_is_named() -> None:
    said = " ".join(upstream_page.page(PAGE.read_text()).split())
    for method, name in upstream_page.CHARTS.items():
        lines = [line for line in lines_of(stored(name)) if line.method == method]
        others = [line for line in lines if not line.learned]
        best = max(others, key=lambda line: line.psnr)
        assert (f"takes `{method}` to {best.psnr:.1f} dB." in said) == (best is not others[0])


def test_the_page_describes_every_method_once_and_no_other() -> None:
    text = PAGE.read_text()
    described, _, _ = text.partition("## Requirements")
    assert sorted(re.findall(r"^\| `([\w-]+)` \|", described, re.MULTILINE)) == sorted(registered())
    assert set(re.findall(r"ns-train ([\w-]+)", text)) <= registered().keys()
