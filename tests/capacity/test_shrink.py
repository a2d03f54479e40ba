"""Claims about `leco shrink` from its arguments to its file."""

from __future__ import annotations

import copy
import json
import math
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import torch
from ball_occupancy import THEIR_MARCH, ball_of_the_tiny_scene
from PIL import Image
from tiny_scene import camera_to_world

from leco_plugin import cli
from leco_plugin.capacity import references, search, shrink, sources
from leco_plugin.capacity.choice import draw_gates
from leco_plugin.capacity.evidence import Evidence, gather, loss, unlikely_at
from leco_plugin.capacity.shrink import compare_queries
from leco_plugin.evaluation.inspection import describe
from leco_plugin.evaluation.report import describe_code
from leco_plugin.learning.calibration import THRESHOLDS
from leco_plugin.learning.freezing import leave_field
from leco_plugin.models.encodings import EncodingConfig
from leco_plugin.models.figures import prices
from leco_plugin.models.gate import Gate, GateConfig
from leco_plugin.occupancy import Occupancy

DEEPER = GateConfig(EncodingConfig(octaves=3), 16, 2, 1)
WIDE_BOUNDS = ("--lost-surface-mass", 0.99, "--image-price", 50)


@pytest.fixture(autouse=True)
def few_rays(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shrink, "RAYS", 512)
    monkeypatch.setattr(shrink, "TAUGHT_RAYS", 512)
    monkeypatch.setattr(shrink, "TIMED_POSITIONS", 512)


@pytest.fixture
def ball(tmp_path: Path) -> Path:
    """The ball, and how its rays are marched; no run lies beside it."""
    occupancy = ball_of_the_tiny_scene()
    turns = [2 * math.pi * index / 9 for index in range(9)]
    cameras = [camera_to_world(turn)[:3, 3].tolist() for turn in turns]
    occupancy.report |= THEIR_MARCH | {"lost_surface_mass": 1e-4, "cameras": cameras}
    occupancy.save(tmp_path / "ball.safetensors")
    return tmp_path / "ball.safetensors"


def run(*arguments: object) -> int:
    return cli.main([str(argument) for argument in arguments])


class Shrunk(NamedTuple):
    """What a call of `leco shrink` has left."""

    results: dict[str, Any]
    smaller: Occupancy
    out: Path
    said: str


Shrinks = Callable[..., Shrunk]


@pytest.fixture
def shrunk(
    tiny_scene: Path,
    tmp_path: Path,
    printed: Any,
    monkeypatch: pytest.MonkeyPatch,
) -> Shrinks:
    """Shrinks a file of the tiny scene, with gates of this size if any are given."""

    def shrink_it(file: Path, gates: list[GateConfig] | None, *options: object) -> Shrunk:
        if gates is not None:
            monkeypatch.setattr(search, "ladder", lambda most: gates)
        out = tmp_path / "new" / f"{file.stem}-small"
        arguments = ["--data", tiny_scene, "--out", out, "--json", tmp_path / "new" / "small.json"]
        assert run("shrink", file, *arguments, *options) == 0
        results = json.loads((tmp_path / "new" / "small.json").read_text())
        return Shrunk(results, Occupancy.load(out), out, printed())

    return shrink_it


def test_without_a_run_it_keeps_to_the_decisions_and_says_so(
    ball: Path, tmp_path: Path, shrunk: Shrinks, printed: Any
) -> None:
    smallest = [GateConfig(EncodingConfig(octaves=2), width, 1, 1) for width in (1, 12, 24)]
    picture, bound = tmp_path / "new" / "a.png", ("--lost-surface-mass", 0.2)
    results, smaller, out, said = shrunk(ball, smallest, *bound, "--picture", picture)
    assert "the original's keep decisions, weighed by o(x)" in said
    assert results["code"] == describe_code() and results["date"] > "2026"
    checked = results["checked"]
    assert checked["rays"] == 512 and checked["lost_surface_mass"] is None
    assert f"test photographs lose {checked['lost_decisions']:.2e}" in said
    assert "neither surface mass nor image price was measured" in said
    assert out.stat().st_size == results["to"]["bytes"] < ball.stat().st_size
    assert [rung["verdict"] for rung in results["rungs"]][-1] == "chosen"
    assert smaller.report["cameras"][1] == [0.766, 0.6428, 0.7]
    beyond = results["rungs"][-1]["verified"]["lost_surface_mass_bound"]
    assert beyond > 0.0 and smaller.report["lost_decisions"] == pytest.approx(beyond)
    unknown = ("lost_surface_mass", "lost_mass", "image_price_db")
    assert [smaller.report[name] for name in unknown] == [None] * 3
    assert prices(smaller.report) == {}
    assert run("inspect", out) == 0 and "lost_decisions: " in printed()
    again = shrunk(out, [], *bound).smaller
    assert again.report["lost_decisions"] == pytest.approx(beyond)
    assert describe(smaller)["kept_share_of_box"] == pytest.approx(
        describe(Occupancy.load(ball))["kept_share_of_box"], rel=0.1
    )
    with Image.open(picture) as image:
        assert image.size[0] > 500
    assert draw_gates(results, tmp_path / "again.png").exists()


def test_a_search_that_is_stopped_leaves_the_gates_that_it_tried(
    ball: Path, tiny_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    smallest = [GateConfig(EncodingConfig(octaves=2), width, 1, 1) for width in (1, 2)]
    monkeypatch.setattr(search, "ladder", lambda most: smallest)
    real = search.teach

    def stopped_at_the_second(config: GateConfig, *some: Any, **more: Any) -> Gate:
        if config is smallest[1]:
            raise KeyboardInterrupt
        return real(config, *some, **more)

    monkeypatch.setattr(search, "teach", stopped_at_the_second)
    out, report = tmp_path / "small", tmp_path / "small.json"
    assert run("shrink", ball, "--data", tiny_scene, "--out", out, "--json", report) == 130
    known = json.loads(report.read_text())
    assert len(known["rungs"]) == 1 and known["original"]["verdict"] == "holds"
    assert "to" not in known and not out.exists()


def test_where_none_holds_the_same_is_stored(ball: Path, tmp_path: Path, shrunk: Shrinks) -> None:
    original = Occupancy.load(ball)
    original.precision = "bfloat16"
    original.save(ball)
    _, same, out, said = shrunk(ball, [])
    assert "this is the same gate" in said
    again = shrunk(out, [], "--picture", tmp_path / "again.png")  # and once more
    assert "this is the same gate" in again.said and (tmp_path / "again.png").exists()
    assert again.results["checked"] is None
    positions = torch.rand(5000, 3) - 0.5
    assert torch.equal(same.query(positions), original.query(positions))
    assert out.stat().st_size < 0.8 * ball.stat().st_size
    assert same.report["lost_surface_mass"] == 1e-4


def test_bad_input_ends_with_one_line_and_status_2(
    ball: Path, tiny_scene: Path, tmp_path: Path, refused: Any
) -> None:
    def changed(name: str, threshold: float = 0.5, **report: object) -> Path:
        occupancy = Occupancy.load(ball).with_threshold(threshold)
        occupancy.report |= report
        occupancy.save(tmp_path / name)
        return tmp_path / name

    ball_of_the_tiny_scene().save(tmp_path / "silent")
    cameras = [[1.0, 0.1 * number, 0.7] for number in range(20)]
    before = ball.read_bytes()
    data, out = ["--data", tiny_scene], ["--out", tmp_path / "out.safetensors"]
    cases: dict[str, list[object]] = {
        "there is no folder": [ball, "--data", tmp_path / "none", *out],
        "raise --lost-surface-mass": [ball, *data, *out, "--lost-surface-mass", 0],
        "how its rays are marched": [tmp_path / "silent", *data, *out],
        "not nan": [ball, *data, *out, "--lost-surface-mass", "nan"],
        "step_size is 0.0": [changed("standing", step_size=0.0), *data, *out],
        "cone_angle is wide": [changed("wide", cone_angle="wide"), *data, *out],
        "step_size is small": [changed("aground", step_size="small"), *data, *out],
        "its threshold is 0": [changed("idle", threshold=0.0), *data, *out],
        "skips 4.0% of all candidates": [changed("foggy", empty_fraction=0.04), *data, *out],
        "of the 20 cameras": [changed("elsewhere", cameras=cameras), *data, *out],
        "is a folder": [ball, *data, "--out", tmp_path],
        "is a file that this command reads": [ball, *data, "--out", ball],
        "not a folder": [ball, *data, "--out", ball / "new" / "small"],
        "ends in none of": [ball, *data, *out, "--picture", tmp_path / "a.doc"],
        "give an occupancy.safetensors": [tmp_path / "none.safetensors", *data, *out],
    }
    for cause, arguments in cases.items():
        assert cause in refused("shrink", *arguments)
    assert not (tmp_path / "out.safetensors").exists() and ball.read_bytes() == before


def test_a_smaller_gate_answers_faster(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("leco_plugin.capacity.shrink.TIMED_POSITIONS", 1 << 14)
    small = ball_of_the_tiny_scene()
    large = Gate(GateConfig(EncodingConfig(octaves=8), 256, 4, 1))
    slow = Occupancy(large, small.space, 0.5).eval()
    ratio, times = compare_queries(slow, small)
    assert ratio > 2.0 and times[0] > times[1] > 0.0
    assert compare_queries(small, slow)[0] < 0.5


def test_the_runs_model_says_what_is_lost(file: Path, tiny_scene: Path, shrunk: Shrinks) -> None:
    original = Occupancy.load(file)
    assert original.threshold > 0.0
    bounds = ("--lost-surface-mass", 0.25, "--image-price", 0.5)
    results, smaller, _, _ = shrunk(file, None, *bounds)
    assert results["to"]["loss_measured_against"] == references.NOW
    assert smaller.num_params < original.num_params
    assert isinstance(smaller.report["image_price_db"], float)
    (lost,) = lost_on_other_rays(file, tiny_scene, smaller)
    assert lost <= smaller.report["lost_surface_mass"]


def lost_on_other_rays(file: Path, data: Path, smaller: Occupancy) -> list[float]:
    """Shares of the surface mass, by definition, one a reference, on rays that decided nothing: of
    other pixels, and from other places between the cameras."""
    source, original = sources.find_source(file, data), Occupancy.load(file)
    torch.manual_seed(99)
    pixels = sources.draw_other_pixels(source, original, 1500, [])
    seen = sources.move_between_cameras(source, pixels, seed=99)
    parts = [gather(source.mixture, original, seen)[0]]
    if source.frozen is not None:
        parts.append(gather(source.frozen, None, seen)[0])
    return [lost_of(part, smaller) for part in parts]


def lost_of(part: Evidence, smaller: Occupancy) -> float:
    """The skipped share of the worth, by definition."""
    return float((part.worth * ~smaller.occupied(part.positions)).sum() / part.worth.sum())


def test_the_file_declares_what_rays_have_lost_that_the_search_did_not_see(
    file: Path, monkeypatch: pytest.MonkeyPatch, shrunk: Shrinks
) -> None:
    """On the rays of the search only the safest places are worth anything, on others the least."""
    grounds: list[references.Ground] = []
    prepare = shrink.prepare

    def uneven(source: Any, original: Occupancy, *drawn: Any) -> references.Ground:
        ground = prepare(source, original, *drawn)
        (reference,) = ground.references
        searched, unseen = reference.search, reference.verify
        values = original.query(searched.evidence.positions)
        safest = (values >= values.quantile(0.99)).float()
        others, kept = original.query(unseen.evidence.positions), unseen.evidence.kept
        least = kept & (others <= others[kept].quantile(0.25))
        known = reference._replace(
            search=searched._replace(evidence=searched.evidence._replace(worth=safest)),
            verify=unseen._replace(evidence=unseen.evidence._replace(worth=least.float())),
        )
        grounds.append(ground._replace(references=[known]))
        return grounds[-1]

    monkeypatch.setattr(shrink, "prepare", uneven)
    results, smaller, _, said = shrunk(file, [DEEPER], *WIDE_BOUNDS)
    rung = results["rungs"][-1]
    lost = lost_of(grounds[0].references[0].verify.evidence, smaller)
    assert lost > 0.0 and rung["lost_surface_mass"] == pytest.approx(1e-4)  # of the original
    assert rung["verified"]["lost_surface_mass"] == pytest.approx(lost + 1e-4, rel=1e-3)
    (known,) = grounds[0].references
    seen, unseen = (
        loss(part.evidence, ~smaller.occupied(part.evidence.positions), unlikely_at(1)).bound
        for part in (known.search, known.verify)
    )
    verified = smaller.report["verified_lost_surface_mass"]
    assert verified == pytest.approx(unseen + 1e-4, rel=1e-3)
    assert unseen > seen
    tested = smaller.report["lost_on_test_photographs"]
    assert smaller.report["lost_surface_mass"] == max(verified, tested)
    assert ("WARNING: that is more than" in said) == (tested > verified)


@pytest.fixture
def hazy(known_run: Path, tiny_scene: Path, tmp_path: Path) -> Path:
    """What a copy of the run has left whose field at freezing has matter where the original skips:
    haze that is densest about the ball."""
    folder = shutil.copytree(known_run, tmp_path / "run")
    now = sources.find_source(folder / "occupancy.safetensors", tiny_scene)
    assert now.model is not None and now.frozen is None
    frozen = copy.deepcopy(now.model.mixture)
    with torch.no_grad():
        frozen.field.density_head.bias.fill_(0.1)
    leave_field(frozen, folder)
    return folder / "occupancy.safetensors"


def test_an_original_that_is_not_within_the_bounds_is_said_and_declared(
    hazy: Path, monkeypatch: pytest.MonkeyPatch, shrunk: Shrinks
) -> None:
    monkeypatch.setattr(shrink, "search", lambda *some, **more: pytest.fail("taught"))
    results, same, _, said = shrunk(hazy, None)
    assert "it is not within the bounds by this measure" in said
    assert "no threshold is within them, and no smaller gate is looked for" in said
    assert results["rungs"] == [] and results["original"]["bound"] > 1e-3
    declared = same.report["lost_surface_mass"]
    assert declared == results["original"]["verified"]["lost_surface_mass_bound"] > 1e-3
    assert list(results["checked"]["against"]) == [references.AT_FREEZING]
    assert 0.0 < results["checked"]["lost_surface_mass"] < declared
    positions = torch.rand(5000, 3) - 0.5
    assert torch.equal(same.query(positions), Occupancy.load(hazy).query(positions))


def test_what_is_declared_holds_against_the_field_at_the_moment_of_freezing(
    hazy: Path, tiny_scene: Path, monkeypatch: pytest.MonkeyPatch, shrunk: Shrinks
) -> None:
    monkeypatch.setattr(search, "MARGIN", 1.0)
    results, smaller, _, _ = shrunk(hazy, [DEEPER], *WIDE_BOUNDS)
    against = results["rungs"][-1]["verified_against"]
    assert [one["reference"] for one in against] == [references.NOW, references.AT_FREEZING]
    lost = lost_on_other_rays(hazy, tiny_scene, smaller)
    assert lost[1] > lost[0] + 0.01  # what the original skips counts
    verified = smaller.report["verified_lost_surface_mass"]
    assert max(lost) <= verified == max(x["bound"] for x in against)
    assert verified <= smaller.report["lost_surface_mass"]
    source, original = sources.find_source(hazy, tiny_scene), Occupancy.load(hazy)
    sides, taught = shrink.draw_rays(source, original)
    ground = shrink.prepare(source, original, sides, taught)
    now, before = (
        gather(source.mixture, original, taught)[0],
        gather(source.frozen, None, taught)[0],
    )
    assert torch.equal(ground.taught.weights, torch.maximum(now.weights, before.weights))
    assert bool((before.weights > now.weights).any()) and torch.equal(ground.taught.kept, now.kept)
    for part in (ground.references[1].search, ground.references[1].verify):
        assert part.evidence.rays == references.RAYS > sum(len(one.truth) for one in part.rendered)


def test_an_original_that_loses_too_much_is_shrunk_at_the_threshold_that_it_was_lowered_to(
    hazy: Path, monkeypatch: pytest.MonkeyPatch, shrunk: Shrinks
) -> None:
    """The field at freezing has matter down to an o(x) of 0.2, and the file keeps it from 0.99 on.

    Both thresholds, and what is kept and lost, are found again by their definitions.
    """
    given = Occupancy.load(hazy).with_threshold(0.99)
    given.save(hazy)
    real, prepare, grounds = references.gather, shrink.prepare, list[references.Ground]()

    def known(mixture: Any, occupancy: Occupancy | None, seen: Any) -> Any:
        evidence, rendered = real(mixture, occupancy, seen)
        if occupancy is None:  # the field at freezing
            matter = (given.query(evidence.positions) >= 0.2).float()
            evidence = evidence._replace(weights=matter, worth=matter)
        return evidence, rendered

    def noted(source: Any, original: Occupancy, *drawn: Any) -> references.Ground:
        grounds.append(prepare(source, original, *drawn))
        return grounds[-1]

    monkeypatch.setattr(references, "gather", known)
    monkeypatch.setattr(shrink, "prepare", noted)
    monkeypatch.setattr(references, "RAYS", 800)
    monkeypatch.setattr(shrink, "RAYS", 256)
    monkeypatch.setattr(search, "LONGER", 1)
    bound = 0.3
    options = ("--lost-surface-mass", bound, "--image-price", 50)
    results, smaller, _, said = shrunk(hazy, [DEEPER], *options)
    searched = grounds[0].references[1].search.evidence
    lost = {t: lost_of(searched, given.with_threshold(t)) for t in (0.99, *THRESHOLDS)}
    to = max(t for t, share in lost.items() if share <= search.MARGIN * bound)
    assert lost[0.99] > search.MARGIN * bound
    lower, lowered = given.with_threshold(to), results["lowered"]
    assert f"lowered from 0.99 to {to:.3g}" in said
    of_given, of_lower, of_smaller = map(search.kept_of_box, (given, lower, smaller))
    assert lowered == pytest.approx(
        {"from": 0.99, "to": to, "kept_volume": of_lower / of_given}, abs=1e-4
    )
    assert results["original"]["lost_surface_mass"] == pytest.approx(lost[to], rel=1e-3)
    rung = results["rungs"][-1]
    assert rung["verdict"] == "chosen"
    assert rung["kept_volume"] == pytest.approx(of_smaller / of_lower, abs=1e-3)
    kept = smaller.report["kept_volume_of_the_original"]
    assert kept == pytest.approx(of_smaller / of_given, abs=1e-3) and kept > 1.02
    unseen = lost_of(grounds[1].references[1].verify.evidence, smaller)
    assert unseen <= smaller.report["verified_lost_surface_mass"] <= bound


def test_an_empty_field_is_no_reference(known: tuple[sources.Source, Occupancy]) -> None:
    source, original = known
    assert source.model is not None
    with torch.no_grad():
        source.mixture.field.density_head.bias.fill_(-50.0)
    with pytest.raises(ValueError, match="renders nothing"):
        shrink.prepare(source, original, *shrink.draw_rays(source, original))


def test_a_run_whose_model_does_not_fit_is_refused_in_one_line(
    known_run: Path, tiny_scene: Path, tmp_path: Path, refused: Any
) -> None:
    broken = shutil.copytree(known_run, tmp_path / "run")
    for path in (broken / "nerfstudio_models").glob("*.ckpt"):
        state = torch.load(path, weights_only=True)
        state["pipeline"]["_model.mixture.field.density_head.weight"] = torch.zeros(1, 3)
        torch.save(state, path)
    arguments = ["--data", tiny_scene, "--out", tmp_path / "out"]
    assert "cannot be loaded" in refused("shrink", broken / "occupancy.safetensors", *arguments)
