"""The cases: each a scene or a disturbance, with a reason to exist. All of them are data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from leco_plugin.names import unknown_name
from leco_plugin.scenes.input_error import InputError
from leco_plugin.stability.photographs import STAGES, Capture
from leco_plugin.stability.plan import DENSE, GRID, GRIDS, LEARNED, RAYS

BOUNDED = (LEARNED, *(f"{GRID}-{cells}" for cells in GRIDS), DENSE)
"""Samplers whose host has bounds: Nerfacto contracts all of space, and has none."""
SCALE = "pipeline.datamanager.dataparser.scene_scale"


@dataclass(frozen=True)
class Case:
    """One row of the table."""

    name: str
    """A stage of the same name is what is there; else it is the yard."""
    title: str
    why: str
    """What it is for, in a sentence."""
    capture: Capture = field(default_factory=Capture)
    changes: Mapping[str, Any] = field(default_factory=dict)
    """Settings of the model; those of the occupancy count for what learns one."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Settings of the whole method."""
    grid_levels: int = 1
    """Nested boxes of occupancy grids: as many as somebody who knows the scene would take."""
    fine_grid: bool = False
    """Whether the size of cells is the question, so that 256^3 are tried too. To keep these up to
    date takes a core of a CPU minutes."""
    only: tuple[str, ...] = ()
    """Samplers that it has something to say about; none is all. References join by themselves."""
    seeds: int = 1
    """The fewest that learned occupancy has in it."""
    must_fail: bool = False
    """Whether it shows that the suite can tell a failure: learned occupancy has to fail in it."""

    def is_about(self, sampler: str) -> bool:
        is_fine = sampler == f"{GRID}-{GRIDS[-1]}"
        return (not self.only or sampler in self.only) and (self.fine_grid or not is_fine)

    @property
    def scene(self) -> str:
        """Name of its scene's folder: cases with equal pictures share one."""
        has_own = self.name in STAGES or self.capture != Capture()
        return self.name if has_own else "yard"


def _learning(name: str, title: str, why: str, *, must_fail: bool = False, **changes: Any) -> Case:
    """A case that changes how the occupancy is learned: by paths, two underscores for a dot."""
    prefix = "occupancy.learning."
    paths = {prefix + path.replace("__", "."): value for path, value in changes.items()}
    return Case(name, title, why, changes=paths, only=(LEARNED,), must_fail=must_fail)


def _paper(name: str, title: str, why: str, **changes: Any) -> Case:
    """The same with the losses in the paper's form."""
    return _learning(name, title, why, gate_loss__form="paper", **changes)


CASES = {
    case.name: case
    for case in (
        Case("yard", "a yard", "nothing is difficult: who fails here fails everywhere"),
        Case(
            "poles-and-wires",
            "poles and wires",
            "a wire is thinner than a cell, and costs no PSNR when it disappears",
            fine_grid=True,
        ),
        Case("glass", "glass", "low density that matters, before surfaces"),
        Case("fog", "fog", "low density everywhere: nothing is empty, nothing is solid"),
        Case(
            "all-empty",
            "nothing but sky",
            "a gate may call all of it empty, and must not collapse over it",
            Capture(stand="low"),
        ),
        Case("all-full", "matter everywhere", "nothing may be skipped"),
        Case(
            "far-terrain",
            "sky and far terrain",
            "half of every picture lies outside any box that fits the scene",
            Capture(stand="low"),
            grid_levels=2,
        ),
        Case(
            "outline",
            "irregular outline",
            "no box fits the scene, and one camera stands far outside",
            Capture(stray=1),
        ),
        Case(
            "indoors",
            "inside a building",
            "cameras inside the matter that they see: what is empty is around them",
            Capture(stand="inside"),
        ),
        Case(
            "bounds-too-small",
            "bounds 4 x too small",
            "bounds are guessed, and most of the scene lies outside them",
            settings={SCALE: 0.25},
            only=BOUNDED,
        ),
        Case(
            "bounds-too-large",
            "bounds 4 x too large",
            "bounds are guessed, and cells are four times as coarse",
            settings={SCALE: 4.0},
            only=BOUNDED,
            fine_grid=True,
        ),
        Case(
            "six-views",
            "six views only",
            "over a third of the places are in two pictures at most: haze explains those as well "
            "as surfaces",
            Capture(views=6),
        ),
        Case(
            "exposure",
            "changing exposure",
            "no density explains what differs between pictures, and haze tries",
            Capture(exposure=0.35),
        ),
        Case(
            "pose-noise",
            "noisy poses",
            "surfaces do not meet, and a sharp occupancy cuts off the half that is elsewhere",
            Capture(shift=0.03, turn=0.3),
        ),
        Case(
            "moving",
            "moving objects",
            "what is there in a third of the pictures only must not take the floor along",
            Capture(moving=True),
        ),
        Case(
            "resolutions",
            "three resolutions",
            "batches mix pictures of different sizes",
            Capture(sizes=(1.0, 0.5, 1.5)),
        ),
        Case(
            "far-origin",
            "origin 10 km away",
            "metric coordinates leave float32 a millimetre",
            Capture(origin=(10_000.0, -14_000.0, 300.0)),
        ),
        _paper(
            "ratio-too-low",
            "empty ratio 5 x too low",
            "the target that the paper has one guess, guessed wrong",
            gate_loss__empty_ratio=0.9 / 5,
        ),
        _paper(
            "ratio-too-high",
            "occupied ratio 5 x too low",
            "the same in the other direction: the gate is pressed to call surfaces empty",
            gate_loss__empty_ratio=1.0 - 0.1 / 5,
        ),
        *(
            _paper(
                f"lambda-{letter}-{word}",
                f"λ_{letter} {sign} 10",
                f"the weight of the {loss} loss is ten times too {size}",
                **{f"gate_loss__{key}": weight * times},
            )
            for letter, key, loss, weight in (
                ("g", "imbalance", "imbalanced gate", 5e-3),
                ("d", "density", "density", 1.0),
            )
            for word, sign, size, times in (
                ("high", "x", "large", 10.0),
                ("low", "/", "small", 0.1),
            )
        ),
        Case(
            "learning-rate",
            "learning rate x 10",
            "steps that overshoot, of host and gate alike",
            changes={"occupancy.rate": 10.0},
            settings={"optimizers.fields.optimizer.lr": 1e-1},
        ),
        Case(
            "few-rays",
            "32 rays a batch",
            "gradients of few rays, and statistics of few samples",
            changes={"occupancy.rays": 32},
            settings={RAYS: 32},
        ),
        *(
            _learning(
                f"emphasis-{word}",
                f"k {sign} 10",
                f"a lost contribution is ten times too {price}, in the losses used by default",
                gate_loss__emphasis=8.0 * times,
            )
            for word, sign, price, times in (
                ("high", "x", "dear", 10.0),
                ("low", "/", "cheap", 0.1),
            )
        ),
        _learning(
            "bf16",
            "bfloat16",
            "eight bits of mantissa decide what is kept; the default on GPUs and with AMX",
            precision="bfloat16",
        ),
        _learning(
            "fp16", "float16", "small gradients vanish, large ones overflow", precision="float16"
        ),
        Case(
            "ten-seeds",
            "ten seeds",
            "one seed in ten goes bad, and nobody looks",
            only=(LEARNED,),  # others have no more seeds here than in the yard
            seeds=10,
        ),
        _paper(
            "homogeneous",
            "equal experts (must fail)",
            "an occupancy from equal experts, of which no density keeps one empty, not "
            "calibrated and never checked, skips surfaces: a suite that passes it is blind",
            must_fail=True,
            gate_loss__density=0.0,
            gate_loss__empty_ratio=None,
            gate_loss__fall_back=False,
            sizes__field__experts__empty_expert="mlp",
            sizes__field__experts__empty_layers=2,
            calibration__lost_surface_mass=1.0,
            calibration__image_price_db=1e3,
            calibration__recheck_rays=0,
        ),
    )
}


def cases_named(names: tuple[str, ...]) -> list[Case]:
    """The cases of names, in the table's order, or all; an `InputError` for an unknown name."""
    unknown = [name for name in names if name not in CASES]
    if unknown:
        raise InputError(unknown_name("case", unknown[0], CASES))
    return [case for case in CASES.values() if not names or case.name in names]
