"""Registered methods, built guided on a known scene, as the rules for hosts check them."""

from __future__ import annotations

import copy
import functools
import shutil
import tempfile
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.models.base_model import Model
from nerfstudio.pipelines.base_pipeline import Pipeline
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor
from torch.nn.functional import normalize

from leco_plugin.conformance.rules import Case
from leco_plugin.conformance.scene import CENTRE, DISTANCE, HERE, MOVED, SLAB, Slab, box
from leco_plugin.hosts.guided import GuidedModelConfig
from leco_plugin.models.encodings import Kind
from leco_plugin.models.leco_config import LecoModelConfig
from leco_plugin.occupancy import Occupancy
from leco_plugin.samplers.boxes import intersect_box
from leco_plugin.samplers.registry import sampler_spec
from leco_plugin.scenes.input_error import InputError

FROM = ((1.0, 0.4, 0.5), (0.3, 1.0, 0.6), (-0.8, -0.9, -0.1), (-0.4, -0.6, -1.0))
"""Directions in which cameras lie from the centre of the box, to both sides of the slab."""
CAMERAS, SIDE = len(FROM), 4
"""Cameras, and pixels along each side of their images."""
SEEN = 0.8
"""World units to each side of the box's centre that an image shows: all rays cross the slab."""


def cameras() -> Cameras:
    """Around the box, looking at its centre."""
    backward = normalize(torch.tensor(FROM), dim=-1)
    upward = torch.tensor([0.0, 0.0, 1.0]).expand_as(backward)
    right = normalize(torch.linalg.cross(upward, backward), dim=-1)
    position = torch.tensor(CENTRE) + DISTANCE * backward
    poses = torch.stack([right, torch.linalg.cross(backward, right), backward, position], dim=-1)
    focal, middle = SIDE / 2.0 * DISTANCE / SEEN, SIDE / 2.0
    return Cameras(poses, focal, focal, middle, middle, SIDE, SIDE)


def _pixels() -> Tensor:
    """Camera, row and column of every pixel: [CAMERAS * SIDE^2, 3]."""
    return torch.cartesian_prod(*map(torch.arange, (CAMERAS, SIDE, SIDE)))


def bundle(away: bool = False) -> RayBundle:
    """Rays through all pixels of all cameras, [CAMERAS * SIDE^2], as a data manager gives them; or
    in the opposite direction, where there is nothing."""
    pixels = _pixels()
    rays: RayBundle = cameras().generate_rays(pixels[:, :1], coords=pixels[:, 1:] + 0.5)
    rays.directions = -rays.directions if away else rays.directions
    return rays


def inside_the_box() -> RayBundle:
    """The same rays, which begin and end within the box."""
    rays = bundle()
    enters, leaves = intersect_box(rays.origins, rays.directions, box())
    rays.nears, rays.fars = (enters + 0.01)[:, None], (leaves - 0.01)[:, None]
    return rays


def batch() -> dict[str, Tensor]:
    """What the pixels of `bundle` show: `image` [N, 3], `depth_image` [N, 1], `indices` [N, 3]."""
    rays = bundle()
    return {
        "image": 0.5 + 0.5 * torch.sin(3.0 * rays.directions),
        "depth_image": torch.full((len(rays), 1), DISTANCE),
        "indices": _pixels(),
    }


def model_arguments() -> dict[str, Any]:
    """What nerfstudio's pipeline gives a model when it builds it."""
    return {
        "scene_box": SceneBox(box().view(2, 3)),
        "num_train_data": CAMERAS,
        "metadata": {},
        "device": "cpu",
        "grad_scaler": None,
        "seed_points": None,
    }


class CamerasOnly(SimpleNamespace):
    """A data set as far as models and their callbacks look at one."""

    def __len__(self) -> int:
        return CAMERAS


def pipeline_of(model: Any) -> Any:
    """What stands where callbacks expect nerfstudio's pipeline."""
    data = CamerasOnly(cameras=cameras(), scene_box=model_arguments()["scene_box"], metadata={})
    manager = SimpleNamespace(train_dataset=data)
    return SimpleNamespace(model=model, _model=model, device=model.device, datamanager=manager)


class HostCase(Case):
    """A method whose model is guided: as it is, or with its sampler swapped. Its config has the
    file of an occupancy of `SLAB`. InputError where there is no such method, or none that an
    occupancy could guide."""

    seam = "host"
    imports = ("torch", "torchmetrics", "leco_plugin.hosts.guided")

    def __init__(self, name: str) -> None:
        self.name = name
        folder = tempfile.mkdtemp()
        weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
        self.file = Path(folder) / "occupancy.safetensors"
        self.config, self._kind = guided(name, self.file)
        self.occupancy(SLAB).save(self.file)
        self._model: Model | None = None
        self._guided_by = (SLAB, False)

    def forget(self) -> None:
        self._model = None

    def occupancy(self, scene: Slab, frame: Tensor = HERE) -> Occupancy:
        """The occupancy of a scene, its gate on the features that the method's sampler asks."""
        return scene.occupancy(self._kind, frame)

    def shared(self, scene: Slab = SLAB, moved: bool = False) -> Model:
        """The model as a run has it before its first step, guided in a scene, in evaluation; moved
        is by an occupancy of other coordinates than the host's."""
        if self._model is None:
            self._model, self._guided_by = build(self.config.pipeline.model), (SLAB, False)
            callbacks(self._model)
        if (scene, moved) != self._guided_by:
            frame = MOVED if moved else HERE
            cast(Any, self._model).leco_guide.set_occupancy(self.occupancy(scene, frame), frame)
            self._guided_by = scene, moved
        return self._model.eval()

    def unguided(self) -> Model:
        """The host with its own sampler, as a run has it before its first step."""
        config: Any = copy.deepcopy(self.config.pipeline.model)
        config.occupancy = replace(config.occupancy, sampler="own", options={})
        model = build(config)
        callbacks(model)
        return model.eval()


def guided(name: str, file: Path) -> tuple[TrainerConfig, Kind]:
    """The config of a method, guided by a file, and the features its gate must be on; errors as of
    `HostCase`."""
    from leco_plugin.swap import registered, with_sampler_swapped

    config = registered(name)
    model = getattr(config.pipeline, "model", None)
    if isinstance(model, LecoModelConfig):
        raise InputError(
            f"{name} is no host: it learns the occupancy by which hosts are guided, and has no "
            "sampler to swap. Check a guided method (leco-ngp) or a sampler (learned-occupancy)"
        )
    if not isinstance(model, GuidedModelConfig):
        config = with_sampler_swapped(config, file)
    guided: Any = config.pipeline.model
    occupancy = guided.occupancy
    spec = None if occupancy.sampler == "own" else sampler_spec(occupancy.sampler)
    if spec is None or not spec.needs_occupancy:
        raise InputError(f"{name} is guided by no occupancy: its sampler is {occupancy.sampler!r}")
    occupancy.path = file
    occupancy.options = {**spec.check_options, **occupancy.options}
    return config, cast(Kind, spec.gate_encoding or "frequency")


def build(config: Any, seed: int = 0) -> Model:
    """The model of a model's config, as a pipeline builds it, with random numbers from `seed`."""
    torch.manual_seed(seed)
    with quietly():
        model: Model = config.setup(**model_arguments())
    return model


def callbacks(owner: Any, optimizers: Any = None) -> list[TrainingCallback]:
    """What a model, or a pipeline, wants to be called at in a run; asking for it is what begins
    one."""
    pipeline: Any = owner if isinstance(owner, Pipeline) else pipeline_of(owner)
    attributes = TrainingCallbackAttributes(optimizers, None, pipeline, None)
    with quietly():
        found: list[TrainingCallback] = owner.get_training_callbacks(attributes)
    return found


def loss_of(model: Model, rays: RayBundle, batch: dict[str, Tensor], forward: Any = None) -> Tensor:
    """The loss of a batch, as nerfstudio's pipeline and trainer compute it; `forward` stands for
    the model where outputs are asked, as data-parallel training has it."""
    outputs = (forward or model)(rays)
    metrics = model.get_metrics_dict(outputs, batch)
    losses = model.get_loss_dict(outputs, batch, metrics)
    return functools.reduce(torch.add, losses.values())


@contextmanager
def quietly() -> Iterator[None]:
    """While this lasts, nerfstudio prints nothing: verdicts are what is to be read. Where it ends
    the process, a `RuntimeError` says what it printed last."""
    printed = CONSOLE.capture()
    try:
        with printed:
            yield
    except SystemExit as end:
        raise RuntimeError(" ".join(printed.get().split()) or f"it ends with {end}") from end
