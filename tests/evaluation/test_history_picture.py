"""How an occupancy was learned is drawn, still and moving."""

from __future__ import annotations

from contextlib import nullcontext
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import torch
from ball_occupancy import ball
from PIL import Image, ImageColor

from leco_plugin.chart.theme import LIGHT
from leco_plugin.cli import main
from leco_plugin.evaluation import history_picture
from leco_plugin.evaluation.metrics import spread_evenly
from leco_plugin.learning.history import GateHistory


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of a run whose gate grew into the ball."""
    for name, value in {"FRAME_PIXELS": 24, "DPI": 20}.items():
        monkeypatch.setattr(history_picture, name, value)
    history, gate = GateHistory(), ball().gate
    learned = {name: value.clone() for name, value in gate.state_dict().items()}
    for look in range(3):
        share = (look + 1) / 3
        gate.load_state_dict({name: share * value for name, value in learned.items()})
        history.look(10 * look, float(look), gate, torch.tensor([0, 1]), torch.tensor([0.1, 9.0]))
    gate.load_state_dict(learned)
    history.save(tmp_path)
    ball().save(tmp_path / "occupancy.safetensors")
    return tmp_path


def looks_in(run: Path) -> GateHistory:
    return history_picture.read_history(ball(), run)


def test_a_full_disk_leaves_the_older_film(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def cut_off(_: Image.Image, target: Any, *__: Any, **___: Any) -> None:
        with nullcontext(target) if hasattr(target, "write") else Path(target).open("wb") as out:
            out.write(b"half")
        raise OSError("No space left on device")

    monkeypatch.setattr(Image.Image, "save", cut_off)
    film = tmp_path / "a.gif"
    film.write_bytes(b"older")
    with pytest.raises(OSError, match="No space left"):
        history_picture.write_film([Image.new("RGB", (4, 4))] * 2, film, 250, 8)
    assert film.read_bytes() == b"older" and [*tmp_path.iterdir()] == [film]


def test_a_gif_has_a_frame_for_each_look_and_rests_on_the_last(run: Path) -> None:
    path = run / "learned.gif"
    assert main(["inspect", str(run / "occupancy.safetensors"), "--history", str(path)]) == 0
    with Image.open(path) as film:
        assert film.n_frames == 3
        film.seek(0)
        first, seen = film.convert("RGB").tobytes(), film.info["duration"]
        film.seek(2)
        assert film.convert("RGB").tobytes() != first and film.info["duration"] > 4 * seen


@pytest.mark.parametrize("name", ["learned.png", "learned.gif"])
@pytest.mark.parametrize("step", [0, 7])
def test_a_history_of_one_look_is_drawn_too(run: Path, name: str, step: int) -> None:
    history = GateHistory()
    history.look(step, 1.0, ball().gate, torch.tensor([0, 1]), torch.tensor([0.1, 9.0]))
    history.save(run)
    file = run / "occupancy.safetensors"
    assert main(["inspect", str(file), "--history", str(run / name)]) == 0
    with Image.open(run / name) as picture:
        assert picture.width >= 8 * 20


def test_a_colour_is_the_same_in_every_frame_of_a_film(tmp_path: Path) -> None:
    """Thin lines beside many other colours, which differ from frame to frame."""
    lines = [ImageColor.getrgb(colour) for colour in LIGHT.colours[:5]]
    frames = []
    for look in range(3):
        gradient = Image.linear_gradient("L").rotate(90 * look)
        frame = Image.merge("RGB", (gradient, gradient.rotate(90), Image.new("L", (256, 256), 99)))
        for number, colour in enumerate(lines):
            frame.paste(colour, (0, 10 * number, 256, 10 * number + 2))
        frames.append(frame)
    history_picture.write_film(frames, tmp_path / "film.gif", 100, history_picture.FRAME_COLOURS)
    with Image.open(tmp_path / "film.gif") as film:
        shown = []
        for look in range(film.n_frames):
            film.seek(look)
            picture = film.convert("RGB")
            shown.append([picture.getpixel((128, 10 * number)) for number in range(len(lines))])
    assert len(shown) == 3 and shown[0] == shown[1] == shown[2]
    for wanted, seen in zip(lines, shown[0]):
        assert isinstance(seen, tuple)
        assert max(abs(a - b) for a, b in zip(wanted, seen)) <= 8


def test_a_long_history_is_shown_evenly(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert spread_evenly(3, 16) == [0, 1, 2] and spread_evenly(1, 16) == [0]
    shown = spread_evenly(200, 16)
    assert (shown[0], shown[-1], len(shown)) == (0, 199, 16)
    steps = [b - a for a, b in pairwise(shown)]
    assert max(steps) - min(steps) <= 1
    monkeypatch.setattr(history_picture, "MOST_FRAMES", 2)
    with Image.open(history_picture.draw_history(ball(), looks_in(run), run / "short.gif")) as film:
        assert film.n_frames == 2


def test_lines_of_a_film_end_at_its_look(run: Path) -> None:
    film = history_picture._Film(ball(), looks_in(run))
    for look, figure in enumerate(film.moving([0, 1, 2])):
        for axes in figure.axes[2:]:
            assert [list(line.get_xdata()) for line in axes.lines] == [[0, 10, 20][: look + 1]] * 3
        for axes, ends in zip(figure.axes[2:], ((50.0, 50.0, 0.0), (0.1, 9.0, 0.0))):
            assert [line.get_ydata()[-1] for line in axes.lines] == pytest.approx(ends)
            assert axes.get_xlim() == (0.0, 20.0)
    box = history_picture.interesting_box(ball(), history_picture.cameras_of(ball()))
    low, high = history_picture.heights_seen_from_above(history_picture.kept_cells(ball(), box))
    (above, height), (beside, y) = film.places
    assert (above, beside) == (2, 1) and height == pytest.approx(low + 0.12 * (high - low))
    assert y == pytest.approx(2.0, abs=0.1)  # the ball's middle


def test_a_still_picture_is_drawn_too(run: Path) -> None:
    path = history_picture.draw_history(ball(), looks_in(run), run / "learned.png")
    with Image.open(path) as picture:
        assert picture.width > 100


def test_a_run_without_a_history_is_told_how_to_get_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "occupancy.safetensors"
    ball().save(file)
    places = ["--picture", str(tmp_path / "a.png"), "--history", str(tmp_path / "a.gif")]
    assert main(["inspect", str(file), *places]) == 2
    printed = capsys.readouterr()
    assert "steps-per-record" in printed.err.splitlines()[-1]
    assert printed.out == "" and [*tmp_path.iterdir()] == [file]  # before anything is drawn
