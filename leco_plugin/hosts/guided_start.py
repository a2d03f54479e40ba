"""Where a guided host gets its occupancy: from a file, or learned first; in its own coordinates."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import torch
from torch import Tensor, nn

from leco_plugin.evaluation.inspection import cameras_of, describe, doubts
from leco_plugin.hosts.guide import Guide
from leco_plugin.hosts.host_watch import begin_carefully, begin_opaque
from leco_plugin.learning.freezing import FILE_NAME, leave_file
from leco_plugin.learning.run import LearningOnly, Run
from leco_plugin.log import say, say_all
from leco_plugin.models.leco_config import LecoModelConfig
from leco_plugin.models.sizing.sizes import SMALL, learning_only
from leco_plugin.occupancy import Occupancy
from leco_plugin.samplers.boxes import intersect_box
from leco_plugin.samplers.registry import check_gate
from leco_plugin.scenes.frames import between, found_again, frame_of, moved, turned
from leco_plugin.scenes.input_error import InputError
from leco_plugin.scenes.survey import MOST_CAMERAS, covering_rays, sparse_points, survey

if TYPE_CHECKING:
    from leco_plugin.hosts.along import Along

PLACES = 128
"""Positions on each ray at which a file is asked whether it fits the cameras."""
SAME_SCENE = 0.1
"""Share of cameras, of the fewer, that an occupancy and a run on its scene have in common."""
ROUNDED = 10.0
"""A reader that rounds coordinates moves cameras by less than so many times `SAME_PLACE`."""
POINTS = 1 << 14
"""Most sparse points that are looked at."""
KEPT_POINTS = 0.5
"""Share of a scene's sparse points that an occupancy of the scene keeps at least."""

LEARNING = (
    "the occupancy is learned first, in steps of its own. It is in no checkpoint until then: a run "
    "that is stopped before starts over. A run of leco-occupancy can be gone on with, and its "
    "folder be given here with --pipeline.model.occupancy.path (leco swap: --occupancy)"
)

OWN_SAMPLER = "own"
"""Name of no sampler: the host keeps its own."""


@dataclass
class OccupancyConfig:
    """What guides the host."""

    path: Path | None = None
    """An occupancy.safetensors, or the folder of a run that left one. None learns the occupancy
    first, in this run."""
    other_scene: bool = False
    """Whether the file may be of another scene, as far as its cameras say."""
    sampler: str = "learned-occupancy"
    """Name in the registry of samplers. For comparison: `dense`, `occupancy-grid`, and `own`, which
    leaves the host as it is."""
    options: dict[str, int | float] = field(default_factory=dict)
    """Of that sampler, by name: resolution 256 levels 4."""
    opaque_start: bool = True
    """Packed hosts: begin with a density that makes what is kept of a ray opaque, where the host's
    own would not. Before a random background a transparent start may never recover."""
    learned: Literal["first", "along"] = "first"
    """first: without a path, an HMoE learns the occupancy before the host's first step. along: the
    host trains at once, within the scene's bounds, and its own rendering weights teach a small gate
    now and then; for packed hosts, in one process."""
    seconds: float | None = None
    """Without a path: about how long learning may take at most; None is until it has settled."""
    rays: int = 1024
    """Without a path: rays of a batch while learning."""
    rate: float = 1.0
    """Without a path: multiple of the learning rates while learning."""
    learning: LecoModelConfig = field(
        default_factory=lambda: LecoModelConfig(sizes=learning_only(SMALL))
    )
    """Without a path: the HMoE that learns."""


def occupancy_file(path: Path) -> Path:
    """The file that `path` means: itself, or the newest occupancy in the folder of a run. No error
    where there is none: a checkpoint brings its own."""
    if not path.is_dir():
        return path
    found = sorted(path.rglob(FILE_NAME), key=lambda file: file.stat().st_mtime)
    return found[-1] if found else path / FILE_NAME


def load_occupancy(path: Path) -> Occupancy:
    """The occupancy that `path` means. InputError if there is none, or it cannot be read."""
    file = occupancy_file(path)
    try:
        return Occupancy.load(file)
    except FileNotFoundError:
        raise InputError(
            f"there is no occupancy {file}: train leco-occupancy on this scene and give its run "
            "folder (guided methods like leco-ngp learn it first where no path is given)"
        ) from None
    except (OSError, ValueError) as error:
        raise InputError(f"no occupancy can be read: {error}") from None


def say_if_another(occupancy: Occupancy, path: Path | None) -> None:
    """Says so where a run goes on with the occupancy of its checkpoint, and the file that `path`
    means has another gate. A file that is gone says nothing."""
    if path is None:
        return
    with suppress(InputError):
        if not load_occupancy(path).gate.decides_as(occupancy.gate):
            say(f"goes on with the occupancy of its checkpoint, which is not that of {path}")


class GuidedStart:
    """The start of one training run of a guided host. A guide has an occupancy already where a file
    or a checkpoint gave one; without a run no file is left, and a teacher leaves its own.

    InputError if the file is not there or cannot be read; its occupancy keeps nothing that the
    cameras see, and this run has not begun with it; its gate is none that the sampler asks; or
    nothing can be learned in the time or with the rays that are given.
    """

    def __init__(
        self,
        host: nn.Module,
        guide: Guide,
        config: OccupancyConfig,
        pipeline: Any,
        run: Run | None = None,
        teacher: Along | None = None,
    ) -> None:
        self.host, self.guide, self.config, self.teacher = host, guide, config, teacher
        self.pipeline, self.run = pipeline, run or LearningOnly()
        self.begun = False
        if guide.occupancy is None and config.path is not None:
            guide.set_occupancy(load_occupancy(config.path))  # says why it could not be before
        elif guide.occupancy is not None and self.run.start > 0 and config.learned == "first":
            say_if_another(guide.occupancy, config.path)
        if guide.occupancy is None:
            from leco_plugin.hosts.learn_first import check_budget

            check_budget(config.rays, config.seconds, config.rate)
            if config.learned == "along" and config.seconds is not None:
                raise InputError(
                    "--pipeline.model.occupancy.seconds is of learning first; a host that learns "
                    "along has none"
                )
        learned = guide.occupancy.gate.config if guide.occupancy is not None else None
        own, small = config.learning.sizes.gate, config.learning.sharpening.gate
        try:
            check_gate(guide.sampler, learned or (small if config.learned == "along" else own))
        except ValueError as error:
            here = "; or here, with that option at --pipeline.model.occupancy.learning"
            raise InputError(f"{error}{'' if learned else here}") from None
        self.along = None if guide.occupancy is None else self._fit(guide.occupancy)

    def before_step(self, step: int) -> None:
        """Learns the occupancy if there is none yet, and leaves its file in the run's folder. A
        packed host begins carefully, and opaque."""
        if self.begun:
            return
        self.begun = True
        if self.teacher is not None:
            self.teacher.begin()
        if self.guide.occupancy is None:
            from leco_plugin.hosts.learn_first import learn_occupancy

            say(LEARNING)
            config = self.config
            occupancy = learn_occupancy(
                config.learning, self.pipeline, config.rays, config.seconds, config.rate
            )
            self.guide.set_occupancy(occupancy)
        self.guide.look(self.pipeline.datamanager.train_dataset.cameras)
        watches = self.config.learning.calibration.recheck_rays > 0
        if step == 0 and watches:
            begin_carefully(self.host, self.guide, self._skipped)
        if step == 0 and self.config.opaque_start:
            kept = self._along_rays().kept(self.guide.followed().threshold)
            begin_opaque(self.host, self.guide, kept)
        if self.run.folder is not None and self.teacher is None:
            leave_file(self.guide.the_occupancy(), self.run.folder)

    def _along_rays(self) -> AlongRays:
        """The occupancy along the run's rays, asked once."""
        if self.along is None:
            cameras = self.pipeline.datamanager.train_dataset.cameras
            self.along = along_rays(self.guide, self.guide.the_occupancy(), cameras)
        return self.along

    def _skipped(self, occupancy: Occupancy) -> float:
        """Share of the run's rays that its occupancy skips at the threshold of this one."""
        return 1.0 - self._along_rays().share_kept(occupancy.threshold)

    def _fit(self, occupancy: Occupancy) -> AlongRays:
        """Finds how the occupancy's coordinates lie in the host's, and whether they are of one
        scene; returns it along the rays of the cameras."""
        manager = self.pipeline.datamanager
        learned_in, host = occupancy.report.get("frame"), frame_of(manager)
        if learned_in is not None and host is not None:
            self.guide.frame.copy_(between(host, learned_in))
            self.guide.changed()
            insists = self.config.other_scene or self.run.start > 0
            refuse_another_scene(occupancy, manager, self.guide.frame, insists)
        along = along_rays(self.guide, occupancy, manager.train_dataset.cameras)
        share = along.share_kept(occupancy.threshold)
        if share == 0.0 and self.run.start == 0:
            raise InputError(
                "the occupancy keeps nothing on the rays of these cameras: it was learned on "
                "another scene, the scene has been moved since, or nothing is there"
            )
        learning = self.config.learning
        seen = survey(manager, learning.bounds, learning.near, learning.far)
        if seen.rounded:
            say(seen.rounded)
        say(f"guided by an occupancy that keeps {share:.1%} of the length of these cameras' rays")
        say_all(doubts(describe(occupancy)))
        return along


@torch.no_grad()
def refuse_another_scene(
    occupancy: Occupancy, manager: Any, frame: Tensor, insists: bool = False
) -> None:
    """Says so where hardly any camera that an occupancy was learned on is among a run's, to whose
    coordinates the frame [3, 4] leads back. InputError if it is certainly of another scene, unless
    one `insists`.

    Test photographs count too, so that another split is no other scene; so do photographs that were
    added or taken away since. A file names `MOST_CAMERAS` at most: of so many, some photographs may
    have none. Their sparse points then say whether it is another scene.
    """
    known = cameras_of(occupancy)
    sets = (manager.train_dataset, getattr(manager, "eval_dataset", None))
    poses = [part.cameras.camera_to_worlds.cpu().float() for part in sets if part is not None]
    here = moved(torch.cat(poses)[:, :3, 3], frame.cpu())
    if len(known) == 0:
        return
    half, few = float(occupancy.space.half_extent), SAME_SCENE * min(len(known), len(here))
    found = int(found_again(known, here, half).sum())
    if found >= few:
        return
    remedy = "give the folder of a run on this scene, or no path to learn it first"
    nearly = int(found_again(known, here, ROUNDED * half).sum())
    names_all = len(known) < MOST_CAMERAS
    certain = nearly < few and (names_all or _skips_the_points(occupancy, manager, frame))
    if found == 0 and certain and not insists:
        raise InputError(
            f"the occupancy is of another scene: none of the {len(known)} cameras that its file "
            f"names is among the {len(here)} here; {remedy} (to insist: leco swap --other-scene, "
            "or --pipeline.model.occupancy.other-scene True)"
        )
    say(
        f"the occupancy seems to be of another scene: of the {len(known)} cameras that its "
        f"file names {found} are among the {len(here)} here. It may skip what is there: {remedy}"
    )


def _skips_the_points(occupancy: Occupancy, manager: Any, frame: Tensor) -> bool:
    """Whether an occupancy skips most of a scene's sparse points; False where there are none."""
    points = sparse_points(manager.train_dataset)
    if points is None or len(points) == 0:
        return False
    chosen = points[:: -(-len(points) // POINTS)].to(frame)
    kept = occupancy.query(moved(chosen, frame)) >= occupancy.threshold
    return float(kept.float().mean()) < KEPT_POINTS


class AlongRays(NamedTuple):
    """An occupancy along the rays that meet its box."""

    values: Tensor
    """[R, `PLACES`] o(x), in stretches of one length on each ray."""
    lengths: Tensor
    """[R] of each ray within the box, scene units of the host."""

    def kept(self, threshold: float) -> Tensor:
        """[R], of those lengths, what a threshold keeps."""
        return (self.values >= threshold).float().mean(dim=-1) * self.lengths

    def share_kept(self, threshold: float) -> float:
        """Share of all those lengths that a threshold keeps."""
        return float(self.kept(threshold).sum() / self.lengths.sum().clamp(min=1e-12))


@torch.no_grad()
def along_rays(guide: Guide, occupancy: Occupancy, cameras: Any) -> AlongRays:
    """An occupancy along the cameras' rays through its box, which lies in the host as its guide
    says."""
    frame = guide.frame
    origins, directions = (part.reshape(-1, 3).to(frame) for part in covering_rays(cameras))
    origins, directions = moved(origins, frame), turned(directions, frame)
    center, half = occupancy.space.center, occupancy.space.half_extent
    # a contraction goes on beyond its inner cube: most of what is seen lies within some of those
    reach = half if occupancy.space.kind == "box" else 8.0 * half
    box = torch.cat([center - reach, center + reach])
    enters, leaves = intersect_box(origins, directions, box)
    along = (torch.arange(PLACES, device=frame.device) + 0.5) / PLACES
    hits = (leaves > enters.clamp(min=0.0)).nonzero()[:, 0]
    starts, ends = enters[hits].clamp(min=0.0)[:, None], leaves[hits][:, None]
    t = starts + (ends - starts) * along
    positions = origins[hits][:, None] + directions[hits][:, None] * t[..., None]
    parts = positions.reshape(-1, 3).split(1 << 18)
    values = torch.cat([occupancy.query(part) for part in parts]).view(t.shape)
    return AlongRays(values, (ends - starts)[:, 0])
