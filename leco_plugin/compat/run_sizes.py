"""The sizes of a run, where each of its commands finds them: in its checkpoints and its config.

nerfstudio stores a config before it reads the scene. What `leco-occupancy` then chooses from the
scene is stored too, so that no later command chooses again.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import yaml

from leco_plugin.compat.checkpoints import allow_checkpoint_globals
from leco_plugin.compat.whole_checkpoints import newest_whole
from leco_plugin.models.compute.ranks import is_first
from leco_plugin.models.sizing.stored_sizes import going_on, sizes_in
from leco_plugin.scenes.input_error import InputError
from leco_plugin.scenes.whole_files import write_whole

CONFIG = "config.yml"


def checkpoint_of(config: Any) -> Path | None:
    """The checkpoint that training goes on from: of a folder, the newest that is whole.

    Raises:
        InputError: the folder holds none.
    """
    if config.load_dir is None:
        path: Path | None = config.load_checkpoint
        return path
    if config.load_step is not None:
        return Path(config.load_dir) / f"step-{config.load_step:09d}.ckpt"
    return newest_whole(config.load_dir)[0]


def with_sizes_of(config: Any, checkpoint: Path | None) -> Any:
    """A trainer's config with the sizes of the run that is gone on with.

    Args:
        checkpoint: that training goes on from; None, or one that is not there, changes nothing.
    Raises:
        InputError: a size has been set by hand, and the run has another one.
    """
    from leco_plugin.models.leco_config import LecoModelConfig

    model = config.pipeline.model
    if checkpoint is None or not isinstance(model, LecoModelConfig) or not checkpoint.exists():
        return config
    allow_checkpoint_globals()
    stored = sizes_in(checkpoint)
    if stored is None:
        return config
    return _with_model(config, replace(model, sizes=going_on(model.sizes, stored)))


def keep_sizes(config: Any, model: Any, asked: Any) -> Any:
    """A trainer's config with the sizes that its model has, also in the run's `config.yml`.

    Args:
        asked: the model's config as the command gave it, which is what is stored so far.
    """
    from leco_plugin.models.leco import LecoModel

    if not isinstance(model, LecoModel) or asked.sizes == model.config.sizes:
        return config
    config = _with_model(config, model.config)
    path = config.get_base_dir() / CONFIG
    if is_first() and path.exists():  # what is not to be stored has none
        text = yaml.dump(config)
        write_whole(path, lambda file: file.write(text.encode("utf8")))
    return config


def check_photographs(pipeline: Any) -> None:
    """Whether a run that is gone on with still has the photographs that it was begun with.

    Raises:
        InputError: there are more or fewer; their codes would go to others.
    """
    from leco_plugin.models.leco import LecoModel

    model = getattr(pipeline, "model", None)
    if not isinstance(model, LecoModel):
        return
    now = len(pipeline.datamanager.train_dataset)
    if model.num_train_data != now:
        raise InputError(
            f"the run was begun with {model.num_train_data} training photographs, and the scene "
            f"has {now}: put the same ones there, or begin a new run"
        )


def _with_model(config: Any, model: Any) -> Any:
    return replace(config, pipeline=replace(config.pipeline, model=model))
