"""Claims about where a guided host gets its occupancy, and about the coordinates it is asked in."""

from __future__ import annotations

import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from ball_occupancy import ball_of_the_tiny_scene
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.data.datamanagers.base_datamanager import VanillaDataManagerConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.data.pixel_samplers import PixelSamplerConfig
from nerfstudio.engine.callbacks import TrainingCallbackAttributes
from nerfstudio.model_components.ray_samplers import UniformSampler
from nerfstudio.pipelines.base_pipeline import VanillaPipelineConfig
from scene_readers import Data, Pipe, started
from torch import Tensor, nn

from leco_plugin.host_configs import leco_ngp
from leco_plugin.hosts import guided_start
from leco_plugin.hosts.guide import Guide
from leco_plugin.hosts.guided_start import (
    PLACES,
    AlongRays,
    GuidedStart,
    OccupancyConfig,
    along_rays,
)
from leco_plugin.hosts.stand_ins import GuidedEstimator
from leco_plugin.learning.quality import FIELD, ONE_COLOUR
from leco_plugin.learning.run import LearningOnly
from leco_plugin.models.encodings import EncodingConfig
from leco_plugin.models.gate import Gate, GateConfig
from leco_plugin.occupancy import Occupancy
from leco_plugin.scenes.frames import box_around, frame_of
from leco_plugin.scenes.input_error import InputError
from leco_plugin.space import Space

pytestmark = pytest.mark.usefixtures("without_cache")

NAME = "occupancy.safetensors"
STEP = 0.02
CLEAR = 1e-3
"""Decisions within this of the threshold may fall either way, by rounding alone."""


@pytest.fixture
def balls_guide() -> Guide:
    """With the ball for its occupancy."""
    guide = Guide()
    guide.set_occupancy(ball_of_the_tiny_scene())
    return guide


@pytest.fixture
def run(tmp_path: Path) -> LearningOnly:
    """With a folder."""
    run = LearningOnly()
    run.folder = tmp_path / "run"
    return run


def start(
    data: Data, guide: Guide, config: OccupancyConfig | None = None, run: LearningOnly | None = None
) -> GuidedStart:
    return GuidedStart(nn.Module(), guide, config or OccupancyConfig(), Pipe(data), run)


def lopsided(data: Data) -> Occupancy:
    """Half of the space around the ball, in no symmetric shape, as if learned by this reader."""
    torch.manual_seed(3)
    gate = Gate(GateConfig(EncodingConfig(octaves=2), 16, 1, 2))
    frame = torch.tensor(frame_of(data), dtype=torch.float32)
    center = frame[:, :3] @ torch.tensor([0.0, 0.0, 0.3]) + frame[:, 3]
    half = 0.8 * float(torch.linalg.det(frame[:, :3])) ** (1 / 3)
    made = Occupancy(gate, Space("box", tuple(center.tolist()), half), 0.0)
    around = center + half * (2.0 * torch.rand(4096, 3) - 1.0)
    made.threshold_value.fill_(float(made.query(around).median()))
    made.report = {"frame": frame.tolist()}
    return made.eval()


def in_other_coordinates(positions: Tensor, host: Data, learned: Data) -> Tensor:
    """Through the scene's own coordinates, as nerfstudio's outputs say: slow, in float64."""

    def similarity(data: Data) -> tuple[Tensor, Tensor]:
        outputs = data.train_dataparser_outputs
        transform = outputs.dataparser_transform.double()
        return outputs.dataparser_scale * transform[:, :3], outputs.dataparser_scale * transform[
            :, 3
        ]

    (a, a_shift), (b, b_shift) = similarity(host), similarity(learned)
    in_the_scene = torch.linalg.solve(a, (positions.double() - a_shift).T).T
    return (in_the_scene @ b.T + b_shift).float()


PAIRS = [("turned by pca", "as it is"), ("as it is", "turned by pca"), ("turned up", "as it is")]


@pytest.mark.parametrize(("host", "learned"), PAIRS)
def test_a_packed_host_asks_in_the_coordinates_of_the_occupancy(
    readers: dict[str, Data], host: str, learned: str
) -> None:
    occupancy = lopsided(readers[learned])
    guide = started(occupancy, readers[host])
    assert not guide.same_frame()
    rays = readers[host].train_dataset.cameras.generate_rays(0).flatten()[::7]
    march = {"render_step_size": STEP, "far_plane": 4.0}
    box = torch.tensor([-9.0] * 3 + [9.0] * 3)
    origins, directions = rays.origins, rays.directions
    indices, starts, _ = guide.estimator(box).eval().sampling(origins, directions, **march)
    dense = Guide("dense").estimator(box).eval()
    every, t_starts, t_ends = dense.sampling(origins, directions, **march)
    positions = origins[every] + directions[every] * (0.5 * (t_starts + t_ends))[:, None]
    values = occupancy.query(in_other_coordinates(positions, readers[host], readers[learned]))
    expected = values >= occupancy.threshold
    clear = ((values - occupancy.threshold).abs() > CLEAR) & (values > 0.0)
    # the same candidates: each is known by its ray and its number along it
    kept = torch.zeros(len(rays), int(4.0 / STEP) + 1, dtype=torch.bool)
    kept[indices, (starts / STEP).round().long()] = True
    found = kept[every, (t_starts / STEP).round().long()]
    assert int(expected.sum()) > 500
    assert torch.equal(found[clear], expected[clear])
    assert float(found[values == 0.0].float().mean()) < 1e-3  # outside the box of the occupancy


@pytest.mark.parametrize(("host", "learned"), PAIRS)
def test_a_proposal_host_asks_in_the_coordinates_of_the_occupancy(
    readers: dict[str, Data], host: str, learned: str
) -> None:
    occupancy = lopsided(readers[learned])
    guide = started(occupancy, readers[host])
    rays: RayBundle = readers[host].train_dataset.cameras.generate_rays(0).flatten()[::31]
    rays.nears = torch.full((len(rays), 1), 0.05)
    rays.fars = torch.full((len(rays), 1), 4.0)
    sampler = guide.proposal(num_samples=8, initial_sampler=UniformSampler()).eval()
    _, (weights,), (candidates,) = sampler(rays)
    positions = candidates.frustums.get_positions().reshape(-1, 3)
    values = occupancy.query(in_other_coordinates(positions, readers[host], readers[learned]))
    expected = values >= occupancy.threshold
    clear = ((values - occupancy.threshold).abs() > CLEAR) & (values > 0.0)
    assert int(expected.sum()) > 200
    assert torch.equal(weights.flatten()[clear] > 0.0, expected[clear])


def test_readers_that_agree_need_no_frame(readers: dict[str, Data]) -> None:
    assert started(lopsided(readers["turned up"]), readers["turned up"]).same_frame()


def test_an_occupancy_that_does_not_say_is_asked_as_it_is(readers: dict[str, Data]) -> None:
    occupancy = lopsided(readers["as it is"])
    occupancy.report = {}
    assert started(occupancy, readers["as it is"]).same_frame()


def test_a_sampler_with_a_box_gets_the_hosts_in_the_coordinates_that_it_is_asked_in(
    readers: dict[str, Data], monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: dict[str, Any] = {}

    def build(name: str, **options: Any) -> Any:
        seen.update(options)
        return torch.nn.Identity()

    monkeypatch.setattr("leco_plugin.hosts.stand_ins.build_estimator", build)
    guide = started(lopsided(readers["as it is"]), readers["turned by pca"])
    box = torch.tensor([-1.0, -1.0, -1.0, 1.0, 1.0, 1.0])
    _ = guide.estimator(box).sampler
    torch.testing.assert_close(seen["aabb"], box_around(box, guide.frame))
    guide.set_occupancy(guide.the_occupancy(), torch.eye(3, 4))
    _ = guide.estimator(box).sampler
    assert torch.equal(seen["aabb"], box)


def test_the_ball_is_found_whatever_it_was_learned_in(readers: dict[str, Data]) -> None:
    shares = []
    for learned in readers.values():
        frame = frame_of(learned)
        assert frame is not None
        guide = started(ball_of_the_tiny_scene(frame), readers["turned up"])
        cameras = readers["turned up"].train_dataset.cameras
        along = along_rays(guide, guide.the_occupancy(), cameras)
        kept, met = along.kept(guide.the_occupancy().threshold), along.lengths
        shares.append(float(kept.sum() / met.sum()))
    assert shares == pytest.approx([shares[0]] * len(shares), rel=0.05)
    assert 0.05 < shares[0] < 0.6


def test_training_says_what_was_wrong_with_a_path(data: Data, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"there is no occupancy .*none: train leco-occupancy"):
        start(data, Guide(), OccupancyConfig(tmp_path / "none"))


def test_a_checkpoint_needs_no_file(data: Data, balls_guide: Guide) -> None:
    start(data, balls_guide, OccupancyConfig(Path("deleted") / NAME))
    assert balls_guide.occupancy is not None


def test_a_resumed_run_says_that_the_file_given_is_not_the_occupancy_of_its_checkpoint(
    data: Data, balls_guide: Guide, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    told = []
    for name, changed in (("same", 0.0), ("other", 1.0)):
        file = copy.deepcopy(ball_of_the_tiny_scene())  # its gate is everybody's
        with torch.no_grad():
            next(file.gate.parameters()).add_(changed)
        file.save(tmp_path / name)
        for begins_at in (0, 90):
            (run := LearningOnly()).start = begins_at
            GuidedStart(nn.Module(), balls_guide, OccupancyConfig(tmp_path / name), Pipe(data), run)
            said = " ".join(capsys.readouterr().out.split())
            told.append("goes on with the occupancy of its checkpoint, which is not" in said)
    assert told == [False, False, False, True]


def test_a_sampler_and_a_gate_that_do_not_fit_are_refused_before_learning(data: Data) -> None:
    name = "learned-occupancy-hash"
    with pytest.raises(InputError, match=f"{name}.* asks a gate on hash features"):
        started(ball_of_the_tiny_scene(), data, name)
    learning = "--pipeline.model.occupancy.learning"
    with pytest.raises(InputError, match=f"{name}.* asks a gate on hash features.*{learning}$"):
        start(data, Guide(name), OccupancyConfig(sampler=name))


def test_a_budget_in_which_nothing_can_be_learned_is_refused_before_the_first_step(
    data: Data,
) -> None:
    for config in (OccupancyConfig(seconds=0.0), OccupancyConfig(rays=0)):
        with pytest.raises(InputError, match="an occupancy is learned"):
            start(data, Guide(), config)
    with pytest.raises(InputError, match=r"seconds is of learning first; .* along has none"):
        start(data, Guide(), OccupancyConfig(learned="along", seconds=9.0))


def leco_ngp_with(occupancy: OccupancyConfig, scene: Path) -> Any:
    """The pipeline of a method of ours."""
    config: Any = leco_ngp.config.pipeline
    data = VanillaDataManagerConfig(dataparser=NerfstudioDataParserConfig(data=scene))
    model = type(config.model)(host=config.model.host, occupancy=occupancy)
    return VanillaPipelineConfig(datamanager=data, model=model).setup(device="cpu")


def test_an_unknown_sampler_is_refused_in_a_line(tiny_scene: Path) -> None:
    with pytest.raises(InputError, match="no sampler 'lerned-occupancy'; did you mean learned"):
        leco_ngp_with(OccupancyConfig(sampler="lerned-occupancy"), tiny_scene)


def test_the_first_step_leaves_the_file_in_the_runs_folder(
    data: Data, balls_guide: Guide, run: LearningOnly
) -> None:
    begun = start(data, balls_guide, run=run)
    assert not run.folder.exists()
    begun.before_step(0)
    left = Occupancy.load(run.folder / NAME)
    assert left.report == balls_guide.the_occupancy().report
    (run.folder / NAME).unlink()
    begun.before_step(1)
    assert not (run.folder / NAME).exists()


@pytest.mark.parametrize(
    ("step", "rays", "careful"), [(0, 512, True), (7, 512, False), (0, 0, False)]
)
def test_a_packed_host_begins_carefully_and_is_opaque_by_what_it_then_keeps(
    data: Data,
    balls_guide: Guide,
    monkeypatch: pytest.MonkeyPatch,
    step: int,
    rays: int,
    careful: bool,
) -> None:
    guide, config = balls_guide, OccupancyConfig()
    calibration = config.learning.calibration
    config.learning.calibration = replace(calibration, recheck_rays=rays)
    host = nn.ModuleList([GuidedEstimator(guide, None)])
    lengths: list[Tensor] = []
    monkeypatch.setattr(
        guided_start, "begin_opaque", lambda host, guide, kept: lengths.append(kept)
    )
    GuidedStart(host, guide, config, Pipe(data)).before_step(step)
    calibrated = guide.the_occupancy().threshold
    assert (guide.followed().threshold < calibrated) == careful
    if step == 0:
        cameras = data.train_dataset.cameras
        along = along_rays(guide, guide.the_occupancy(), cameras)
        expected = along.kept(guide.followed().threshold)
        assert torch.equal(lengths[0], expected)
        whole = along.kept(calibrated)
        assert (float(expected.sum()) > float(whole.sum())) == careful


def test_before_learning_a_run_says_that_it_starts_over_where_it_is_stopped(
    data: Data, monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[str] = []

    def learn(*_: object) -> Occupancy:
        said.append("learned")
        return ball_of_the_tiny_scene()

    monkeypatch.setattr("leco_plugin.hosts.guided_start.say", said.append)
    monkeypatch.setattr("leco_plugin.hosts.learn_first.learn_occupancy", learn)
    guide = Guide()
    start(data, guide).before_step(0)
    assert "in no checkpoint until then" in said[0] and said[1] == "learned"
    assert guide.occupancy is not None


def test_a_host_that_asks_no_gate_needs_no_occupancy(tiny_scene: Path) -> None:
    occupancy = OccupancyConfig(Path("no") / "file", sampler="dense")
    pipeline = leco_ngp_with(occupancy, tiny_scene)
    attributes = TrainingCallbackAttributes(None, None, pipeline, None)  # type: ignore[arg-type]
    pipeline.get_training_callbacks(attributes)
    assert pipeline.model.leco_guide.occupancy is None


def test_batches_that_nobody_can_draw_are_refused_before_anything_is_learned(
    tiny_scene: Path,
) -> None:
    pipeline = leco_ngp_with(OccupancyConfig(), tiny_scene)
    manager = pipeline.datamanager
    manager.train_pixel_sampler = PixelSamplerConfig(num_rays_per_batch=45).setup()
    manager.train_dataset.cameras.height[0] += 1
    attributes = TrainingCallbackAttributes(None, None, pipeline, None)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="give 46"):
        pipeline.get_training_callbacks(attributes)


def test_with_a_file_nothing_is_said_of_bounds_for_learning_one(
    data: Data, monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[str] = []
    for name in ("log.note", "hosts.guided_start.say"):
        monkeypatch.setattr(f"leco_plugin.{name}", said.append)
    started(lopsided(data), data)
    (line,) = said
    assert line.startswith("guided by an occupancy that keeps ")


def test_a_host_hears_that_the_occupancy_it_is_given_is_of_little_use(
    data: Data, balls_guide: Guide, monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[str] = []
    monkeypatch.setattr(guided_start, "say_all", said.extend)
    start(data, balls_guide)
    assert said == []
    keeps_all, unlearned = ball_of_the_tiny_scene(), ball_of_the_tiny_scene()
    keeps_all.threshold_value.zero_()
    unlearned.report = {**unlearned.report, FIELD: 7.0, ONE_COLOUR: 10.4}
    for occupancy, first in ((keeps_all, "of little use"), (unlearned, "was not learned")):
        guide = Guide()
        guide.set_occupancy(occupancy)
        start(data, guide)
        assert len(said) == 2 and first in said[0] and "leco points" in said[1]
        said.clear()


def test_a_range_that_no_ray_meets_is_refused_before_the_first_step(data: Data) -> None:
    config = OccupancyConfig()
    config.learning.bounds.altitudes = (-9.0, -8.0)
    config.learning.near, config.learning.far = 1e-3, 2e-3
    guide = Guide("learned-occupancy")
    guide.set_occupancy(lopsided(data))
    with pytest.raises(InputError, match=r"^0% of the rays meet the scene"):
        start(data, guide, config)


def test_a_full_disk_does_not_end_a_run_that_has_its_occupancy(
    data: Data,
    balls_guide: Guide,
    run: LearningOnly,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    begun = start(data, balls_guide, run=run)
    monkeypatch.setattr(Occupancy, "save", full)
    begun.before_step(0)
    # where a line of the log is broken, the place in the code stands between its halves
    said = " ".join(word for word in capsys.readouterr().out.split() if ".py:" not in word)
    assert "could not be written" in said and "No space left on device" in said


@pytest.mark.parametrize(("kind", "reach"), [("box", 1.0), ("contraction", 8.0)])
def test_of_an_unbounded_scene_rays_are_looked_at_far_beyond_its_inner_cube(
    kind: Any, reach: float
) -> None:
    """Most of what a street shows lies there."""
    gate, eye = Gate(GateConfig(EncodingConfig(octaves=1), 8, 1, 2)), torch.eye(3, 4)[None]
    occupancy = Occupancy(gate, Space(kind, (0.0, 0.0, 0.0), 0.5), 0.0).eval()
    camera = Cameras(eye, 1000.0, 1000.0, 1.0, 1.0, 2, 2)  # along -z, from the middle
    found = along_rays(Guide(), occupancy, camera)
    torch.testing.assert_close(found.lengths, torch.full_like(found.lengths, 0.5 * reach))
    assert found.share_kept(0.0) == pytest.approx(1.0)


def test_an_occupancy_is_asked_evenly_between_where_a_ray_enters_and_leaves_its_box(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    gate, eye = Gate(GateConfig(EncodingConfig(octaves=1), 8, 1, 2)), torch.eye(3, 4)[None]
    eye[:, :, 3] = torch.tensor([0.2, 0.1, 3.0])
    occupancy = Occupancy(gate, Space("box", (0.2, 0.0, 1.0), 0.5), 0.0).eval()
    monkeypatch.setattr(occupancy, "query", lambda places: places[:, 2])
    found = along_rays(Guide(), occupancy, Cameras(eye, 1000.0, 1000.0, 1.0, 1.0, 2, 2))
    expected = 1.5 - (torch.arange(PLACES) + 0.5) / PLACES
    torch.testing.assert_close(found.values, expected.expand_as(found.values), atol=1e-3, rtol=0.0)
    torch.testing.assert_close(found.lengths, torch.ones(len(found.lengths)), atol=1e-3, rtol=0.0)
    behind = Occupancy(gate, Space("box", (0.2, 0.0, 5.0), 0.5), 0.0).eval()
    assert len(along_rays(Guide(), behind, Cameras(eye, 9.0, 9.0, 1.0, 1.0, 2, 2)).lengths) == 0


def test_what_is_kept_of_rays_counts_by_their_lengths() -> None:
    along = AlongRays(torch.tensor([[0.1, 0.6], [0.5, 0.5], [0.2, 0.4]]), torch.tensor([2.0, 6, 4]))
    assert along.kept(0.5).tolist() == [1.0, 6.0, 0.0]
    assert along.share_kept(0.5) == pytest.approx(7.0 / 12.0)
    assert along.share_kept(0.2) == pytest.approx(11.0 / 12.0)
