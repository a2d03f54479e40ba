"""Learns an occupancy inside the run of another method, before that method's own first step."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import nn

from leco_plugin.evaluation.clock import seconds_now
from leco_plugin.evaluation.held_out_psnr import HeldOutPsnr
from leco_plugin.learning.learner import Learner
from leco_plugin.learning.run import LearningOnly, Progress
from leco_plugin.learning.schedule import MOST_EXTENSIONS, RATES, steps_of_an_extension
from leco_plugin.log import Show, bar, on_screen
from leco_plugin.models.compute.ranks import averaging, is_first, mean
from leco_plugin.models.leco import LecoModel
from leco_plugin.models.leco_config import FusedAdamConfig, LecoModelConfig
from leco_plugin.occupancy import Occupancy
from leco_plugin.scenes.input_error import InputError
from leco_plugin.scenes.pixels.known_distances import batches_of
from leco_plugin.scenes.survey import CAMERAS

FIRST_TIMED, TIMED_STEPS = 5, 15
"""Steps between which a step is timed, to keep to a budget; the first ones are slow."""
FEWEST_STEPS = 20
OF_LEARNER, OF_HOST = "--pipeline.model.", "--pipeline.model.occupancy.learning."
"""Where the options of what learns are, in `leco-occupancy` and in a guided host."""


def learn_occupancy(
    config: LecoModelConfig,
    pipeline: Any,
    rays: int,
    seconds: float | None = None,
    rate: float = 1.0,
) -> Occupancy:
    """As `learn_model`, with options named in errors as they are given to a host; returns the
    occupancy, in the coordinates of the pipeline's model."""
    try:
        model = learn_model(config, pipeline, rays, seconds, rate)
    except InputError as error:
        raise InputError(str(error).replace(OF_LEARNER, OF_HOST)) from None
    return model.mixture.occupancy().eval()


def learn_model(
    config: LecoModelConfig,
    pipeline: Any,
    rays: int,
    seconds: float | None = None,
    rate: float = 1.0,
) -> LecoModel:
    """Trains an HMoE on the pipeline's data until its gate is frozen, field and all.

    All processes of a data-parallel run learn it together, and have the same at the end.

    Args:
        config: of the HMoE.
        pipeline: a nerfstudio pipeline; only its data manager and device are used, and its batches
            are as long as before when this returns.
        rays: of a batch.
        seconds: how long this may take at most, about; None takes the config's learning steps.
        rate: multiple of the learning rates.
    Returns:
        The model as it is at the moment of freezing.
    Raises:
        InputError: as `check_budget`; the gate would never be frozen; or its sizes cannot be.
        FloatingPointError, RuntimeError: learning failed; one line says where and why.
    """
    check_budget(rays, seconds, rate)
    manager = pipeline.datamanager
    dataset = manager.train_dataset
    if config.homogeneous or not config.schedule.freeze:
        raise InputError(
            "this run would learn an occupancy for ever: with homogeneous, or schedule.freeze "
            "False, none is frozen. Those are for leco-occupancy, which guides no other method"
        )
    model: LecoModel = config.setup(
        scene_box=dataset.scene_box,
        num_train_data=len(dataset),
        metadata={**(dataset.metadata or {}), CAMERAS: dataset.cameras},
        device=pipeline.device,
    ).to(pipeline.device)
    model.train()
    trained = averaging(model, model.device)
    groups = model.get_param_groups()
    run = LearningOnly(
        [FusedAdamConfig(lr=rate * RATES[name]).setup(p) for name, p in groups.items()]
    )
    with batches_of(rays, manager):
        learner = model.learner(manager, run)
        learner.data.rays_per_batch = rays
        learner.begin()
        with bar("Learning the occupancy") as show:
            _train(model, trained, learner, seconds, _with_psnr(model, manager, show))
    return model


def _with_psnr(model: LecoModel, manager: Any, show: Show) -> Callable[[float], None]:
    """What shows how far learning is, with PSNR where somebody watches."""
    if not (on_screen() and is_first()):
        return show
    psnr = HeldOutPsnr(model, manager)

    def look(share: float) -> None:
        if not model.mixture.is_frozen:  # of a frozen gate a sampler would have to be built
            psnr.look()
        show(share, psnr.words())

    return look


def check_budget(rays: int, seconds: float | None, rate: float) -> None:
    """InputError if nothing can be learned so; arguments as for `learn_model`."""
    if seconds is not None and not 0.0 < seconds < math.inf:
        raise InputError(f"an occupancy is learned in a positive number of seconds, not {seconds}")
    if rays < 1:
        raise InputError(f"an occupancy is learned on at least one ray a batch, not {rays}")
    if not 0.0 < rate < math.inf:
        raise InputError(f"the multiple of the learning rates must be positive, not {rate}")


def keep_within(progress: Progress, more: float, done: int) -> None:
    """Shortens learning to so many more steps, which fit into the time that is left. What does not
    fit of the further steps that a gate gets when it has not settled, it has had."""
    fit = max(FEWEST_STEPS, done + int(more))
    progress.learn_steps = min(progress.learn_steps, fit)
    progress.phase = min(progress.phase or fit, fit)  # of which recoveries take their share
    extensions = (fit - progress.learn_steps) // steps_of_an_extension(progress.configured)
    progress.extensions = max(0, MOST_EXTENSIONS - extensions)


def _train(
    model: LecoModel,
    trained: nn.Module,
    learner: Learner,
    seconds: float | None,
    show: Callable[[float], None],
) -> None:
    """Steps until the gate is frozen; `trained` is the model, or what averages its gradients over
    processes."""
    progress, manager = learner.progress, learner.data.manager
    started = seconds_now()
    step, timed_from = 0, started
    while not model.mixture.is_frozen:
        model.plan = learner.before_step(step)
        began = seconds_now()
        bundle, batch = manager.next_train(step)
        losses = model.get_loss_dict(trained(bundle), batch)
        for optimizer in learner.run.optimizers():
            optimizer.zero_grad(set_to_none=True)
        torch.stack(list(losses.values())).sum().backward()  # type: ignore[no-untyped-call]
        for optimizer in learner.run.optimizers():
            optimizer.step()
        step += 1
        if step == FIRST_TIMED:
            timed_from = seconds_now()
        if seconds is not None and step >= TIMED_STEPS and progress.recoveries == 0:
            left = mean(seconds - (seconds_now() - started), model.device)
            if step == TIMED_STEPS:
                a_step = mean(seconds_now() - timed_from, model.device) / (step - FIRST_TIMED)
                keep_within(progress, left / a_step, step)
            elif left <= 0.0:  # steps have become slower
                keep_within(progress, 0.0, step)
        learner.after_step(step - 1, seconds_now() - began, model.kept_per_ray)
        show(min(1.0, step / progress.learn_steps))
