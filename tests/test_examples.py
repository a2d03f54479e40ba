"""The programs of `examples` run as they stand, and do what they say."""

from __future__ import annotations

import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from ball_occupancy import ball
from forked_commands import ForkedCommands

from leco_plugin.cli import main
from leco_plugin.models.encodings import EncodingConfig
from leco_plugin.models.gate import Gate, GateConfig
from leco_plugin.occupancy import Occupancy
from leco_plugin.space import Space

FOLDER = Path(__file__).parents[1] / "examples"
PROGRAMS = sorted(FOLDER.glob("*.py"))


@pytest.mark.parametrize("program", PROGRAMS, ids=lambda path: path.stem)
def test_a_program_is_a_page_long_and_is_shown(program: Path) -> None:
    assert len(program.read_text().splitlines()) <= 60
    page = (FOLDER.parent / "docs" / "programs.md").read_text()
    assert f'--8<-- "examples/{program.name}"' in page


@pytest.mark.parametrize(
    ("name", "given", "said"),
    [
        ("plain_torch_nerfacc_loop", ["none.safetensors"], "there is no none.safetensors: give"),
        ("host_adapter", ["none.safetensors"], "there is no none.safetensors: give"),
        ("learn_an_occupancy", ["none", "runs", "2"], "there is no "),
        ("learn_an_occupancy", ["none", "runs", "few"], "invalid int value: 'few'"),
    ],
)
def test_a_program_says_in_a_line_what_is_wrong_with_what_it_is_given(
    name: str,
    given: list[str],
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    pytest.importorskip("nerfacc")
    monkeypatch.chdir(tmp_path)
    script = str(FOLDER / f"{name}.py")
    for words, status in ((given, 2), (["--help"], 0)):
        monkeypatch.setattr(sys, "argv", [script, *words])
        with pytest.raises(SystemExit) as end:
            runpy.run_path(script, run_name="__main__")
        assert end.value.code == status
    told = capsys.readouterr()
    assert f"{name}.py: error: " in told.err and said in told.err.splitlines()[-1]
    assert f"usage: {name}.py" in told.out


@pytest.mark.xdist_group("commands")
def test_an_occupancy_is_learned_and_asked(
    command: ForkedCommands, tiny_scene: Path, tmp_path: Path
) -> None:
    said = command("python", FOLDER / "learn_an_occupancy.py", tiny_scene, tmp_path, 4)
    (file,) = tmp_path.rglob("occupancy.safetensors")
    occupancy = Occupancy.load(file)
    assert f"{occupancy.num_params} values, threshold {occupancy.threshold:.3f}" in said
    assert f"skips {occupancy.report['empty_fraction']:.1%} for" in said
    (kept,) = re.findall(r"of its space ([\d.]+)% is kept", said)
    assert 0.0 < float(kept) <= 100.0


def test_a_loop_of_nerfacc_learns_without_nerfstudio(tmp_path: Path) -> None:
    pytest.importorskip("nerfacc")
    script = FOLDER / "plain_torch_nerfacc_loop.py"
    assert "nerfstudio" not in script.read_text()
    torch.manual_seed(0)
    report = {"near": 0.05, "far": 3.0}
    small = GateConfig(EncodingConfig(octaves=2), width=16, layers=1)  # its cells are cached
    occupancy = Occupancy(Gate(small), Space("contraction"), threshold=0.7, report=report)
    occupancy.save(tmp_path / "occupancy.safetensors")
    command = [sys.executable, str(script), str(tmp_path / "occupancy.safetensors"), "30"]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    losses = [float(line.split("loss ")[1].split(",")[0]) for line in result.stdout.splitlines()]
    assert losses[-1] < losses[0]


def test_the_host_adapter_moves_samples_to_what_is_occupied(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    ball().save(tmp_path / "ball.safetensors")
    script = str(FOLDER / "host_adapter.py")
    monkeypatch.setattr(sys, "argv", [script, str(tmp_path / "ball.safetensors")])
    runpy.run_path(script, run_name="__main__")
    own, guided = map(int, re.findall(r"(\d+)% of samples", capsys.readouterr().out))
    assert own < 50 and guided > 90


@pytest.mark.xdist_group("forks")
@pytest.mark.usefixtures("forks")
def test_the_sampler_keeps_all_rules(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.syspath_prepend(FOLDER)
    assert main(["check", "own_sampler:SPEC"]) == 0
    assert "own_sampler:SPEC keeps all 14 rules" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("nowhere.at_all:SPEC", "nowhere.at_all:SPEC cannot be imported: No module named"),
        ("leco_plugin.samplers.registry:GROUP", "GROUP is a str, not a SamplerSpec"),
    ],
)
def test_a_sampler_that_is_not_there_is_refused(
    name: str, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["check", name]) == 2
    assert said in capsys.readouterr().err
