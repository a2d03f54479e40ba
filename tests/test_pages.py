"""The project's pages name code, headings, commands and figures that are there."""

from __future__ import annotations

import ast
import importlib
import json
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import gifts_page
import gpu
import gpu_paper
import pytest
import reference_pages
import results_page
import tyro
from nerfstudio.configs.base_config import MachineConfig
from suite_minutes import minutes_of, minutes_together

from leco_plugin.chart.contender import FAST, SLOW, Contender, Protocol
from leco_plugin.chart.methods import SUITES, contenders
from leco_plugin.method_configs import ON_GPU
from leco_plugin.samplers.kernels import NAMES, VARIABLE

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "leco_plugin"
PAGES = {path.stem: path for path in sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/*.md")])}
TEXTS = {name: path.read_text() for name, path in PAGES.items()}
OVERVIEW, _, ENTRIES = TEXTS["decisions"].partition("\n## Entries\n")
METHOD, GPU = TEXTS["method"], TEXTS["gpu"]

LINK = re.compile(r"\]\((?!https?:|mailto:)([^)#\s]*)(?:#([^)\s]+))?\)")
HEADING = re.compile(r"^#+ (.*)$", re.MULTILINE)
FILE = re.compile(r"`((?:\w+/)+\w+)\.py`")
PLACE = re.compile(r"`((?:\w+/)*\w+)\.py: ([\w.]+)`")
NUMBER = re.compile(r"(?<![\w.])\d+(?:\.\d+)?(?:e-\d+)?(?=%?(?![\w.]*\w))")
SUITE_ROW = re.compile(
    r"^\| `([\w-]+)` \| (\d+) \| ([\d-]*) ?\| ([^|]*?) ?\| (\d+ to \d+) \|$", re.MULTILINE
)
OF_THE_PROTOTYPE = "28"
"""Per cent, in the overview of decisions: of a time before there were entries."""


def anchor(title: str) -> str:
    """The name that a heading has in links."""
    return re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-")


@pytest.mark.parametrize("page", PAGES)
def test_every_link_leads_somewhere(page: str) -> None:
    missing = []
    for name, wanted in LINK.findall(TEXTS[page]):
        target = (PAGES[page].parent / name).resolve() if name else PAGES[page]
        there = target.exists() and (
            not wanted or wanted in map(anchor, HEADING.findall(target.read_text()))
        )
        missing += [] if there else [f"{name}#{wanted}"]
    assert not missing


@pytest.mark.parametrize("page", PAGES)
def test_every_file_and_function_that_is_named_exists(page: str) -> None:
    for file in FILE.findall(TEXTS[page]):
        assert any((folder / f"{file}.py").is_file() for folder in (PACKAGE, ROOT)), file
    for file, name in PLACE.findall(TEXTS[page]):
        module = file.replace("/", ".")
        ours = not module.startswith("benchmarks.")
        found = importlib.import_module(f"leco_plugin.{module}" if ours else module.split(".")[1])
        for part in name.split("."):
            found = getattr(found, part)


def claims() -> list[tuple[str, list[str]]]:
    """Cells of figures, and the entries of docs/decisions.md that are linked beside them."""
    found = []
    for page, of_page, column in ((METHOD, "decisions.md", -1), (OVERVIEW, "", 1)):
        for line in page.splitlines():
            cells = line.strip("| ").split(" | ")
            among = cells[-1] if of_page else line
            linked = [heading for name, heading in LINK.findall(among) if name == of_page]
            if linked and len(cells) > 1:
                found.append((cells[column], linked))
    return found


@pytest.mark.parametrize(("said", "linked"), claims())
def test_each_figure_stands_in_an_entry_that_is_linked_beside_it(
    said: str, linked: list[str]
) -> None:
    parts = re.split(r"^### ", ENTRIES, flags=re.MULTILINE)[1:]
    entries = {anchor(part.splitlines()[0]): part for part in parts}
    figures = set(NUMBER.findall(re.sub(r"`[^`]*`|\]\([^)]*\)", "", said)))
    recorded = set(NUMBER.findall(" ".join(entries[heading] for heading in linked)))
    assert figures <= recorded | {OF_THE_PROTOTYPE}


def test_the_pages_were_read() -> None:
    links = [link for text in TEXTS.values() for link in LINK.findall(text)]
    assert len(links) > 100 and sum(bool(heading) for _, heading in links) > 50
    assert len(set(PLACE.findall(METHOD))) > 30 and len(claims()) > 25
    assert METHOD.count(".py: ") == len(PLACE.findall(METHOD))
    rows = [line for line in OVERVIEW.splitlines() if "](#" in line]
    for lead in (
        "cheaper than the field",
        "Unseen space",
        "behind opaque",
        "denser",
        "Larger fiel",
    ):
        assert any(lead in row for row in rows), lead


def test_the_table_of_suites_says_how_many_runs_they_have_and_how_long_they_take() -> None:
    rows = {name: cells for name, *cells in re.findall(SUITE_ROW, METHOD)}
    assert list(rows) == [*SUITES, "all"]
    made: set[tuple[str, Protocol]] = set()
    for name, one in SUITES.items():
        wanted = {(contender.alone().key, one.protocol) for contender in one.contenders}
        count, shared, _, minutes = rows[name]
        assert int(count) == len(wanted) and int(shared.replace("-", "0")) == len(wanted & made)
        assert minutes == f"{minutes_of(one, FAST):.0f} to {minutes_of(one, SLOW):.0f}"
        made |= wanted
    assert int(rows["all"][0]) == len(made)
    fast, slow = (minutes_together(list(SUITES), cores) for cores in (FAST, SLOW))
    assert rows["all"][3] == f"{fast:.0f} to {slow:.0f}"


@pytest.mark.parametrize("name", SUITES)
def test_the_table_of_suites_says_when_their_runs_end(name: str) -> None:
    (ends,) = (row[3] for row in re.findall(SUITE_ROW, METHOD) if row[0] == name)
    budget = SUITES[name].protocol.budget()
    if budget.seconds is None:
        assert ON_GPU or ends == f"{budget.steps} steps"
    else:
        learning = budget.learn_seconds
        assert ends == f"{budget.seconds:g} s, of which at most {learning:g} learn"


@pytest.mark.parametrize("table", ["gate", "twin", "training", "sampling"])
def test_floors_on_paper_are_those_that_are_counted(table: str) -> None:
    assert getattr(gpu_paper, f"{table}_table")() in TEXTS["gpu-kernels"]


def test_the_page_says_of_every_part_how_long_it_may_take() -> None:
    rows = re.findall(r"^\| (\w+) \| .* \| (\d+) \|$", GPU, re.MULTILINE)
    assert {name: float(seconds) for name, seconds in rows} == {
        name: part.seconds for name, part in gpu.PARTS.items()
    }


def test_the_commands_for_several_gpus_are_nerfstudios() -> None:
    given: list[Any] = []
    for command in re.findall(r"^    (ns-train leco-occupancy .*)$", GPU, re.MULTILINE):
        *words, data, scene = shlex.split(command)[2:]
        assert (data, scene) == ("--data", "SCENE")
        flags = [word.replace("--machine.", "--") for word in words]
        given.append(tyro.cli(MachineConfig, args=flags))
    assert [machine.num_devices for machine in given] == [4, 4, 4]
    assert [machine.num_machines for machine in given] == [1, 2, 2]
    assert [machine.machine_rank for machine in given] == [0, 0, 1]
    assert given[1].dist_url == given[2].dist_url == "tcp://HOST:PORT"


def test_kernels_that_can_be_turned_off_are_named() -> None:
    (paragraph,) = re.findall(r"\*\*Off\.\*\*.*?\n\n", GPU, re.DOTALL)
    assert f"`{VARIABLE}=march`" in paragraph
    assert all(f"`{name}`" in paragraph for name in NAMES)


@pytest.mark.parametrize(
    ("file", "line"),
    [
        ("samplers/kernels/fused.py", "the fused {} answers on "),
        ("samplers/kernels/fused.py", "no fused gate: "),
        ("samplers/kernels/fused.py", "the fused {} does not run, torch answers in its place: "),
        ("samplers/kernels/fused.py", "compute capability {} is below 8.0"),
        ("samplers/kernels/fused.py", "it decides otherwise about {} of {} positions"),
        ("samplers/kernels/gate_weights.py", "the kernel holds "),
        ("samplers/kernels/gate_weights.py", "features; the kernel knows frequencies only"),
        ("samplers/estimator.py", "no cell cache, sampling will be slower: "),
        ("models/compute/grouped.py", "no grouped products, "),
        ("models/compute/grouped.py", "ms a layer grouped, "),
    ],
)
def test_lines_of_the_log_are_those_that_are_logged(file: str, line: str) -> None:
    values = re.escape(line).replace(r"\{\}", r"(%s|\{[^`]*?\}|[\w.]+)")
    assert re.search(values, (PACKAGE / file).read_text())
    (table,) = re.findall(r"\| line \| .*?\n\n", GPU, re.DOTALL)
    assert re.search(values, table)


def spoken(path: Path) -> Iterator[str]:
    """Strings of a module that are no docstrings, with `...` for the values in them."""
    for parent in ast.walk(ast.parse(path.read_text())):
        for child in ast.iter_child_nodes(parent) if not isinstance(parent, ast.Expr) else ():
            parts = child.values if isinstance(child, ast.JoinedStr) else [child]
            said = [getattr(part, "value", None) for part in parts]
            if isinstance(child, ast.Constant | ast.JoinedStr):
                yield "".join(each if isinstance(each, str) else "..." for each in said)


def test_lines_on_the_page_of_troubles_are_those_that_are_said() -> None:
    said = "\n".join(line for path in PACKAGE.rglob("*.py") for line in spoken(path))
    rows = re.findall(r"^\| (.*?) \| .* \|$", TEXTS["troubles"], re.MULTILINE)
    quoted = [quote for row in rows for quote in re.findall("`([^`]*)`", row) if " " in quote]
    assert len(quoted) > 60
    assert [quote for quote in quoted if quote not in re.sub(r"%\w", "...", said)] == []


def test_the_published_tables_are_those_of_the_stored_results(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["results_page.py", "--check"])
    assert results_page.main() == 0, capsys.readouterr().err


@pytest.mark.skipif(ON_GPU, reason="defaults on the page are those of a CPU")
def test_pages_of_commands_and_options_are_those_of_the_code() -> None:
    assert TEXTS["commands"] == reference_pages.commands_page()
    assert TEXTS["options"] == reference_pages.options_page()
    assert TEXTS["conformance"] == reference_pages.rules_page()
    assert TEXTS["gifts"] == gifts_page.page()


def test_the_size_of_a_file_is_told_alike_on_all_pages_and_is_that_of_stored_runs() -> None:
    said = r"The file takes (\d+) to (\d+) kB where a small gate took over late in the run, and "
    said += r"(\d+) to (\d+) kB otherwise\."
    pages = [TEXTS[name] for name in ("architecture", "share", "file-format", "CHANGELOG")]
    pages.append((ROOT / "docs" / "upstream" / "leco_nerf.md").read_text())
    (ranges,) = {re.findall(said, " ".join(text.split()))[0] for text in pages}
    low, high, others_low, others_high = (1000 * int(value) for value in ranges)
    runs = [
        run["occupancy"]
        for file in sorted((ROOT / "benchmarks" / "results" / "charts").glob("*.json"))
        for run in json.loads(file.read_text())["runs"]
        if run["sampler"] == "learned-occupancy" and run.get("occupancy")
    ]
    small = [run["bytes"] for run in runs if run["params"] < 10_000]
    others = [run["bytes"] for run in runs if run["params"] >= 10_000]
    assert small and low <= min(small) and max(small) <= high
    assert others and others_low <= min(others) and max(others) <= others_high


def test_a_contender_that_lacks_a_gift_is_named_on_the_page_of_gifts() -> None:
    whole, grid = contenders(["leco-ngp"], ["learned-occupancy", "occupancy-grid-64"])
    lacking = {
        "Opaque start": {"occupancy.opaque_start": False},
        "Distances": {"occupancy.learning.termination": 0.0},
        "Careful start": {"occupancy.learning.calibration.recheck_rays": 0},
        "Codes": {"codes": "own"},
    }
    for gift, change in lacking.items():
        other = replace(whole, name="Instant-NGP + poor", changes={**whole.changes, **change})
        (line,) = _lines_of(gift, [whole, whole, other])
        assert "poor" in line and "a learned row without it can be charted" in line
        assert not _lines_of(gift, [whole, replace(whole, name="Instant-NGP + rich")])
    rates = {"optimizers.fields.optimizer.lr": 0.5}
    (line,) = _lines_of("Rates", [whole, replace(grid, settings=rates)])
    assert "0.5" in line and "all learned rows have it" in line


def _lines_of(gift: str, rows: list[Contender]) -> list[str]:
    """What the page says of a gift that not all rows have."""
    return [
        line
        for line in gifts_page.page(rows).split("\n")
        if line.startswith(f"- **{gift}**: ") and line not in gifts_page.HEAD
    ]


def _prose(page: str) -> str:
    """A page of the site without its scripts and code."""
    return re.sub(r"<(script|style|code)\b.*?</\1>", "", page, flags=re.DOTALL)


def test_the_site_builds_without_a_warning_and_fetches_nothing(tmp_path: Path) -> None:
    """Every link and heading of the site is there; nothing that a page loads is elsewhere."""
    pytest.importorskip("mkdocs")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    quiet = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, env=quiet, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    site = {path.name: path.read_text() for path in tmp_path.glob("*.html")}
    assert site.keys() >= {"index.html", "tutorial.html"} and "decisions.html" not in site
    dead = re.compile(r"<abbr[^>]*>(?:entry|figures|why)<|\((?:entry|figures|why)\)")
    assert [name for name, page in site.items() if dead.search(_prose(page))] == []
    assert "docs/decisions.md" in site["method.html"]
    assert "Occupancy.load" in site["python.html"] or "load(path" in site["python.html"]
    loaded = re.compile(
        r"<(?:script|link|img|source|iframe)\b[^>]*(?:src|href|srcset)=\"?([^\s\">]+)"
    )
    found = [name for page in site.values() for name in loaded.findall(page)]
    assert len(found) > 100 and [name for name in found if "//" in name] == []
