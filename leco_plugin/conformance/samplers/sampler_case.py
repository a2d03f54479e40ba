"""A registered sampler, built for known scenes: what the rules for samplers are applied to."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar, cast

import torch
from torch import Tensor

from leco_plugin.conformance.kit.scene import SLAB, Field, Rays, Slab
from leco_plugin.models.encodings import Kind
from leco_plugin.occupancy import Occupancy
from leco_plugin.samplers.marching import Samples
from leco_plugin.samplers.registry import sampler_spec


class SamplerCase(ABC):
    """A sampler at one of the two seams.

    Building can take seconds, so that a sampler of a scene is built once and shared by the rules,
    which leave it as they found it.

    Args:
        name: of the sampler, as registered.

    Raises:
        ValueError: there is no sampler of that name.
    """

    seam: ClassVar[str]
    imports: ClassVar[tuple[str, ...]] = ("torch",)
    """Modules behind the samplers at this seam that take time to import."""

    def __init__(self, name: str) -> None:
        self.name = name
        spec = sampler_spec(name)
        self.needs_occupancy = spec.needs_occupancy
        self.options = dict(spec.check_options)
        self.gate_encoding = cast(Kind, spec.gate_encoding or "frequency")
        self._shared: dict[Slab, tuple[Any, Occupancy]] = {}

    def forget(self) -> None:
        """Builds samplers anew from now on."""
        self._shared.clear()

    def shared(self, scene: Slab) -> Any:
        """The sampler of a scene, ready for hosts and in evaluation mode."""
        return self._built(scene)[0].eval()

    def occupancy(self, scene: Slab) -> Occupancy:
        """The occupancy that `shared(scene)` was given, if it was given one."""
        return self._built(scene)[1]

    def occupancy_of(self, scene: Slab) -> Occupancy:
        """The occupancy of a scene, its gate on the features that this sampler asks."""
        return scene.occupancy(self.gate_encoding)

    def _built(self, scene: Slab) -> tuple[Any, Occupancy]:
        if scene not in self._shared:
            occupancy = self.occupancy_of(scene)
            sampler = self.build(occupancy if self.needs_occupancy else None)
            if not self.needs_occupancy:
                self.teach(sampler, scene)
            self._shared[scene] = sampler, occupancy
        return self._shared[scene]

    @abstractmethod
    def build(self, occupancy: Occupancy | None) -> Any:
        """The sampler as a host builds it."""

    @abstractmethod
    def teach(self, sampler: Any, scene: Slab) -> None:
        """What a host does before and between its steps, with the densities of a scene."""

    @abstractmethod
    def sample(
        self, sampler: Any, rays: Rays, scene: Slab = SLAB, *, seed: int = 0, **options: Any
    ) -> Samples:
        """What a host gets, with random numbers from `seed`, as packed samples.

        Args:
            scene: of the sampler, for those that ask the host for densities.
            options: arguments that are not those of every call.
        """

    @abstractmethod
    def colours(self, sampler: Any, rays: Rays, field: Field) -> Tensor:
        """What a host renders in the scene `SLAB`, in front of the background: [n_rays, 3]."""


def devices() -> list[torch.device]:
    """The CPU, and a CUDA device where there is one."""
    found = [torch.device("cpu")]
    if torch.cuda.is_available():
        found.append(torch.device("cuda"))
    return found
