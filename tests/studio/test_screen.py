"""The screen of a run is short and says what matters; the details are in its log file."""

from __future__ import annotations

import copy
import re
import sys
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import rich
import torch
from nerfstudio.scripts.train import main
from nerfstudio.utils import profiler, writer
from nerfstudio.utils.rich_utils import CONSOLE
from tiny_run import tiny_config

from leco_plugin.evaluation import held_out_psnr
from leco_plugin.evaluation.inspection import describe, doubts
from leco_plugin.host_configs import leco_ngp
from leco_plugin.models.encodings import EncodingConfig
from leco_plugin.models.gate import GateConfig
from leco_plugin.occupancy import Occupancy
from leco_plugin.studio.run_progress import LOG, next_commands, short_screen

MOST_LINES = 40


def watched(scene: Path, outputs: Path) -> Any:
    """The config of a short run whose screen somebody watches."""
    config = tiny_config(scene, outputs, candidates=32)
    gate = GateConfig(EncodingConfig(octaves=2), width=8, layers=1)
    config.pipeline.model.sizes = replace(config.pipeline.model.sizes, gate=gate)
    config.logging.local_writer.enable = True
    config.max_num_iterations = 12
    return config


@pytest.fixture(autouse=True)
def nothing_left_over(monkeypatch: pytest.MonkeyPatch) -> None:
    """nerfstudio keeps writers and profilers of a process for ever."""
    monkeypatch.setattr(writer, "EVENT_WRITERS", [])
    monkeypatch.setattr(profiler, "PROFILER", [])
    monkeypatch.setattr(held_out_psnr, "FIRST_AFTER", 0.0)


def run(config: Any, capsys: pytest.CaptureFixture[str]) -> tuple[list[str], str, Path]:
    """Trains as `ns-train` does: lines on the screen, the log file, and the run's folder."""
    main(config)
    out, err = capsys.readouterr()
    folder = config.get_base_dir()
    return [*out.splitlines(), *err.splitlines()], (folder / LOG).read_text(), folder


def test_the_screen_fits_and_ends_with_what_to_do_next(
    tiny_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lines, log, folder = run(watched(tiny_scene, tmp_path), capsys)
    screen = "\n".join(lines)
    assert len(lines) <= MOST_LINES
    assert re.search(r"photographs to learn from, \d+ to test with, 32 x 32; ", screen)
    assert "sizes: " in screen and "bounds: " in screen and "occupancy learned in" in screen
    assert re.search(r"finished: 12 steps in .*, \d+\.\d dB on [\d,]+ held-out pixels", screen)
    named = [line.split()[0] for line in lines[lines.index("next:") + 1 :]]
    assert named == ["ns-viewer", "ns-render", "ns-eval", "leco", "leco"]
    assert str(folder / "occupancy.safetensors") in screen
    for detail in ("DataParallelTrainerConfig(", "Caching all", "hash table", "scene units  "):
        assert detail not in screen
    for detail in ("Caching all", "hash table", "Training Finished", "wrote ", "measured in"):
        assert detail in log
    assert "\x1b" not in log


@pytest.mark.parametrize("by_tests", [True, False])
def test_a_scene_that_fails_is_said_to_fail_before_at_freezing_and_at_the_end(
    by_tests: bool,
    tiny_scene: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """At the end test photographs decide; held-out pixels are easier. Inspection repeats it."""
    if not by_tests:
        monkeypatch.setattr(held_out_psnr.HeldOutPsnr, "look_at_tests", lambda *_: None)
    screen = "\n".join(run(watched(tiny_scene, tmp_path), capsys)[0])
    before, at_freezing = screen.split("occupancy learned in")
    at_freezing, at_the_end = at_freezing.split("finished:")
    assert "training photographs are few" in before and "bounds are guessed" in before
    last = "this scene was not learned" if by_tests else "this occupancy is of little use"
    for part, said in ((at_freezing, "this scene was not learned"), (at_the_end, last)):
        assert part.count(said) == part.count("what helps: more") == 1
    (file,) = tmp_path.rglob("occupancy.safetensors")
    assert last in doubts(describe(Occupancy.load(file)))[0]


def test_a_guided_host_shows_psnr_while_it_learns_and_after(
    tiny_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    learned = watched(tiny_scene, tmp_path)
    config = copy.deepcopy(leco_ngp.config)
    for name in ("output_dir", "experiment_name", "timestamp", "vis", "data", "logging"):
        setattr(config, name, getattr(learned, name))
    config.max_num_iterations = 3
    config.pipeline.datamanager.data = tiny_scene
    learning = config.pipeline.model.occupancy.learning
    learning.schedule = replace(learning.schedule, learn_steps=20)
    learning.sizes = learned.pipeline.model.sizes
    lines, log, _ = run(config, capsys)
    assert len(lines) <= MOST_LINES
    reached = r"finished: 3 steps in .*, \d+\.\d dB on [\d,]+ held-out pixels"
    assert sum(re.search(reached, line) is not None for line in lines[-11:-8]) == 1
    learning, _, training = log.partition("occupancy learned in")
    assert "measured in" in learning and "measured in" in training


def test_verbose_keeps_nothing_from_the_screen(
    tiny_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = watched(tiny_scene, tmp_path)
    config.verbose = True
    main(config)
    screen = capsys.readouterr().out
    for detail in ("DataParallelTrainerConfig(", "Caching all", "hash table", "held-out pixels"):
        assert detail in screen
    assert not (config.get_base_dir() / LOG).exists()


def test_consoles_and_warnings_are_as_before_when_it_is_over(tmp_path: Path) -> None:
    config = watched(tmp_path, tmp_path)
    before = warnings.filters[:]
    with pytest.raises(KeyboardInterrupt), short_screen(config):
        assert CONSOLE.file is not sys.stdout and warnings.filters != before
        raise KeyboardInterrupt
    assert CONSOLE.file is rich.get_console().file is sys.stdout
    assert warnings.filters == before


def test_what_is_measured_changes_no_weight(
    tiny_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(held_out_psnr, "BETWEEN", 0.0)
    monkeypatch.setattr(held_out_psnr, "SHARE_OF_TIME", 1.0)
    weights = []
    for shown in (True, False):
        config = watched(tiny_scene, tmp_path / str(shown))
        config.logging.local_writer.enable = shown
        main(config)
        (path,) = (config.get_checkpoint_dir()).glob("*.ckpt")
        weights.append(torch.load(path)["pipeline"])
    tensors = [{k: v for k, v in each.items() if isinstance(v, torch.Tensor)} for each in weights]
    assert [key for key in tensors[0] if not torch.equal(tensors[0][key], tensors[1][key])] == []


def test_commands_are_of_what_there_is() -> None:
    viewer, film, evaluate, inspect, export = next_commands(Path("a run"), occupancy=True, tests=2)
    assert viewer == "ns-viewer --load-config 'a run/config.yml'"
    assert film.startswith("ns-render interpolate ") and "--pose-source" not in film
    assert evaluate.startswith("ns-eval ") and export.startswith("leco export 'a run/occ")
    assert inspect.endswith("'a run/occupancy.safetensors' --picture 'a run/occupancy.png'")
    _, film, *_ = next_commands(Path("run"), occupancy=True, tests=1)
    assert film.endswith("--pose-source train"), "a film is between two photographs"
    _, film = next_commands(Path("run"), occupancy=False, tests=0)
    assert film.startswith("ns-render interpolate ") and film.endswith("--pose-source train")
