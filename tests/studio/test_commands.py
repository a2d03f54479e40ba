"""nerfstudio's commands end in one line where the user can act on what happened."""

from __future__ import annotations

import copy
import json
import subprocess
import sys
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from nerfstudio.scripts import train
from nerfstudio.utils import install_checks
from nerfstudio.utils.eval_utils import eval_setup

from leco_plugin.method_configs import leco_occupancy
from leco_plugin.scenes.input_error import InputError, TrainingStopped
from leco_plugin.studio.commands import (
    is_ns_command,
    line_of,
    quiet_imports_of_our_methods,
    render_images_without_ffmpeg,
)

FORKS = """
import json, os, sys
import quick_imports
import nerfstudio.engine.trainer, nerfstudio.pipelines.base_pipeline  # most of the seconds
assert "leco_plugin.method_configs" not in sys.modules
log, programs = sys.argv[1], json.loads(sys.argv[2])
for number, (arguments, code) in enumerate(programs):
    child = os.fork()
    if child == 0:
        os.dup2(os.open(f"{log}{number}", os.O_CREAT | os.O_WRONLY), 2)
        sys.argv = arguments
        try:
            exec(code)
        except BaseException:
            sys.excepthook(*sys.exc_info())
            sys.stderr.flush()
            os._exit(1)
        os._exit(0)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""
"""Runs each program of a list, as the arguments and the code of a process of Python. A fork reports
its error as Python does, but does not take down what was imported, which takes three seconds."""
RAISE = """
from leco_plugin.scenes.input_error import InputError
import leco_plugin.method_configs
raise {}
"""
"""A program that ends in an error once it has imported this package."""
MODULE = "import runpy; runpy.run_module('nerfstudio.scripts.eval', None, '__main__', True)"
"""What `python -m nerfstudio.scripts.eval` runs."""
PROGRAMS = [
    ("ns-train", "InputError('a line')", "a line\n"),
    ("nerfstudio/scripts/train.py", "InputError('a line')", "a line\n"),
    ("ns-train", "ValueError('a line')", "Traceback"),
    ("notebook", "InputError('a line')", "Traceback"),
]


@dataclass
class Ended:
    """Exit statuses of programs, what each printed to stderr, and the config that the last read."""

    statuses: list[str]
    printed: list[str]
    config: Path


@pytest.fixture(scope="module")
def ended(tmp_path_factory: pytest.TempPathFactory) -> Ended:
    """Of `PROGRAMS`, and of a module of nerfstudio that opens a run of another version."""
    folder = tmp_path_factory.mktemp("ended")
    config = written(folder, "leco_plugin.models.leco_config.Leco", "leco_plugin.gone.Leco")
    programs = [([program], RAISE.format(error)) for program, error, _ in PROGRAMS]
    programs.append((["eval", "--load-config", str(config)], MODULE))
    command = [sys.executable, "-c", FORKS, f"{folder}/", json.dumps(programs)]
    tests = Path(__file__).parents[1]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tests)
    statuses = done.stdout.split()
    assert len(statuses) == len(programs), done.stderr
    printed = [(folder / str(number)).read_text() for number in range(len(programs))]
    return Ended(statuses, printed, config)


ONE_PROCESS = pytest.mark.xdist_group("ended")
"""For tests that share `ended`."""


def line_from(call: Any, *arguments: Any) -> str | None:
    """What a command would say of the error that a call ends in."""
    try:
        call(*arguments)
    except Exception as error:  # noqa: BLE001 (whichever it is)
        return line_of(error)
    raise AssertionError("nothing was raised")


def written(folder: Path, old: str, new: str) -> Path:
    """The config of a run that some other version has made."""
    text = yaml.dump(leco_occupancy.config)
    assert old in text
    path = folder / "config.yml"
    path.write_text(text.replace(old, new))
    return path


@pytest.mark.parametrize(
    ("program", "theirs"),
    [
        ("/usr/bin/ns-train", True),
        ("/lib/site-packages/nerfstudio/scripts/train.py", True),
        ("/lib/nerfstudio/scripts/viewer/run_viewer.py", True),
        ("/home/nerfstudio/my/scripts/train.py", False),
        ("notebook", False),
        ("", False),
    ],
)
def test_programs_of_nerfstudio_are_known(program: str, theirs: bool) -> None:
    assert is_ns_command(program) == theirs


@ONE_PROCESS
def test_a_command_prints_the_line_alone(ended: Ended) -> None:
    for (program, _, said), status, printed in zip(PROGRAMS, ended.statuses, ended.printed):
        assert status == "1", printed
        assert printed.endswith(said) if said != "Traceback" else said in printed, program
        assert ("Traceback" in printed) == (said == "Traceback"), program


def test_a_stopped_run_is_a_runtime_error_and_a_line() -> None:
    assert issubclass(TrainingStopped, RuntimeError)
    assert not issubclass(TrainingStopped, SystemExit)
    assert line_of(TrainingStopped("step 3: a reason")) == "step 3: a reason"
    assert line_of(InputError("a line")) == "a line"


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("leco_plugin.models.leco_config.Leco", "leco_plugin.models.configs_of_old.Leco"),
        ("leco_plugin.models.leco_config.Leco", "leco_plugin.gone.leco_config.Leco"),
        ("leco_plugin.models.leco_config.Leco", "leco_plugin.models.leco_config.Old"),
        ("name:leco_plugin.models.leco.Leco", "name:leco_plugin.models.leco.Old"),
    ],
    ids=["module", "package", "class", "target"],
)
def test_a_run_of_another_version_is_one_line(old: str, new: str, tmp_path: Path) -> None:
    path = written(tmp_path, old, new)
    said = f"the run {path} is of another version of leco_plugin: train again, or install the "
    found = line_from(eval_setup, path)
    assert found is not None and found.startswith(said) and "\n" not in found
    config = copy.deepcopy(leco_occupancy.config)
    config.load_config = path
    assert line_from(train.main, config) == found


def test_a_config_that_lacks_a_field_of_today_is_of_another_version(tmp_path: Path) -> None:
    config = copy.deepcopy(leco_occupancy.config)
    del config.pipeline.datamanager.__dict__["pixel_sampler"]
    path = tmp_path / "config.yml"
    path.write_text(yaml.dump(config))

    def eval_setup_later() -> None:
        eval_setup(path, update_config_callback=lambda c: c.pipeline.datamanager.pixel_sampler)

    found = line_from(eval_setup_later)
    assert found is not None and f"{path} is of another version" in found


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("nerfstudio.configs.base_config.ViewerConfig", "nerfstudio.configs.base_config.Old"),
        ("leco_plugin.models.leco_config.Leco", "leco_plugin.samplers.lacks_a_library.Leco"),
    ],
    ids=["nerfstudio's", "a library"],
)
def test_what_is_missing_elsewhere_keeps_its_traceback(
    old: str, new: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "lacks_a_library.py").write_text("import a_library_that_is_not_here\n")
    from leco_plugin import samplers

    monkeypatch.setattr(samplers, "__path__", [*samplers.__path__, str(tmp_path)])
    assert line_from(eval_setup, written(tmp_path, old, new)) is None


@ONE_PROCESS
def test_a_module_of_nerfstudio_that_is_run_ends_in_the_line_too(ended: Ended) -> None:
    printed = ended.printed[-1]
    last = printed.strip().splitlines()[-1]
    said = f"the run {ended.config} is of another version"
    assert ended.statuses[-1] == "1" and last.startswith(said)
    assert "Traceback" not in printed


def test_only_a_film_needs_ffmpeg(monkeypatch: pytest.MonkeyPatch) -> None:
    theirs = install_checks.check_ffmpeg_installed
    monkeypatch.setattr(install_checks, "check_ffmpeg_installed", theirs)
    monkeypatch.setenv("PATH", "")
    monkeypatch.setattr(sys, "argv", ["ns-process-data", "images"])
    render_images_without_ffmpeg()
    assert install_checks.check_ffmpeg_installed is theirs
    monkeypatch.setattr(sys, "argv", ["ns-render", "interpolate", "--output-format", "images"])
    render_images_without_ffmpeg()
    install_checks.check_ffmpeg_installed()
    sys.argv.pop()
    with pytest.raises(InputError, match="ffmpeg, which is not installed: add --output-format"):
        install_checks.check_ffmpeg_installed()


@pytest.mark.parametrize("views", [0, 1])
def test_a_path_through_one_photograph_is_a_line(views: int) -> None:
    from nerfstudio.cameras.camera_utils import get_interpolated_poses_many

    with pytest.raises(ValueError) as error:
        get_interpolated_poses_many(torch.eye(3, 4).expand(views, 3, 4), torch.eye(3)[None])
    said = line_of(error.value)
    assert said is not None and f"there are {views} " in said and "--pose-source train" in said


@pytest.mark.parametrize(
    ("arguments", "hidden"),
    [
        (["ns-eval"], True),
        (["nerfstudio/scripts/render.py", "interpolate"], True),
        (["ns-train", "leco-ngp"], True),
        (["ns-train", "switch-nerf"], True),
        (["ns-train", "nerfacto"], False),
        (["notebook"], False),
        ([], False),  # of a program that Python is a part of
    ],
)
def test_warnings_of_no_use_are_hidden_but_where_another_method_trains(
    arguments: list[str], hidden: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", arguments)
    with warnings.catch_warnings(record=True) as shown:
        warnings.simplefilter("always")
        quiet_imports_of_our_methods()
        said = "Using a non-tuple sequence for multidimensional indexing is deprecated"
        warnings.warn_explicit(said, UserWarning, "cameras.py", 601, "nerfstudio.cameras.cameras")
    assert (not shown) == hidden
