"""The rules that others rely on, each with its reason and remedy, and how one is applied.

Checks are registered with `checks(RULE, SEAM)` where they are written: `estimators`, `proposals`,
`samplers`, `host_images` and `host_training`. A check asks what its rule says.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import torch
from torch import Tensor

OURS = Path(__file__).resolve().parents[1]
LIBRARIES = {"torch", "nerfstudio", "nerfacc"}
"""Packages in which errors come up that are caused elsewhere."""

Check = TypeVar("Check", bound=Callable[[Any], None])


class Broken(AssertionError):
    """Raised by a check: the rule does not hold, and this is what was found."""


def require(holds: bool, problem: str) -> None:
    """Raises `Broken` with `problem` unless the condition holds."""
    if not holds:
        raise Broken(problem)


def require_none(wrong: Tensor, problem: str) -> None:
    """Raises `Broken` if anything of `wrong` [N] is True; the {} of `problem` says how many are."""
    count = int(wrong.sum())
    require(count == 0, problem.format(f"{count} of {len(wrong)}"))


@contextmanager
def raises_nothing(what: str) -> Iterator[None]:
    """`Broken` for whatever is raised meanwhile; `what` begins its message."""
    try:
        yield
    except Broken:
        raise
    except Exception as error:
        raise Broken(f"{what} {type(error).__name__}: {error}") from error


class Case:
    """A sampler or a method, known by name, at one of the seams of a host."""

    name: str
    seam: ClassVar[str]
    imports: ClassVar[tuple[str, ...]] = ("torch",)
    """Modules that take time to import, which processes of this case share."""

    def forget(self) -> None:
        """Drops whatever was built: a check that failed may have left it in any state."""


@dataclass(frozen=True)
class Rule:
    """A promise that hosts or users rely on."""

    name: str
    """As command lines and tests show it."""
    reason: str
    """What goes wrong where it does not hold."""
    remedy: str
    """What to do about it."""
    checks: dict[str, Callable[[Any], None]] = field(default_factory=dict)
    """By seam: takes the case, and raises `Broken` or anything else unless the rule holds."""


def checks(name: str, *seams: str) -> Callable[[Check], Check]:
    """Makes a function the check of a rule at these seams."""

    def register(check: Check) -> Check:
        rule = next(rule for rule in RULES if rule.name == name)
        rule.checks.update(dict.fromkeys(seams, check))
        return check

    return register


@dataclass(frozen=True)
class Verdict:
    """Whether a rule holds for a case."""

    rule: Rule
    seam: str
    error: Exception | SystemExit | None
    """What the check raised; None when the rule holds."""

    @property
    def passed(self) -> bool:
        return self.error is None

    @property
    def problem(self) -> str:
        """What was found, in one line; empty when the rule holds."""
        if self.error is None:
            return ""
        said = " ".join(str(self.error).split())
        if isinstance(self.error, Broken):
            return said
        return f"{type(self.error).__name__}: {said}{_place(self.error)}"

    @property
    def advice(self) -> str:
        """Problem, reason and remedy, in one line."""
        return f"{self.problem}. Why it matters: {self.rule.reason} Remedy: {self.rule.remedy}"

    def line(self) -> str:
        """The line that `leco check` prints."""
        start = f"{'pass' if self.passed else 'FAIL'}  {self.seam}  {self.rule.name}"
        return start if self.passed else f"{start}: {self.advice}"

    def to_dict(self) -> dict[str, str | bool]:
        return {
            "rule": self.rule.name,
            "seam": self.seam,
            "passed": self.passed,
            "problem": self.problem,
            "reason": self.rule.reason,
            "remedy": self.rule.remedy,
        }


def _place(error: BaseException) -> str:
    """Where in the checked code an error came up; empty if it came up elsewhere."""
    for frame in reversed(traceback.extract_tb(error.__traceback__)):
        path = Path(frame.filename)
        if OURS not in path.parents and not LIBRARIES & set(path.parts):
            return f" ({path.name}, line {frame.lineno})"
    return ""


@contextmanager
def left_as_before() -> Iterator[None]:
    """With gradients. torch's gradient mode and random states, also those of all cards, are as
    before afterwards."""
    # `torch.manual_seed` seeds all; a card that torch cannot use is counted too
    cards = range(torch.cuda.device_count() if torch.cuda.is_available() else 0)
    with torch.random.fork_rng(cards), torch.enable_grad():
        yield


def apply(rule: Rule, case: Case) -> Verdict:
    """Whether `rule` holds for `case`, whose seam it must have a check for."""
    error = None
    with left_as_before():
        try:
            rule.checks[case.seam](case)
        except (Exception, SystemExit) as caught:  # noqa: BLE001 (whatever a foreign one raises)
            case.forget()
            error = caught
    return Verdict(rule, case.seam, error)


RULES = (
    Rule(
        "signature",
        "hosts pass these arguments by name and by position, and know nothing else.",
        "take the arguments of nerfacc's OccGridEstimator in its order with its defaults "
        "(estimator); subclass nerfstudio's Sampler, with set_anneal and step_cb, and count "
        "density_fns but call none where an occupancy decides (proposal).",
    ),
    Rule(
        "shapes-types-devices",
        "a host indexes its rays with what it gets, multiplies it with its densities, and goes on "
        "using its rays.",
        "make every tensor from those of the rays (new_zeros, to), never with a device or "
        "type of its own; write nothing into the rays; one length for all packed tensors, one "
        "number of samples for all rays, also of a batch of one ray; "
        "make ray_samples by ray_bundle.get_ray_samples, so that deltas are ends - starts and "
        "camera_indices, times and metadata are those of the rays (proposal).",
    ),
    Rule(
        "sorted-disjoint-inside",
        "transmittance is a running product from near to far: out of order, overlapping or "
        "outside, it counts matter twice or where there is none.",
        "hand out intervals from near to far, each begun where the last one ended or later, "
        "with middles between t_min or near_plane and t_max or far_plane, whichever is narrower; "
        "t_min and t_max may be None, and the planes alone hold (estimator).",
    ),
    Rule(
        "packing-consistent",
        "packed scans take the samples of a ray to lie together, in the order of the rays.",
        "return int64 ray_indices that never fall and lie in [0, n_rays); sort by ray when "
        "samples are collected in pieces, and add the offset of each piece of rays.",
    ),
    Rule(
        "deterministic-in-eval",
        "a test image must not change from one rendering to the next, nor a figure with it.",
        "draw random numbers only when stratified is set (estimator) or self.training is "
        "(proposal), and set no seed.",
    ),
    Rule(
        "stratified-in-training",
        "a field that is always asked at the same places learns bands between them.",
        "shift each ray's samples by a random share of a step of its own, uniform in [0, 1), when "
        "stratified is set (estimator) or self.training is (proposal), and keep them between near "
        "and far.",
    ),
    Rule(
        "skips-only-what-it-may",
        "what is skipped though it is occupied is a hole in the image, and what is kept "
        "though it is empty is time lost.",
        "decide by Occupancy.occupied at the middle of each candidate, origin + t direction "
        "whatever the direction's length (the occupancy maps positions itself), in training as in "
        "evaluation; do not end an unbounded scene at aabb, the box of the host's grid "
        "(estimator); take frame=, and ask at positions that it has moved (proposal).",
    ),
    Rule(
        "all-kept-equals-dense",
        "a sampler that changes more than what is skipped cannot be compared with the "
        "one that it replaces.",
        "march from t_min in steps of render_step_size, or of cone_angle times the distance "
        "where that is longer, leave candidates out and move none (estimator); draw from a "
        "histogram without preferring one end of the ray (proposal).",
    ),
    Rule(
        "no-gradient-to-the-gate",
        "the occupancy is frozen: its threshold was calibrated for the weights it has; and "
        "the field of the host must go on learning.",
        "sample under torch.no_grad as a context, not by switching gradients off, also where rays "
        "need gradients, and leave requires_grad of the gate as it is.",
    ),
    Rule(
        "zero-samples-well-formed",
        "rays into the sky have no samples; a batch of them must show the background and "
        "leave finite gradients, not end the run.",
        "return three empty tensors of the usual types, and no stand-in sample (estimator); "
        "return the usual number of samples with finite weights (proposal).",
    ),
    Rule(
        "visibility-pruning",
        "hosts pass sigma_fn to shade only what light reaches and what shows; a visible "
        "sample that is dropped is missing from the image and learns nothing.",
        "drop a sample when its transmittance is below early_stop_eps or its opacity below "
        "alpha_thre, both as given but for one thing: where opacities are low throughout, "
        "alpha_thre may be lowered, to no less than a tenth of their mean; with 0 for a limit, "
        "drop nothing for it.",
    ),
    Rule(
        "update-while-frozen-is-harmless",
        "hosts call update_every_n_steps (estimator), or set_anneal and step_cb (proposal), "
        "in every step, whatever the sampler is.",
        "accept every form of these calls; where an occupancy decides, do nothing.",
    ),
    Rule(
        "state-dict-round-trip",
        "a checkpoint is loaded into a sampler that was built from the configuration, with "
        "whatever occupancy that file holds by then; the checkpoint decides.",
        "keep what decides in parameters or buffers whose shapes do not depend on their "
        "values, and make anew what was derived from them when a state dict is loaded.",
    ),
    Rule(
        "two-processes",
        "ranks that train side by side average their gradients: with other samples on each "
        "they learn different scenes, and a call that one rank leaves out hangs all.",
        "keep what decides in buffers, which ranks share, of types that they can send (not "
        "int16); decide by nothing that belongs to a process (its number, its random numbers).",
    ),
    Rule(
        "outputs-can-be-drawn",
        "ns-render, ns-eval and the viewer draw every output of a model, and end with an "
        "exception at one that they cannot draw.",
        "return rgb [n_rays, 3], depth and accumulation [n_rays, 1] of the type and on the "
        "device of the rays, and other outputs with one channel of floats, or with three or more.",
    ),
    Rule(
        "same-image-in-eval",
        "a test image must not change from one rendering to the next, nor a figure with it.",
        "draw random numbers (noise, jitter, backgrounds) only while self.training is set, "
        "in the host and in its sampler; set no seed.",
    ),
    Rule(
        "samples-shift-in-training",
        "a field that is always asked at the same places learns bands between them.",
        "keep the sampler a submodule of the host, so that it is in training when the host "
        "is; let it shift each ray's samples, and leave them where it puts them.",
    ),
    Rule(
        "teaches-the-host-alone",
        "a host whose field gets no gradient learns nothing; a gate that gets one, or that "
        "an optimizer decays, no longer is the occupancy whose price was measured.",
        "sample under torch.no_grad as a context, shade outside of it, and leave "
        "self.leco_guide out of get_param_groups and of requires_grad_.",
    ),
    Rule(
        "nothing-superfluous-is-left",
        "grids and proposal networks that nobody asks any more take memory, make "
        "checkpoints large, and slow down each step of an optimizer and of data-parallel training.",
        "have the HostAdapter remove what the guide stands for from the host; hold the methods "
        "density_fn or get_density of proposal networks in a list, which the built-in adapter "
        "finds, and train all these networks in one parameter group.",
    ),
    Rule(
        "shades-only-what-is-kept",
        "what is shaded where all is empty is time lost, and a ray that is not shaded where "
        "something is has a hole; both happen when host and occupancy differ in coordinates.",
        "ask the field about all samples that the sampler returns and no others, beyond the "
        "host's box too, in the coordinates of the rays that the sampler was given.",
    ),
    Rule(
        "state-and-yaml-round-trip",
        "ns-eval, ns-render and the viewer open a run by its config.yml and checkpoint; the "
        "occupancy's file may be gone by then.",
        "keep in the config what YAML can say (no lambdas and no open objects), and in "
        "parameters or buffers all that decides how the model renders.",
    ),
    Rule(
        "empty-rays-show-background",
        "an occupancy leaves rays into the sky without samples, and sometimes a whole "
        "batch: that must neither end the run nor leave light or NaN in images and weights.",
        "give rays without samples accumulation 0 and the background's colour, divide by no "
        "sum of weights without a bound, and keep the loss connected to the field (packed); "
        "shade what the sampler returns all the same (fixed number of samples).",
    ),
    Rule(
        "guided-by-everything-is-dense",
        "guidance that changes more than what is skipped changes the image, and no "
        "calibration has measured that.",
        "let the sampler leave candidates out and move none, hand out all that it keeps, "
        "and cover each ray from its near to its far end where everything is occupied.",
    ),
    Rule(
        "held-out-images-teach-nothing",
        "a figure on test images says nothing if they were trained on.",
        "have next_train draw from train_dataset alone, let nothing that learns read eval_dataset, "
        "and let the data parser give no image to both splits.",
    ),
    Rule(
        "resumes-where-it-stopped",
        "long runs are interrupted, and go on from a checkpoint with what it holds alone.",
        "keep what a step depends on in parameters, buffers or extra state, or derive it "
        "in update_to_step, which nerfstudio calls before it loads the state.",
    ),
    Rule(
        "two-processes-step-alike",
        "data-parallel training averages the ranks' gradients: a host that does something "
        "else on one of them learns another scene with --machine.num-devices 2, or hangs.",
        "make the loss a mean over rays, let nothing depend on the rank, hold no buffers "
        "of types that ranks cannot send (int16).",
    ),
)
"""In the order in which they are applied."""
