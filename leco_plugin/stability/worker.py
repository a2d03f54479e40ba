"""One run of a case in a process of its own: `python -m leco_plugin.stability.worker FOLDER`.

As a run of a chart, but that batches have one size for all samplers, and that it is looked at with
the exact scene beside it.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from leco_plugin.chart.worker import main, train_job

if TYPE_CHECKING:
    from nerfstudio.engine.trainer import TrainerConfig

    from leco_plugin.chart.contender import Contender
    from leco_plugin.chart.protocol import Protocol


def with_fixed_batches(config: TrainerConfig) -> TrainerConfig:
    """The same training with as many rays a batch, however much is skipped."""
    from dataclasses import replace

    from nerfstudio.pipelines.base_pipeline import VanillaPipelineConfig
    from nerfstudio.pipelines.dynamic_batch import DynamicBatchPipelineConfig

    pipeline = config.pipeline
    if not isinstance(pipeline, DynamicBatchPipelineConfig):
        return config
    fixed = VanillaPipelineConfig(datamanager=pipeline.datamanager, model=pipeline.model)
    return replace(config, pipeline=fixed)


def run_cell(
    contender: Contender,
    seed: int,
    data: Path,
    protocol: Protocol,
    folder: Path,
    on_progress: Callable[[float], None] | None = None,
) -> dict[str, Any]:
    """Trains and measures; arguments and record as of `chart.worker.run_job`, with `measured`."""
    import time

    from PIL import Image

    from leco_plugin.chart.contender import config_of
    from leco_plugin.evaluation.report import finite_or_null
    from leco_plugin.stability.measure import measure

    began = time.process_time()
    config = with_fixed_batches(config_of(contender, data, folder / "nerfstudio"))
    record, trainer = train_job(
        config, contender, seed, data, protocol, folder, on_progress, looked_at=False
    )
    options = contender.changes.get("occupancy.options", {})
    measured, shown = measure(trainer, data, options.get("samples", 192))
    Image.fromarray(shown).save(folder / "view.png")
    figures = asdict(measured)
    found = {
        "psnr": round(figures.pop("psnr"), 4),
        "processor_seconds": round(time.process_time() - began, 2),
        "measured": finite_or_null(figures),
    }
    return {**record, **finite_or_null(found)}


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]), run_cell))
