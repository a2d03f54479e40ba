"""The nerfacc that nerfstudio does not ask for, in processes of its own; `make env` fetches it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from bare_machine import variables
from forked_commands import ForkedCommands
from small_hosts import NGP, QUICK, RAYS, sizes

OTHER = Path(sys.prefix) / "nerfacc-0.5.3"
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not OTHER.is_dir(), reason=f"there is no {OTHER}: make env"),
]
LEARNING = [
    "calibration.rays=256",
    "sizes.candidates=32",
    "sizes.learn-candidates=16",
    "sizes.field.encoding.log2-table=10",
    "sizes.gate.layers=1",
    "sizes.gate.width=8",
]


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Of a process that imports the other nerfacc."""
    found = variables(tmp_path_factory.mktemp("environment"))
    paths = [str(OTHER), *filter(None, [found.get("PYTHONPATH")])]
    return found | {"PYTHONPATH": os.pathsep.join(paths)}


@pytest.fixture
def command_there(environment: dict[str, str], tmp_path: Path) -> Iterator[ForkedCommands]:
    with ForkedCommands(environment, tmp_path) as command:
        yield command


def test_what_is_claimed_of_nerfacc_holds_there(environment: dict[str, str]) -> None:
    tests = [str(Path(__file__).with_name(f"test_nerfacc_{each}.py")) for each in ("claims", "cpu")]
    script = "import nerfacc, pytest, sys; print(nerfacc.__version__); sys.exit(pytest.main())"
    done = subprocess.run(
        [sys.executable, "-c", script, "-qrs", "-pno:cacheprovider", "-knot stock_instant", *tests],
        env={name: value for name, value in environment.items() if name != "PYTHONWARNINGS"},
        cwd=Path(__file__).parents[2],
        capture_output=True,
        text=True,
        timeout=280,
    )
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-2000:]
    assert done.stdout.startswith("0.5.3") and "older than 0.5.3" not in done.stdout


@pytest.mark.long  # the tests above ask the same functions of it
def test_leco_ngp_trains_and_is_evaluated_there(
    command_there: ForkedCommands, tiny_scene: Path, tmp_path: Path
) -> None:
    command_there(
        *("ns-train", "leco-ngp", "--data", tiny_scene, *QUICK, *RAYS, "--max-num-iterations=6"),
        *("--output-dir", tmp_path, "--experiment-name", "tiny", "--timestamp", "run"),
        *sizes(NGP, "pipeline.model.host"),
        *(f"--pipeline.model.occupancy.learning.{flag}" for flag in LEARNING),
        *("--pipeline.model.occupancy.rays=128", "--pipeline.model.occupancy.seconds=1"),
    )
    run, result = tmp_path / "tiny" / "leco-ngp" / "run", tmp_path / "eval.json"
    command_there("ns-eval", "--load-config", run / "config.yml", "--output-path", result)
    assert json.loads(result.read_text())["results"]["psnr"] > 3.0
