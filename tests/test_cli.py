"""Claims about the command `leco`: what it writes, and how it ends."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from ball_occupancy import ball
from PIL import Image

from leco_plugin import cli


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("occupancy") / "occupancy.safetensors"
    ball().save(path)
    return path


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working directory: a folder with a file that is no occupancy."""
    monkeypatch.chdir(tmp_path)
    Path("text.safetensors").write_text("not an occupancy")
    return tmp_path


def run(*arguments: object) -> int:
    return cli.main([str(argument) for argument in arguments])


def test_help_loads_neither_torch_nor_nerfstudio() -> None:
    code = (
        "import sys\nfrom leco_plugin import cli\n"
        "try: cli.main(['--help'])\nexcept SystemExit as end: assert not end.code\n"
        "assert not {'torch', 'nerfstudio', 'matplotlib', 'numpy'} & set(sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert all(name in done.stdout for name in cli.COMMANDS)


def test_inspect_says_draws_and_writes(
    file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    picture, report = tmp_path / "new" / "picture.png", tmp_path / "other" / "report.json"
    assert run("inspect", file, "--picture", picture, "--json", report) == 0
    said = capsys.readouterr().out
    assert "o(x) >= 0.5" in said and "  empty_fraction: 0.9\n" in said
    assert picture.stat().st_size > 20_000
    facts = json.loads(report.read_text())
    assert facts["format"] == 1 and facts["bytes"] == file.stat().st_size
    assert facts["params"] == ball().num_params
    assert facts["report"]["empty_fraction"] == 0.9
    dark = tmp_path / "dark.png"
    assert run("inspect", file, "--picture", dark, "--dark") == 0
    grounds = [sum(Image.open(one).convert("RGB").getpixel((0, 0))) for one in (picture, dark)]
    assert grounds[0] > 600 > 200 > grounds[1]


def test_a_folder_of_runs_means_its_newest_occupancy(
    file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for age, name in enumerate(["newest", "older", "oldest"]):
        run_file = tmp_path / "runs" / name / "occupancy.safetensors"
        run_file.parent.mkdir(parents=True)
        run_file.write_bytes(file.read_bytes())
        os.utime(run_file, (1e9 - age, 1e9 - age))
    assert run("inspect", tmp_path / "runs") == 0
    assert f"{tmp_path / 'runs' / 'newest' / 'occupancy.safetensors'}: " in capsys.readouterr().out
    out = tmp_path / "kept.ply"
    assert run("export", tmp_path / "runs", "--format", "ply", "--out", out) == 0
    assert out.exists()


@pytest.mark.parametrize("format", ["ply", "nerfacc-grid"])
def test_export_writes_a_file_and_says_what_is_in_it(
    format: str, file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, report = tmp_path / "new" / "exported", tmp_path / "exported.json"
    arguments = ["--format", format, "--resolution", 16, "--out", out, "--json", report]
    assert run("export", file, *arguments) == 0
    facts = json.loads(report.read_text())
    assert facts["written"] == format and facts["bytes"] == out.stat().st_size > 1000
    assert ("points" if format == "ply" else "16^3") in capsys.readouterr().out


def test_city_writes_a_scene_and_says_so(tmp_path: Path) -> None:
    out, report = tmp_path / "city", tmp_path / "city.json"
    assert run("city", "--blocks", 1, "--out", out, "--json", report) == 0
    facts = json.loads(report.read_text())
    assert facts["images"] == len(list((out / "images").iterdir()))
    assert 0 < facts["test_images"] < facts["images"]
    aerial = tmp_path / "aerial"
    assert run("city", "--blocks", 1, "--out", aerial, "--aerial-only", "--json", report) == 0
    assert json.loads(report.read_text())["images"] < facts["images"]
    assert json.loads((aerial / "city.json").read_text())["capture"]["street_per_block"] == 0.0


def test_city_writes_a_sky_and_far_terrain_where_that_is_asked_for(tmp_path: Path) -> None:
    small = ["--blocks", 1, "--width", 24, "--height", 20, "--aerial-only"]
    written = {}
    for name, more in (("plain", []), ("far", ["--sky", "--far-terrain"])):
        out = tmp_path / name
        assert run("city", "--out", out, *small, *more) == 0
        described = json.loads((out / "city.json").read_text())["city"]
        assert described["sky"] == described["far_terrain"] == bool(more)
        with Image.open(next((out / "images").iterdir())) as image:
            written[name] = image.mode
    assert written == {"plain": "RGBA", "far": "RGB"}


@pytest.fixture
def few_rules(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the rules, those that take no time."""
    from leco_plugin.conformance import cases as checking

    monkeypatch.setattr(checking, "RULES", checking.RULES[:3])


def test_check_prints_a_line_for_each_rule(
    few_rules: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("check", "dense", "--json", tmp_path / "verdicts.json") == 0
    said = capsys.readouterr().out.splitlines()
    assert said[0] == "pass  estimator  signature" and said[-1] == "dense keeps all 3 rules"
    facts = json.loads((tmp_path / "verdicts.json").read_text())
    assert facts["format"] == 1 and facts["name"] == "dense"
    assert [verdict["passed"] for verdict in facts["verdicts"]] == [True] * 3


@pytest.mark.parametrize("passed", [True, False])
def test_what_is_said_while_a_rule_is_checked_is_shown_where_it_is_broken(
    passed: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from leco_plugin.conformance import cases, rules
    from leco_plugin.log import say

    def verdicts(name: str) -> Iterator[rules.Verdict]:
        say("no ray comes near")
        error = None if passed else rules.Broken("wrong")
        yield rules.Verdict(rules.RULES[0], "estimator", error)

    monkeypatch.setattr(cases, "check", verdicts)
    assert run("check", "dense") == (0 if passed else 1)
    assert ("no ray comes near" in capsys.readouterr().out) != passed


def test_check_ends_with_status_1_when_a_rule_is_broken(
    few_rules: None,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    from leco_plugin.samplers import registry

    spec = registry.SamplerSpec("no sampler at all", estimator=lambda aabb, occupancy: object())
    monkeypatch.setitem(registry.OURS, "object", spec)
    assert run("check", "object", "--json", tmp_path / "verdicts.json") == 1
    said = capsys.readouterr()
    assert said.out.count("\n") == 3 and said.out.count("Remedy: ") == 3
    assert said.err == "leco: object breaks 3 of 3 rules\n"
    assert not json.loads((tmp_path / "verdicts.json").read_text())["verdicts"][0]["passed"]


def test_city_writes_mega_nerfs_format(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, report = tmp_path / "city", tmp_path / "city.json"
    small = ["--width", 40, "--height", 32, "--block-size", 50]
    arguments = ["city", "--blocks", 1, "--out", out, *small, "--format", "mega-nerf"]
    assert run(*arguments, "--json", report) == 0
    said = capsys.readouterr().out
    assert f"ns-train leco-occupancy mega-nerf --data {out} --ray-altitude-range -" in said
    facts = json.loads(report.read_text())
    assert facts["layout"] == "mega-nerf" and facts["block_size"] == 50
    assert facts["test_images"] == len(list((out / "val/rgbs").iterdir())) > 0


def test_names_that_are_no_utf_8_are_printed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from leco_plugin.scenes.poses import command

    monkeypatch.setattr(command, "make_scene", lambda *_: {})
    monkeypatch.setattr(command, "summary", lambda _: ["not placed: " + os.fsdecode(b"\xe9.jpg")])
    assert run("poses", "photos", "--out", "scene") == 0
    assert capsys.readouterr().out.startswith("not placed: \\udce9.jpg\n")


def test_a_command_whose_output_nobody_reads_to_its_end_ends_without_a_word(
    file: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    with open(writer, "w") as out:
        monkeypatch.setattr(sys, "stdout", out)
        assert run("inspect", file) == 141
        print("more", flush=True)  # as the interpreter does at its end
    assert capfd.readouterr().err == ""


def bad_inputs(folder: Path, file: Path) -> dict[str, list[object]]:
    """Arguments that a user may well give, by what is wrong with them."""
    (folder / "text.safetensors").write_text("not an occupancy")
    (folder / "cut.safetensors").write_bytes(file.read_bytes()[:1000])
    (folder / "taken").mkdir()
    (folder / "taken" / "thesis.txt").write_text("")
    return {
        "no such file": ["inspect", folder / "none.safetensors"],
        "a folder": ["inspect", folder],
        "a foreign file": ["inspect", folder / "text.safetensors"],
        "a truncated file": ["inspect", folder / "cut.safetensors"],
        "an unknown kind of picture": ["inspect", file, "--picture", folder / "picture.xyz"],
        "json where a folder is": ["inspect", file, "--json", folder / "taken"],
        "a scene for no picture": ["inspect", file, "--data", folder],
        "a dark page for no picture": ["inspect", file, "--dark"],
        "points with levels": [
            *("export", file, "--format", "ply", "--levels", 2, "--out", folder / "kept.ply")
        ],
        "no cells": [
            *("export", file, "--format", "nerfacc-grid", "--resolution", 0),
            *("--out", folder / "grid.pt"),
        ],
        "an export where a folder is": [
            *("export", file, "--format", "ply", "--out", folder / "taken")
        ],
        "a surface of too many cells": [
            *("export", file, "--format", "ply", "--resolution", 10**15),
            *("--out", folder / "kept.ply"),
        ],
        "a grid of too many cells": [
            *("export", file, "--format", "nerfacc-grid", "--resolution", 646),
            *("--out", folder / "grid.pt"),
        ],
        "a folder of no cells": ["export", file, "--resolution", 1, "--out", folder / "all"],
        "a report where the points of a start for splats are": [
            *("export", file, "--format", "splat-init", "--out", folder / "start.json"),
            *("--json", folder / "start.ply"),
        ],
        "an export of a foreign file": [
            *("export", folder / "text.safetensors", "--format", "ply"),
            *("--out", folder / "kept.ply"),
        ],
        "no blocks": ["city", "--blocks", 0, "--out", folder / "city"],
        "a block too small": ["city", "--block-size", 3, "--out", folder / "city"],
        "no width": ["city", "--width", 0, "--out", folder / "city"],
        "a folder of other things": ["city", "--out", folder / "taken"],
        "an unknown sampler": ["check", "grit"],
        "an unknown option": [
            *("swap", "nerfacto", "--occupancy", file),
            *("--options", "cells", 64, "--", "--data", folder),
        ],
        "no time": ["demo", "--seconds", 0, "--out", folder / "demo"],
        "no number of seconds": ["demo", "--seconds", "nan", "--out", folder / "demo"],
    }


def test_bad_input_ends_with_one_line_and_status_2(
    file: Path, tmp_path: Path, refused: Any
) -> None:
    for arguments in bad_inputs(tmp_path, file).values():
        refused(*arguments)
    assert not (tmp_path / "all").exists()


@pytest.mark.parametrize(
    ("option", "command"),
    [
        ("--json", ["city", "--out", "city"]),
        ("--json", ["inspect", "text.safetensors"]),
        ("--picture", ["inspect", "text.safetensors"]),
        ("--history", ["inspect", "text.safetensors"]),
        ("--json", ["export", "text.safetensors", "--format", "ply", "--out", "kept.ply"]),
        ("--out", ["export", "text.safetensors", "--format", "ply"]),
        ("--json", ["check", "grit"]),
    ],
)
def test_a_place_that_cannot_be_written_to_is_named_before_anything_is_read_or_written(
    option: str, command: list[str], here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("taken.png").mkdir()
    assert run(*command, option, Path("taken.png")) == 2
    assert run(*command, option, Path("text.safetensors", "report.png")) == 2
    folder, below_a_file = capsys.readouterr().err.splitlines()
    assert folder == f"leco: {option} taken.png is a folder; give a file"
    assert below_a_file.startswith(f"leco: {option} ") and below_a_file.endswith("not a folder")
    assert {path.name for path in here.iterdir()} == {"text.safetensors", "taken.png"}


@pytest.mark.parametrize(
    "command",
    [
        ["inspect", "{file}", "--json", "{file}"],
        ["inspect", "{file}", "--picture", "x.png", "--json", "sub/../x.png"],
        ["inspect", "{file}", "--picture", "x.png", "--json", "x.html"],
        ["inspect", "{file}", "--picture", "x.png", "--data", "{folder}", "--json", "{scene}"],
        ["export", "{file}", "--format", "npz", "--out", "{file}"],
        ["export", "{folder}", "--format", "nerfacc-grid", "--out", "{file}"],
        ["export", "{file}", "--format", "ply", "--out", "x.ply", "--json", "x.ply"],
        ["shrink", "{file}", "--data", "{folder}", "--out", "x", "--json", "{file}"],
        ["shrink", "{file}", "--data", "{scene}", "--out", "x", "--json", "{scene}"],
        ["shrink", "{file}", "--data", "{folder}", "--out", "{points}"],
        ["inspect", "{file}", "--data", "{scene}", "--picture", "{photograph}"],
        ["inspect", "{file}", "--picture", "{photograph}"],
        ["inspect", "{file}", "--picture", "{other}"],
        ["inspect", "{file}", "--json", "{scene}"],
        ["export", "{file}", "--format", "ply", "--data", "{folder}", "--out", "{points}"],
        ["export", "{file}", "--format", "npz", "--out", "{scene}"],
        ["export", "{file}", "--out", "x", "--json", "{scene}"],
        ["swap", "nerfacto", "--occupancy", "{file}", "--json", "{file}"],
        ["swap", "nerfacto", "--occupancy", "{folder}", "--json", "{file}"],
        ["points", "{folder}", "--json", "{scene}"],
        ["capacity", "--data", "{folder}", "--out", "x", "--json", "{scene}"],
        ["chart", "--data", "{folder}", "--out", "x", "--seconds", "9", "--json", "{scene}"],
        ["chart", "--data", "{folder}", "--out", "x", "--seconds", "9", "--json", "x"],
        ["capacity", "--data", "{folder}", "--out", "x", "--json", "x"],
        ["capacity", "--data", "{folder}", "--out", "x", "--json", "x/settings.json"],
        ["stability", "--out", "x", "--cases", "flat", "--json", "x"],
        ["demo", "--seconds", "1", "--out", "x", "--json", "x"],
        ["city", "--out", "x", "--json", "x"],
    ],
)
def test_no_command_writes_over_what_it_reads_or_over_what_it_has_just_written(
    command: list[str], here: Path, refused: Any
) -> None:
    file = here / "run" / "occupancy.safetensors"
    file.parent.mkdir()
    ball().save(file)
    places = {"file": file, "folder": here, "scene": here / "transforms.json"}
    places |= {name: here / f"{name}.png" for name in ("photograph", "other", "points")}
    frames = [{"file_path": "photograph.png"}, {"file_path": "other"}]  # its ending is found
    places["scene"].write_text(json.dumps({"frames": frames, "ply_file_path": "points.png"}))
    for name in ("photograph", "other", "points"):
        places[name].write_text(name)
    (file.parent / "config.yml").write_text(f"pipeline: {{datamanager: {{data: [{here}]}}}}")
    before, arguments = file.read_bytes(), [part.format(**places) for part in command]
    assert f"leco: {command[-2]} {arguments[-1]} is a file that" in refused(*arguments)
    assert file.read_bytes() == before and not (here / "x.ply").exists()


@pytest.mark.parametrize(
    ("option", "name", "command"),
    [
        ("--json", "x.json", ["check", "grit"]),
        ("--picture", "x.png", ["inspect", "none.safetensors"]),
        ("--history", "x.gif", ["inspect", "none.safetensors"]),
        ("--out", "kept.ply", ["export", "text.safetensors", "--format", "ply"]),
        ("--out", "kept", ["export", "text.safetensors"]),
        ("--out", "city", ["city"]),
        ("--out", "demo", ["demo"]),
        ("--out", "table", ["stability"]),
    ],
)
def test_a_place_that_takes_no_new_file_is_named_before_the_work(
    option: str, name: str, command: list[str], here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(*command, option, Path("/proc", name)) == 2  # which root may write to, by its rights
    said = capsys.readouterr()
    assert said.err.startswith("leco: nothing can be written into /proc"), said.err
    assert said.err.endswith(f"name another folder with {option}\n") and not said.out


def test_a_page_that_cannot_be_written_beside_its_picture_is_named_before_the_work(
    tmp_path: Path, refused: Any
) -> None:
    (tmp_path / "x.html").mkdir()
    said = refused("inspect", tmp_path / "none.safetensors", "--picture", tmp_path / "x.png")
    assert said.endswith("x.html is a folder; give a file\n")


@pytest.mark.parametrize("option", ["--picture", "--history"])
def test_a_kind_of_picture_that_cannot_be_drawn_is_named_before_the_file_is_read(
    option: str, tmp_path: Path, refused: Any
) -> None:
    said = refused("inspect", tmp_path / "none.safetensors", option, tmp_path / "new" / "x.foo")
    assert said.startswith(f"leco: {option} ") and "ends in none of" in said and "png" in said
    assert ("gif" in said) or option == "--picture"
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("arguments", [[], ["fly"], ["inspect"], ["city", "--blocks", "many"]])
def test_a_wrong_command_line_is_bad_input_too(arguments: list[str]) -> None:
    with pytest.raises(SystemExit) as end:
        cli.main(arguments)
    assert end.value.code == 2


def test_a_misspelt_command_or_name_is_answered_with_the_one_that_it_resembles(
    capsys: pytest.CaptureFixture[str], refused: Any
) -> None:
    with pytest.raises(SystemExit) as end:
        run("pose", "photos")
    assert end.value.code == 2
    said = capsys.readouterr().err
    assert said.startswith("leco: there is no command 'pose'; did you mean poses? There are city,")
    assert said.count("\n") == 1
    for arguments, meant in [
        (["swap", "nerfact"], "nerfacto"),
        (["check", "leco-ngpp"], "leco-ngp"),
        (["check", "occupancy-gird"], "occupancy-grid"),
        (["swap", "nerfacto", "--sampler", "Dense"], "dense"),
    ]:
        assert f"; did you mean {meant}? There are " in refused(*arguments)


def test_a_swap_whose_arguments_are_not_set_apart_says_how(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(SystemExit) as end:
        run("swap", "nerfacto", "--occupancy", "FILE", "--data", "SCENE")
    assert end.value.code == 2
    said = capsys.readouterr().err
    assert said.startswith("leco: ") and said.endswith("--occupancy FILE -- --data SCENE`\n")
    assert said.count("\n") == 1
    with pytest.raises(SystemExit):
        run("swap", "nerfacto", "--ocupancy", "FILE")
    assert "--occupancy" in (said := capsys.readouterr().err) and "behind --" not in said


def test_a_swap_trains_with_what_is_asked_of_the_sampler_the_codes_and_the_scene(
    file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from nerfstudio.scripts import train

    trained: list[Any] = []
    monkeypatch.setattr(train, "main", trained.append)
    options, report = {"num_candidates": 512, "tolerance": 1e-3}, tmp_path / "swap.json"
    arguments = ["--codes", "own", "--other-scene", "--json", report, "--", "--data", tmp_path]
    given = [word for option in options.items() for word in option]
    assert run("swap", "nerfacto", "--occupancy", file, "--options", *given, *arguments) == 0
    (config,) = trained
    guided = config.pipeline.model
    assert config.method_name == "nerfacto" and config.data == tmp_path
    assert guided.occupancy.path == file and guided.occupancy.sampler == "learned-occupancy"
    assert guided.occupancy.options == options
    assert guided.codes == "own" and guided.occupancy.other_scene
    written = json.loads(report.read_text())
    assert written["options"] == options and written["codes"] == "own"
    assert run("swap", "nerfacto", "--occupancy", file) == 0
    usual = trained[-1].pipeline.model
    assert usual.codes == "small" and not usual.occupancy.other_scene


def test_a_failure_ends_with_one_line_and_status_1(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail() -> None:
        """Fails."""
        raise RuntimeError("the gate calls\nall space empty")

    monkeypatch.setitem(cli.COMMANDS, "fail", fail)
    assert run("fail") == 1
    assert capsys.readouterr().err == "leco: the gate calls all space empty\n"


def test_a_warning_is_one_line_without_its_place_in_the_code(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def warn() -> None:
        """Warns, as is shown where no test records it."""
        said = UserWarning("LPIPS is left out:\nits weights are not here")
        print(warnings.formatwarning(said, UserWarning, "metrics.py", 121), end="")

    before = warnings.formatwarning
    monkeypatch.setitem(cli.COMMANDS, "warn", warn)
    assert run("warn") == 0
    assert capsys.readouterr().out == "leco: LPIPS is left out: its weights are not here\n"
    assert warnings.formatwarning is before
