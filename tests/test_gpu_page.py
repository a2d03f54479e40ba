"""What docs/gpu.md says can be run, and is what is counted."""

from __future__ import annotations

import importlib
import re
import shlex
from pathlib import Path

import pytest
import tyro
from nerfstudio.configs.base_config import MachineConfig

from leco_plugin.samplers.kernels import NAMES, VARIABLE

ROOT = Path(__file__).resolve().parent.parent
PAGE = (ROOT / "docs" / "gpu.md").read_text()


def test_the_floors_on_paper_are_those_that_are_counted(monkeypatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    paper = importlib.import_module("gpu_paper")
    assert paper.gate_table() in PAGE
    assert paper.twin_table() in PAGE
    assert paper.training_table() in PAGE
    assert paper.sampling_table() in PAGE


def test_the_page_says_of_every_part_how_long_it_may_take(monkeypatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    parts = importlib.import_module("gpu").PARTS
    rows = re.findall(r"^\| (\w+) \| .* \| (\d+) \|$", PAGE, re.MULTILINE)
    assert {name: float(seconds) for name, seconds in rows} == {
        name: part.seconds for name, part in parts.items()
    }


def test_the_commands_for_several_gpus_are_nerfstudios() -> None:
    commands = re.findall(r"^    (ns-train leco-occupancy .*)$", PAGE, re.MULTILINE)
    given = []
    for command in commands:
        words = shlex.split(command)[2:]
        assert words[-2:] == ["--data", "SCENE"]
        options = [word.removeprefix("--machine.") for word in words[:-2]]
        flags = [f"--{word}" if i % 2 == 0 else word for i, word in enumerate(options)]
        given.append(tyro.cli(MachineConfig, args=flags))
    assert [machine.num_devices for machine in given] == [4, 4, 4]
    assert [machine.num_machines for machine in given] == [1, 2, 2]
    assert [machine.machine_rank for machine in given] == [0, 0, 1]
    assert given[1].dist_url == given[2].dist_url == "tcp://HOST:PORT"


@pytest.mark.parametrize("name", re.findall(r"`((?:samplers|models)/\w+\.py)`", PAGE))
def test_files_that_it_names_are_there(name: str) -> None:
    assert (ROOT / "leco_plugin" / name).is_file()


def test_kernels_that_can_be_turned_off_are_named() -> None:
    (paragraph,) = re.findall(r"\*\*Off\.\*\*.*?\n\n", PAGE, re.DOTALL)
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
        ("samplers/estimator.py", "no cell cache, sampling will be slower: "),
        ("models/compute/grouped.py", "no grouped products, "),
        ("models/compute/grouped.py", "ms a layer grouped, "),
    ],
)
def test_lines_of_the_log_are_those_that_are_logged(file: str, line: str) -> None:
    values = re.escape(line).replace(r"\{\}", r"(%s|\{[^`]*?\}|[\w.]+)")
    assert re.search(values, (ROOT / "leco_plugin" / file).read_text())
    (table,) = re.findall(r"\| line \| .*?\n\n", PAGE, re.DOTALL)
    assert re.search(values, table)


def test_its_own_sections_are_found() -> None:
    titles = re.findall(r"^## (.*)$", PAGE, re.MULTILINE)
    anchors = {re.sub(r"[^\w -]", "", title).lower().replace(" ", "-") for title in titles}
    assert set(re.findall(r"\]\(#([\w-]+)\)", PAGE)) <= anchors
