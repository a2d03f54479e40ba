"""Claims about `leco stability` from the command line."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from stability_runs import TINY, Runs

from leco_plugin import cli
from leco_plugin.scenes.whole_files import alone_in
from leco_plugin.stability import suite


@pytest.fixture
def runs(monkeypatch: pytest.MonkeyPatch) -> Runs:
    """What stands in for the processes of all runs."""
    made = Runs()
    monkeypatch.setattr(suite.Suite, "runner", lambda self, scene: made(scene))
    return made


def stability(out: Path, *words: str) -> int:
    return cli.main(["stability", "--out", str(out), "--quick", *words])


def test_all_was_run_is_success_whatever_the_verdicts_are(tmp_path: Path, runs: Runs) -> None:
    runs.psnrs = {"learned": 13.0}
    report = tmp_path / "report.json"
    words = ("--cases", "yard", "--samplers", "learned", "--json", str(report))
    assert stability(tmp_path / "out", *words) == 0
    assert '"verdict": "fail"' in report.read_text()
    assert len(runs.made) == 2


@pytest.mark.parametrize("psnr", [25.0, 24.5, 20.0])
def test_a_suite_that_is_blind_says_so(
    tmp_path: Path,
    runs: Runs,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    psnr: float,
) -> None:
    monkeypatch.setattr(suite, "FULL", replace(suite.FULL, picture=TINY.picture, views=TINY.views))
    runs.psnrs = {"learned": psnr}
    words = ["stability", "--out", str(tmp_path / "out"), "--cases", "homogeneous"]
    assert cli.main(words) == (0 if psnr == 20.0 else 1)
    assert ("homogeneous must fail" in capsys.readouterr().err) == (psnr != 20.0)


def test_a_portion_is_made_and_the_same_command_goes_on(
    tmp_path: Path, runs: Runs, printed: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(suite, "usable_cores", lambda: 1)
    words = ("--cases", "yard", "--samplers", "grid-128", "learned", "--minutes", "0.001")
    for left in (
        "2 runs are left or have failed; the same command goes on with them",
        "1 run is left or has failed; the same command goes on with it",
    ):
        assert stability(tmp_path / "out", *words) == 0
        assert left in printed()
    assert stability(tmp_path / "out", *words) == 0
    assert "left or ha" not in printed()
    assert sorted(name for _, name, _ in runs.made) == ["dense", "grid-128", "learned"]
    assert stability(tmp_path / "out", "--minutes", "0") == 2


def test_a_second_process_in_the_same_folder_is_refused_in_one_line(
    tmp_path: Path, runs: Runs, refused: Any
) -> None:
    words = ("--cases", "yard", "--samplers", "grid-128")
    with alone_in(tmp_path / "out", "table"):
        error = refused("stability", "--out", tmp_path / "out", "--quick", *words)
    assert "another process makes the table" in error
    assert not runs.made and stability(tmp_path / "out", *words) == 0


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--cases", "foog"), "no case 'foog'; did you mean fog? There are yard, poles"),
        (("--samplers", "grid"), "no sampler 'grid'; there are learned, grid-128"),
    ],
)
def test_an_unknown_name_is_one_line_and_starts_nothing(
    tmp_path: Path, refused: Any, words: tuple[str, ...], said: str
) -> None:
    assert said in refused("stability", "--out", tmp_path / "out", "--quick", *words)
    assert not (tmp_path / "out").exists()


def test_the_command_of_the_results_has_no_paths(tmp_path: Path, runs: Runs) -> None:
    stability(tmp_path / "out", "--cases", "yard", "--samplers", "grid-128", "--seeds", "0", "2")
    text = (tmp_path / "out" / "stability.json").read_text()
    words = "leco stability --out DIR --cases yard --samplers grid-128 --seeds 0 2 --quick"
    assert words in text and str(tmp_path) not in text
