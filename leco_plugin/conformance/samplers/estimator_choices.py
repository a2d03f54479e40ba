"""Checks of which samples an estimator returns, where it is known which it must and may."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from leco_plugin.conformance.kit.intervals import among, covered, dense, in_order, same
from leco_plugin.conformance.kit.scene import (
    EVERYTHING,
    MARGIN,
    SLAB,
    STEP,
    Rays,
    crossing,
    stretched,
)
from leco_plugin.conformance.rule import Broken, require
from leco_plugin.conformance.samplers.estimator_case import EstimatorCase
from leco_plugin.samplers.marching import Samples
from leco_plugin.samplers.packed import render_transmittance_from_density

ALLOWED_DIFFERENCE = 0.005
"""Share of all samples that a rounding at the sides of the box may add or take away."""
CONE_ANGLE = 0.02
"""Growth of the steps with distance, which makes them half as long again at the far end."""
SLACK = 1e-3
"""Relative distance from a threshold at which a rounding does not decide."""
LOWEST_CAP = 0.1
"""Of the mean opacity of all samples: the least that an opacity threshold may be lowered to."""


def skips_only_what_it_may(case: EstimatorCase) -> None:
    """What is plainly kept is sampled; what is plainly skipped is not, where the gate decides."""
    for training in (False, True):
        for rays in (crossing(), stretched()):
            samples = case.sample(case.shared(SLAB).train(training), rays)
            if case.needs_occupancy:
                _check_skipped_is_not(rays, samples)
            check_kept_is_sampled(rays, samples)


def _check_skipped_is_not(rays: Rays, samples: Samples) -> None:
    positions = rays.at(samples[0], (samples[1] + samples[2]) / 2.0)
    outside = SLAB.depth(positions) < -MARGIN
    require(
        not bool(outside.any()),
        f"{int(outside.sum())} of {len(outside)} samples lie where the occupancy is empty"
        + _first(positions[outside]),
    )


def check_kept_is_sampled(rays: Rays, samples: Samples) -> None:
    """Raises unless every candidate that lies plainly in the slab is in a sample's interval."""
    ray_indices, t_starts, t_ends = dense(rays)
    middles = (t_starts + t_ends) / 2.0
    positions = rays.at(ray_indices, middles)
    missing = (SLAB.depth(positions) > MARGIN) & ~covered(ray_indices, middles, samples)
    require(
        not bool(missing.any()),
        f"{int(missing.sum())} of {len(missing)} places are not sampled although they are occupied"
        + _first(positions[missing]),
    )


def _first(positions: Tensor) -> str:
    where = [[round(value, 2) for value in position.tolist()] for position in positions[:1]]
    return "".join(f", the first at {position}" for position in where)


def all_kept_equals_dense(case: EstimatorCase) -> None:
    """Where everything is occupied, samples are those of the ray-marching rule without skipping."""
    rays, sampler = crossing(), case.shared(EVERYTHING)
    for cone_angle in (0.0, CONE_ANGLE):
        samples = case.sample(sampler, rays, cone_angle=cone_angle)
        expected = dense(rays, cone_angle)
        missing = int((~among(expected, samples)).sum())
        extra = int((~among(samples, expected)).sum())
        require(
            missing + extra <= ALLOWED_DIFFERENCE * len(expected[0]),
            f"with cone_angle {cone_angle:g} {missing} of {len(expected[0])} candidates are "
            f"missing, {extra} samples are none of them",
        )


def visibility_pruning(case: EstimatorCase) -> None:
    """With a density or opacity, what light does not reach and what is too faint is dropped, and
    nothing else."""
    rays, sampler = crossing(), case.shared(EVERYTHING)
    for training in (False, True):
        sampler.train(training)
        plain = in_order(case.sample(sampler, rays, stratified=False))
        for limits in ((0.0, 0.0), (1e-2, 0.0), (0.0, 1e-2), (1e-2, 1e-2)):
            _check_pruned(case, sampler, rays, plain, *limits)


def _check_pruned(
    case: EstimatorCase,
    sampler: Any,
    rays: Rays,
    plain: Samples,
    early_stop_eps: float,
    alpha_thre: float,
) -> None:
    ray_indices, t_starts, t_ends = plain
    light, alphas = render_transmittance_from_density(
        t_starts,
        t_ends,
        _wall(rays, t_starts, t_ends, ray_indices),
        ray_indices=ray_indices,
        n_rays=len(rays.origins),
    )
    visible = light >= early_stop_eps * (1.0 + SLACK)
    visible &= alphas >= alpha_thre * (1.0 + SLACK)
    dark = light < early_stop_eps * (1.0 - SLACK)
    faint = alphas < min(alpha_thre, LOWEST_CAP * float(alphas.mean())) * (1.0 - SLACK)
    limits = {"early_stop_eps": early_stop_eps, "alpha_thre": alpha_thre}

    def sigma_fn(*interval: Tensor) -> Tensor:
        return _wall(rays, *interval)

    def alpha_fn(t_starts: Tensor, t_ends: Tensor, ray_indices: Tensor) -> Tensor:
        return 1.0 - torch.exp(-_wall(rays, t_starts, t_ends, ray_indices) * (t_ends - t_starts))

    for name, function in (("sigma_fn", sigma_fn), ("alpha_fn", alpha_fn)):
        options: dict[str, Any] = {name: function, "stratified": False, **limits}
        kept = among(plain, case.sample(sampler, rays, **options))
        given = f"with {name}, early_stop_eps {early_stop_eps} and alpha_thre {alpha_thre}"
        lost = int((visible & ~kept).sum())
        require(lost == 0, f"{given}: {lost} of {int(visible.sum())} visible samples are dropped")
        for kind, dropped in (("in the dark", dark), ("too faint to be seen", faint)):
            left, count = int((dropped & kept).sum()), int(dropped.sum())
            require(left == 0, f"{given}: {left} of {count} samples {kind} are kept")


def _wall(rays: Rays, t_starts: Tensor, t_ends: Tensor, ray_indices: Tensor) -> Tensor:
    """A thin fog with an opaque slab in it: density of samples, [N]."""
    positions = rays.at(ray_indices, (t_starts + t_ends) / 2.0)
    return 0.05 + SLAB.density(positions)[:, 0] / STEP


def update_while_frozen_is_harmless(case: EstimatorCase) -> None:
    """Hosts go on updating what they take for a grid: every form of the call is accepted."""
    sampler, rays = case.shared(SLAB), crossing()
    before = case.sample(sampler, rays)
    sampler.train()
    answer = _nothing if case.needs_occupancy else SLAB.density
    for form, arguments, options in _call_forms(answer):
        _update(sampler, form, arguments, options)
    after = case.sample(sampler.eval(), rays)
    if case.needs_occupancy:
        require(same(before, after), "updates with an empty field changed what is sampled")
    else:
        check_kept_is_sampled(rays, after)


def _update(sampler: Any, form: str, arguments: tuple[Any, ...], options: dict[str, Any]) -> None:
    try:
        sampler.update_every_n_steps(*arguments, **options)
    except Exception as error:
        said = f"{type(error).__name__}: {error}"
        raise Broken(f"update_every_n_steps({form}) raises {said}") from error


def _nothing(positions: Tensor) -> Tensor:
    return torch.zeros_like(positions[:, :1])


def _call_forms(answer: Any) -> list[tuple[str, tuple[Any, ...], dict[str, Any]]]:
    """How nerfstudio and nerfacc's examples call it; steps in and after nerfacc's warm-up."""
    thresholds = {"occ_thre": 1e-2, "ema_decay": 0.95, "warmup_steps": 256, "n": 16}
    return [
        ("step=, occ_eval_fn=", (), {"step": 16, "occ_eval_fn": answer}),
        ("step, occ_eval_fn", (272, answer), {}),
        (
            "step=, occ_eval_fn=, occ_thre=",
            (),
            {"step": 288, "occ_eval_fn": answer, "occ_thre": 1e-2},
        ),
        ("step, occ_eval_fn and all options", (304, answer), thresholds),
    ]
