"""Claims about the package as a whole: what it exports, and what importing it costs."""

from __future__ import annotations

import json
import re
import runpy
import subprocess
import sys
from importlib.metadata import entry_points, version
from pathlib import Path

import pytest
import yaml

import leco_plugin

ROOT = Path(__file__).resolve().parents[1]


def modules_after(statement: str) -> set[str]:
    """Names of the modules that a fresh interpreter holds after `statement`."""
    code = f"import sys; {statement}; print('\\n'.join(sys.modules))"
    listed = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    return set(listed.stdout.split())


def test_every_public_name_can_be_had() -> None:
    for name in leco_plugin.__all__:
        assert getattr(leco_plugin, name) is not None


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="nothing_of_the_kind"):
        leco_plugin.nothing_of_the_kind  # noqa: B018


def test_importing_the_package_loads_no_other() -> None:
    assert modules_after("import leco_plugin").isdisjoint({"torch", "numpy", "nerfstudio"})


def test_an_occupancy_is_loaded_without_symbolic_mathematics() -> None:
    """torch imports sympy to count on its meta device, which takes longer than all the rest."""
    given = ROOT / "tests" / "data" / "occupancy.safetensors"
    loading = f"from leco_plugin.occupancy import Occupancy; Occupancy.load({str(given)!r})"
    assert "sympy" not in modules_after(loading)


def test_the_version_is_that_of_the_distribution() -> None:
    assert leco_plugin.__version__ == version("leco-plugin")


@pytest.mark.parametrize(
    "group", ["nerfstudio.method_configs", "nerfstudio.dataparser_configs", "leco_plugin.samplers"]
)
def test_every_entry_point_loads(group: str) -> None:
    """An exception in one of them would end every ns-* command, for other methods too."""
    ours = [entry for entry in entry_points(group=group) if entry.value.startswith("leco_plugin.")]
    assert ours
    for entry in ours:
        entry.load()


def test_a_wheel_has_every_file_of_the_package() -> None:
    """`routines.h` once was left out: whoever installed a wheel had no routines in C."""
    listed = re.search(r"^leco_plugin = (\[.*\])$", (ROOT / "pyproject.toml").read_text(), re.M)
    assert listed is not None
    package = ROOT / "leco_plugin"
    packed = {path for name in json.loads(listed[1]) for path in package.glob(name)}
    known = [path for path in package.rglob("*") if path.is_file() and path.suffix != ".pyc"]
    assert packed and {path for path in known if path.suffix != ".py"} == packed


def test_the_citation_and_the_changelog_name_this_version() -> None:
    assert f"version: {leco_plugin.__version__}\n" in (ROOT / "CITATION.cff").read_text()
    assert f"## [{leco_plugin.__version__}]" in (ROOT / "CHANGELOG.md").read_text()


def test_the_citation_prefers_the_paper_and_keeps_the_software() -> None:
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert cited["type"] == "software" and cited["authors"] and cited["license"]
    paper = cited["preferred-citation"]
    assert paper["title"].startswith("LeCO-NeRF: ") and paper["url"] in (
        (ROOT / "docs" / "upstream" / "leco_nerf.md").read_text()
    )


def test_links_of_the_readme_are_absolute_on_a_package_index() -> None:
    absolute = runpy.run_path(str(ROOT / ".ci" / "absolute_links.py"))["absolute"]
    home = "https://github.com/someone/something"
    changed = absolute(
        "![a](docs/a.gif) [b](docs/b.md#c) [d](https://e.org/f) [g](#h)\n"
        '<source srcset="docs/i.png"><img src="docs/j.png"> [![k](docs/k.png)](docs/l.md)',
        home,
        "v1.2.3",
    )
    assert changed == (
        f"![a]({home}/raw/v1.2.3/docs/a.gif) [b]({home}/blob/v1.2.3/docs/b.md#c) "
        "[d](https://e.org/f) [g](#h)\n"
        f'<source srcset="{home}/raw/v1.2.3/docs/i.png"><img src="{home}/raw/v1.2.3/docs/j.png"> '
        f"[![k]({home}/raw/v1.2.3/docs/k.png)]({home}/blob/v1.2.3/docs/l.md)"
    )
    text = absolute((ROOT / "README.md").read_text(), home, "main")
    targets = re.findall(r"\]\(([^)\s]+)\)|(?:src|srcset|href)=\"([^\"]+)\"", text)
    assert targets and all(re.match(r"https?://|#", one or other) for one, other in targets)


def test_a_release_makes_links_absolute_before_it_builds() -> None:
    jobs = yaml.safe_load((ROOT / ".github" / "workflows" / "release.yml").read_text())["jobs"]
    steps = [step.get("run", "") for step in jobs["build"]["steps"]]
    (links,) = (number for number, run in enumerate(steps) if "absolute_links.py" in run)
    assert links < steps.index("python -m build")


def test_every_python_that_is_declared_is_tried_before_a_release() -> None:
    declared = re.findall(r"Python :: (3\.\d+)", (ROOT / "pyproject.toml").read_text())
    jobs = yaml.safe_load((ROOT / ".github" / "workflows" / "release.yml").read_text())["jobs"]
    assert declared and jobs["try"]["strategy"]["matrix"]["python"] == declared


def test_the_sdist_has_every_file_that_git_keeps() -> None:
    """`make dist` and the release refuse one that lacks any; setuptools adds some by itself."""
    listed = subprocess.run(
        ["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    if listed.returncode or not (ROOT / ".git").exists():
        pytest.skip("no clone")
    rules = [line.split() for line in (ROOT / "MANIFEST.in").read_text().splitlines()]
    folders = {"leco_plugin", *(words[1] for words in rules if words[:1] == ["graft"])}
    named = {name for words in rules if words[:1] == ["include"] for name in words[1:]}
    named |= {"README.md", "LICENSE", "NOTICE", "MANIFEST.in", "pyproject.toml", ".gitignore"}
    files = listed.stdout.splitlines()
    assert [f for f in files if f.split("/")[0] not in folders and f not in named] == []
