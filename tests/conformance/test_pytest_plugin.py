"""`pytest --pyargs leco_plugin.conformance --leco-sampler NAME`, run as third parties run it."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from conformance.mutant_plugin import write_distribution

ROOT = Path(__file__).resolve().parents[2]
pytestmark = pytest.mark.xdist_group("runs of pytest")  # one process imports nerfstudio for all


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Where the mutants are installed, and the entry point for pytest as pyproject.toml has it."""
    project = (ROOT / "pyproject.toml").read_text()
    declared = re.search(r'\[project\.entry-points\.pytest11\]\n"?([\w.]+)"? = "([\w.]+)"', project)
    assert declared is not None
    section = f"[pytest11]\n{declared[1]} = {declared[2]}"
    return write_distribution(tmp_path_factory.mktemp("installed"), section)


def run(
    folder: Path, work: Path, *asked: tuple[str, ...], first: str = ""
) -> list[tuple[int, str]]:
    """Exit status and output of each of these runs of pytest, one after another in one process.

    Warnings are errors, and the working directory is a folder of its own. Code may run `first`.
    """
    path = os.pathsep.join([str(folder), str(ROOT / "tests"), str(ROOT)])
    strict = ["-W", "error", "-p", "no:dash", "-p", "no:cacheprovider", "-v"]
    runs = [[*strict, *arguments] for arguments in asked]
    done = subprocess.run(
        [sys.executable, "-c", first + SEVERAL_RUNS, json.dumps(runs)],
        cwd=work,
        env={**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    assert done.returncode == 0, done.stdout
    parts = re.split(r"^ended with (\d+)\n", done.stdout, flags=re.MULTILINE)
    return [(int(status), said) for said, status in zip(parts[::2], parts[1::2])]


SEVERAL_RUNS = """
import json, sys, pytest
for arguments in json.loads(sys.argv[1]):
    status = pytest.main(arguments)
    print(f"ended with {int(status)}", flush=True)
"""
PYARGS = ("--pyargs", "leco_plugin.conformance")
CHECKED = (
    *("--leco-sampler", "SoundProposal", "--leco-sampler", "KeepsAll"),
    *("--leco-method", "SoundHost", "--leco-method", "FlatAccumulation"),
    *("-k", "signature or skips or drawn"),
)
REFUSED = {
    (): "name what to check: --leco-sampler NAME",
    ("--leco-sampler", "grit"): "there is no sampler 'grit'; there are",
    ("--leco-method", "ngp"): "there is no method 'ngp'; there are",
}


@pytest.fixture(scope="module")
def answers(folder, tmp_path_factory) -> dict[tuple[str, ...], tuple[int, str]]:
    """Exit status and output by options; in one process, for each would import nerfstudio."""
    asked = [CHECKED, *REFUSED]
    work = tmp_path_factory.mktemp("work")
    runs = [(*PYARGS, *options) for options in asked]
    return dict(zip(asked, run(folder, work, *runs, first="import quick_imports")))


def test_one_test_a_rule_and_seam(answers):
    status, said = answers[CHECKED]
    assert status == 1, said
    assert "test_rule[SoundProposal-proposal-signature] PASSED" in said
    assert "test_rule[SoundProposal-proposal-skips-only-what-it-may] PASSED" in said
    assert "test_rule[KeepsAll-estimator-signature] PASSED" in said
    assert "test_rule[KeepsAll-estimator-skips-only-what-it-may] FAILED" in said
    assert "Remedy: decide by Occupancy.occupied" in said
    assert "2 failed, 4 passed" in said


def test_one_test_a_rule_of_a_method(answers):
    _, said = answers[CHECKED]
    assert "test_rule[SoundHost-host-outputs-can-be-drawn] PASSED" in said
    assert "test_rule[FlatAccumulation-host-outputs-can-be-drawn] FAILED" in said
    assert "Remedy: return rgb [n_rays, 3]" in said


@pytest.mark.parametrize("options", REFUSED)
def test_what_cannot_be_checked_is_an_error_in_one_line(answers, options):
    status, said = answers[options]
    assert status == 2
    assert REFUSED[options] in said and "Traceback" not in said


def test_other_runs_of_pytest_are_left_alone(folder, tmp_path):
    (tmp_path / "test_another.py").write_text(
        "import sys\n\ndef test_no_more_than_the_options_was_loaded(pytestconfig):\n"
        "    assert pytestconfig.getoption('leco_sampler') == []\n"
        "    ours = {name for name in sys.modules if name.startswith('leco_plugin')}\n"
        "    assert ours == {'leco_plugin', 'leco_plugin.conformance',\n"
        "                    'leco_plugin.conformance.pytest_plugin'}\n"
        "    assert not {'torch', 'nerfstudio'} & set(sys.modules)\n"
    )
    ((status, said),) = run(folder, tmp_path, ())
    assert status == 0 and "1 passed" in said, said
