"""Where a guided host gets its occupancy: from a file, or learned first; in its own coordinates."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from leco_plugin.compat.earlier_configs import GrowingConfig
from leco_plugin.evaluation.inspection import cameras_of
from leco_plugin.models.compute.ranks import is_first, say
from leco_plugin.models.freezing.freezing import FILE_NAME, leave_file
from leco_plugin.models.hosts.guide import Guide
from leco_plugin.models.hosts.opaque_start import begin_opaque
from leco_plugin.models.hosts.probation import begin_carefully
from leco_plugin.models.leco_config import LecoModelConfig
from leco_plugin.models.sizing.sizes import SMALL, learning_only
from leco_plugin.occupancy import Occupancy
from leco_plugin.samplers.boxes import intersect_box
from leco_plugin.samplers.registry import check_gate
from leco_plugin.scenes.frames import between, found_again, frame_of, moved, turned
from leco_plugin.scenes.input_error import InputError
from leco_plugin.scenes.survey import announce, covering_rays, survey

PLACES = 128
"""Positions on each ray at which a file is asked whether it fits the cameras."""
SAME_SCENE = 0.1
"""Share of cameras, of the fewer, that an occupancy and a run on its scene have in common."""

LEARNING = (
    "the occupancy is learned first, and is in no checkpoint until then: a run that is stopped "
    "before starts over. A run of leco-occupancy can be gone on with, and its folder be given here "
    "with --pipeline.model.occupancy.path"
)

OWN_SAMPLER = "own"
"""Name of no sampler: the host keeps its own."""


@dataclass
class OccupancyConfig(GrowingConfig):
    """What guides the host."""

    path: Path | None = None
    """An occupancy.safetensors, or the folder of a run that left one. None learns the occupancy
    first, in this run."""
    sampler: str = "learned-occupancy"
    """Name in the registry of samplers. For comparison: `dense`, `occupancy-grid`, and `own`, which
    leaves the host as it is."""
    options: dict[str, int | float] = field(default_factory=dict)
    """Of that sampler, by name: resolution 256 levels 4."""
    front_to_back: bool = False
    """Packed hosts, when they render: ask densities front to back, and shade nothing behind an
    opaque surface. The image is the same to a thousandth; it pays where shading costs much more
    than a density."""
    opaque_start: bool = True
    """Packed hosts: begin with a density that makes what is kept of a ray opaque, where the host's
    own would not. Before a random background a transparent start may never recover."""
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


def occupancy_file(path: Path | None) -> Path | None:
    """The file that `path` means: itself, or the newest occupancy in the folder of a run.

    Without an error where there is none: a checkpoint brings its own.
    """
    if path is None or not path.is_dir():
        return path
    found = sorted(path.rglob(FILE_NAME), key=lambda file: file.stat().st_mtime)
    return found[-1] if found else path / FILE_NAME


def load_occupancy(path: Path) -> Occupancy:
    """The occupancy that `path` means.

    Raises:
        InputError: there is none, or it cannot be read.
    """
    file = occupancy_file(path)
    assert file is not None
    try:
        return Occupancy.load(file)
    except FileNotFoundError:
        raise InputError(
            f"there is no occupancy {file}: train leco-occupancy on this scene and give its run "
            "folder (guided methods like leco-ngp learn it first where no path is given)"
        ) from None
    except (OSError, ValueError) as error:
        raise InputError(f"no occupancy can be read: {error}") from None


class GuidedStart:
    """The start of one training run of a guided host.

    Args:
        host: what is guided.
        guide: of the host; it has an occupancy already where a file or a checkpoint gave one.
        config: where else to get one.
        pipeline, trainer: nerfstudio's; without a trainer no file is left.
    Raises:
        InputError: the file is not there or cannot be read; its occupancy keeps nothing that the
            cameras see, and this run has not begun with it; its gate is none that the sampler asks;
            or nothing can be learned in the time or with the rays that are given.
    """

    def __init__(
        self,
        host: nn.Module,
        guide: Guide,
        config: OccupancyConfig,
        pipeline: Any,
        trainer: Any = None,
    ) -> None:
        self.host, self.guide, self.config = host, guide, config
        self.pipeline, self.trainer = pipeline, trainer
        self.begun = False
        if guide.occupancy is None and config.path is not None:
            guide.set_occupancy(load_occupancy(config.path))  # says why it could not be before
        if guide.occupancy is None:
            from leco_plugin.models.hosts.learn_first import check_budget

            check_budget(config.rays, config.seconds, config.rate)
        learned = guide.occupancy.gate.config if guide.occupancy is not None else None
        try:
            check_gate(guide.sampler, learned or config.learning.sizes.gate)
        except ValueError as error:
            here = "; or here, with that option at --pipeline.model.occupancy.learning"
            raise InputError(f"{error}{'' if learned else here}") from None
        self.along = None if guide.occupancy is None else self._fit(guide.occupancy)

    def before_step(self, step: int) -> None:
        """Learns the occupancy if there is none yet, and leaves its file in the run's folder.

        A packed host begins carefully, and opaque.
        """
        if self.begun:
            return
        self.begun = True
        if self.guide.occupancy is None:
            from leco_plugin.models.hosts.learn_first import learn_occupancy

            say(LEARNING)
            config = self.config
            occupancy = learn_occupancy(
                config.learning, self.pipeline, config.rays, config.seconds, config.rate
            )
            self.guide.set_occupancy(occupancy)
        watches = self.config.learning.calibration.recheck_rays > 0
        if step == 0 and watches:
            begin_carefully(self.host, self.guide, self._skipped)
        if step == 0 and self.config.opaque_start:
            kept = self._along_rays().kept(self.guide.followed().threshold)
            begin_opaque(self.host, self.guide, kept)
        if self.trainer is not None and is_first():
            leave_file(self.guide.the_occupancy(), Path(self.trainer.base_dir))

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
            warn_of_another_scene(occupancy, manager, self.guide.frame)
        along = along_rays(self.guide, occupancy, manager.train_dataset.cameras)
        share = along.share_kept(occupancy.threshold)
        if share == 0.0 and getattr(self.trainer, "_start_step", 0) == 0:
            raise InputError(
                "the occupancy keeps nothing on the rays of these cameras: it was learned on "
                "another scene, the scene has been moved since, or nothing is there"
            )
        learning = self.config.learning
        announce(survey(manager, learning.bounds, learning.near, learning.far))
        say(
            f"guided by an occupancy that keeps {share:.1%} along these rays; the bounds above are "
            "those for learning one, and do not change it"
        )
        return along


def warn_of_another_scene(occupancy: Occupancy, manager: Any, frame: Tensor) -> None:
    """Says so where hardly any camera that an occupancy was learned on is among a run's.

    Test photographs count too, so that another split is no other scene; so do photographs that were
    added or taken away since.

    Args:
        manager: nerfstudio's data manager of the run.
        frame: [3, 4] from the run's coordinates to those of the occupancy.
    """
    known = cameras_of(occupancy)
    sets = (manager.train_dataset, getattr(manager, "eval_dataset", None))
    poses = [part.cameras.camera_to_worlds.cpu().float() for part in sets if part is not None]
    here = moved(torch.cat(poses)[:, :3, 3], frame.cpu())
    if len(known) == 0:
        return
    found = int(found_again(known, here, float(occupancy.space.half_extent)).sum())
    if found < SAME_SCENE * min(len(known), len(here)):
        say(
            f"the occupancy seems to be of another scene: of the {len(known)} cameras that its "
            f"file names {found} are among the {len(here)} here. It may skip what is there: give "
            "the folder of a run on this scene, or no path to learn it first"
        )


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
    """An occupancy along rays through its box.

    Args:
        guide: says how the occupancy lies in the host.
    """
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
