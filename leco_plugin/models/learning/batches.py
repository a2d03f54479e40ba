"""How many rays the batches of a run have, and on which of their pixels a distance is known."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Any

from leco_plugin.models.compute.ranks import mean
from leco_plugin.models.learning.healing import is_dense
from leco_plugin.scenes.pixels.held_out_pixels import held_out_sampler
from leco_plugin.scenes.pixels.known_distances import KnownDistancePixelSampler, sampler_here
from leco_plugin.scenes.pixels.lattice import Lattice
from leco_plugin.scenes.pixels.sparse_pixels import SparsePixels, sparse_pixels
from leco_plugin.scenes.survey import sparse_points

if TYPE_CHECKING:
    from leco_plugin.models.leco import LecoModel


class Batches:
    """Sets a data manager's sampler before each step; one that samples elsewhere is left alone.

    Args:
        model: whose gate says how many candidates of a ray are shaded.
        data_manager: nerfstudio's, or one with its interface.
    """

    def __init__(self, model: LecoModel, data_manager: Any) -> None:
        self.model, self.data_manager = model, data_manager
        self.rays_per_batch = int(data_manager.get_train_rays_per_batch())

    def prepare(self, learning: bool) -> None:
        """The next batch.

        Args:
            learning: whether the occupancy is still learned, for which known distances are asked.
        """
        sampler = sampler_here(self.data_manager)
        if isinstance(sampler, KnownDistancePixelSampler):
            wanted = learning and self.model.config.termination > 0.0
            sampler.sparse = self.sparse if wanted else None
        factor = self.guided() if bool(self.model.frozen) else self.followed()
        rays = round(self.rays_per_batch * factor)
        if sampler is not None and sampler.num_rays_per_batch != rays:
            sampler.set_num_rays_per_batch(rays)

    def followed(self) -> float:
        """Rays of a batch as a multiple, while the gate being learned is followed already.

        The same in every process: the mean of their gradients is then that of one large batch.
        """
        model, progress = self.model, self.model.progress
        if model.learned or is_dense(progress, model.step):
            # no longer followed; and what a gate kept that has collapsed says nothing
            progress.learning_kept = 1.0
        progress.learning_kept = mean(progress.learning_kept, model.device)
        wanted = min(model.config.sizes.guided_batch, 1.0 / progress.learning_kept)
        return round(8 * wanted) / 8  # of few sizes; see `steady`

    def guided(self) -> float:
        """Rays of a guided batch as a multiple: about as many samples are shaded as before."""
        sizes = self.model.config.sizes
        kept = 1.0 - float(self.model.report.get("empty_fraction", 0.0))
        same_samples = sizes.learn_candidates / max(1.0, kept * sizes.candidates)
        return min(sizes.guided_batch, max(0.5, same_samples))

    @cached_property
    def sparse(self) -> SparsePixels | None:
        """Where sparse points are seen; projected only once learning asks for it."""
        dataset: Any = self.data_manager.train_dataset
        points = sparse_points(dataset)
        if points is None:
            return None
        sampler = held_out_sampler(self.data_manager)
        lattice = Lattice() if sampler is None else sampler.lattice
        return sparse_pixels(dataset.cameras, points, lattice)
