"""The contenders that names of methods, samplers and suites stand for.

A host takes any sampler of its kind, a method that learns its occupancy itself any kind of gate.
Suites are the comparisons that the reviewers of the paper asked for.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from leco_plugin.chart.contender import (
    DENSE,
    GRID,
    LEARNED,
    LONG_STEPS,
    WITHOUT_GIFTS,
    Contender,
    Protocol,
)
from leco_plugin.evaluation.report import usable_cores
from leco_plugin.host_configs import switch_nerf_host
from leco_plugin.hosts.guided import GuidedModelConfig
from leco_plugin.hosts.guided_start import OWN_SAMPLER
from leco_plugin.method_configs import LEARNING, ON_GPU
from leco_plugin.models.encodings import EncodingConfig
from leco_plugin.models.gate import GateConfig, check_sizes
from leco_plugin.models.leco_config import LecoModelConfig
from leco_plugin.models.switch.field import SwitchNerfModelConfig
from leco_plugin.names import unknown_name
from leco_plugin.samplers.registry import SamplerSpec
from leco_plugin.samplers.registry import samplers as registered_samplers
from leco_plugin.scenes.input_error import InputError
from leco_plugin.swap import registered

TAUGHT_GRID = f"{LEARNED}-grid"
GATE_KIND = "sizes.gate.encoding.kind"
SIZED_GRID = re.compile(rf"({GRID}|{TAUGHT_GRID})-(\d+)")

LONGER = 4
"""Times as long as a host's own steps are long steps."""
NGP_STEP = 2.0 * math.sqrt(3.0) / 1000.0
"""What nerfstudio's Instant-NGP has for a step of None, in the box of nerfstudio's readers."""
NO_GIFTS = {
    "occupancy.opaque_start": False,
    "occupancy.learning.termination": 0.0,
    "occupancy.learning.calibration.recheck_rays": 0,
}
"""Take from a learned occupancy what no grid is given: the opaque and the careful start, and the
distances of sparse points."""
SKIPPING_NOTHING = {"schedule.freeze": False, "front_to_back": True}
"""Never frozen; rendered front to back, as guided images are."""
SEVERAL_EXPERTS = {"sizes.field.experts.scene_experts": 4, "sizes.gate.scene_experts": 4}
"""Of what compares experts, however few the scene needs."""
NEVER_FROZEN = Contender("LeCO, never frozen", "leco-occupancy", DENSE, SKIPPING_NOTHING)
VARIANTS = {
    "leco-occupancy-never-frozen": NEVER_FROZEN,
    "leco-occupancy-retrained": Contender(
        "LeCO, frozen, then from scratch", "leco-occupancy", LEARNED, {"schedule.restart": True}
    ),
    "leco-occupancy-homogeneous": Contender(
        "LeCO, equal experts, no gate",
        "leco-occupancy",
        DENSE,
        SKIPPING_NOTHING | SEVERAL_EXPERTS | {"homogeneous": True},
    ),
}
"""Methods for the chart only: `leco-occupancy` with its phases changed."""

METHOD_NAMES = {
    "leco-occupancy": "LeCO",
    "leco-ngp": "Instant-NGP",
    "leco-nerfacto": "Nerfacto",
    "leco-switch-nerf": "Switch-NeRF",
    "leco-mega-nerf": "Mega-NeRF",
}
"""Names beside that of a sampler; other methods keep their own."""

SAMPLER_NAMES = {
    LEARNED: "learned occupancy",
    "learned-occupancy-hash": "hash-grid gate",
    "learned-occupancy-vm": "TensoRF gate",
    "learned-occupancy-k-planes": "K-planes gate",
    DENSE: "every sample",
    LONG_STEPS: "long steps, no skipping",
    WITHOUT_GIFTS: "learned occupancy without gifts",
}


def contenders(methods: Sequence[str], samplers: Sequence[str] = ()) -> list[Contender]:
    """Each method with each sampler that it can use; without samplers, with its usual ones.

    Raises:
        InputError: a name is unknown, or fits none of the others.
    """
    if not methods:
        raise InputError(
            "nothing to chart: name methods with --methods or a comparison with --suite"
        )
    known = [*registered_samplers(), f"{GRID}-128", OWN_SAMPLER, LONG_STEPS, WITHOUT_GIFTS]
    for sampler in samplers:
        name, cells = _name_and_cells(sampler)
        if sampler not in known and cells is None:
            raise InputError(unknown_name("sampler", sampler, sorted(known)))
        if cells is not None and cells < 2:
            raise InputError(f"the sampler {sampler!r} has too few cells: {name}-2 has the fewest")
        if cells is not None and name == TAUGHT_GRID:
            try:
                check_sizes(GateConfig(EncodingConfig("grid", plane_cells=cells)))
            except ValueError as error:
                raise InputError(f"the sampler {sampler!r} has too many cells: {error}") from None
    found: dict[str, Contender] = {}
    unused = dict.fromkeys(samplers)
    for method in dict.fromkeys(methods):
        usual, allowed, contender_with = _choices_of(method)
        fitting = {name: contender_with(name) for name in samplers or usual}
        made = {name: one for name, one in fitting.items() if one is not None}
        if not made:
            raise InputError(
                f"{method} has none of the samplers {', '.join(samplers)}; it has {allowed}"
            )
        for name, one in made.items():
            unused.pop(name, None)
            found[one.key] = one
    if unused:
        raise InputError(f"the sampler {next(iter(unused))!r} fits none of {', '.join(methods)}")
    return list(found.values())


def _name_and_cells(sampler: str) -> tuple[str, int | None]:
    """A sampler without the cells along an axis that its name may end with, and those."""
    sized = SIZED_GRID.fullmatch(sampler)
    return (sized[1], int(sized[2])) if sized else (sampler, None)


def _choices_of(method: str) -> tuple[list[str], str, Callable[[str], Contender | None]]:
    """The usual samplers of a method, all of them in words, and what makes a contender with one:
    None where the method cannot use it."""
    from nerfstudio.configs.method_configs import all_methods

    if method in VARIANTS:
        one = VARIANTS[method]
        return [one.sampler], one.sampler, {one.sampler: one}.get
    try:
        model: Any = registered(method).pipeline.model
    except InputError as error:
        if method in all_methods:
            raise
        raise InputError(f"{error}; and for charts {', '.join(VARIANTS)}") from None
    if isinstance(model, LecoModelConfig):
        kinds = [name for name, spec in registered_samplers().items() if spec.needs_occupancy]
        return [LEARNED], ", ".join([*kinds, DENSE]), partial(_contender_that_learns, method)
    every = ", ".join([*registered_samplers(), OWN_SAMPLER, LONG_STEPS, WITHOUT_GIFTS])
    if not isinstance(model, GuidedModelConfig):
        return [OWN_SAMPLER], every, partial(contender_of_host, method, host=model)
    usual = [LEARNED, OWN_SAMPLER, LONG_STEPS]
    return usual, every, partial(contender_of_host, method, host=model.host)


def _contender_that_learns(method: str, sampler: str) -> Contender | None:
    """A method that learns its occupancy itself, with a sampler."""
    called = METHOD_NAMES.get(method, method)
    if sampler == DENSE:
        return replace(NEVER_FROZEN, name=f"{called}, never frozen", method=method)
    base, cells = _name_and_cells(sampler)
    spec = registered_samplers().get(base)
    if spec is None or not spec.needs_occupancy:
        return None
    shown, changes = _gate_of(base, spec, cells)
    return Contender(f"{called} + {shown}", method, base, changes)


def _gate_of(sampler: str, spec: SamplerSpec, cells: int | None) -> tuple[str, dict[str, Any]]:
    """What a sampler is called in charts, and the changes that make a gate for it be learned."""
    shown, kind = SAMPLER_NAMES.get(sampler, sampler), spec.gate_encoding
    changes: dict[str, Any] = {GATE_KIND: kind} if kind else {}
    if sampler == TAUGHT_GRID:
        usual = EncodingConfig().plane_cells
        shown = f"taught grid {cells or usual}³"
        if cells not in (None, usual):  # one key for each grid, however it was named
            changes["sizes.gate.encoding.plane_cells"] = cells
    return shown, changes


def contender_of_host(method: str, sampler: str, host: Any) -> Contender | None:
    """A host, by its model's config, with a sampler of its kind; None for one of another kind."""
    sampler, cells = _name_and_cells(sampler)
    shown = SAMPLER_NAMES.get(sampler, sampler)
    changes: dict[str, Any] | None = {"occupancy.sampler": sampler}
    if sampler == OWN_SAMPLER:
        shown = _own_sampling_of(host)
    elif sampler == LONG_STEPS:
        changes = _long_steps(host)
    else:
        base = LEARNED if sampler == WITHOUT_GIFTS else sampler
        spec = registered_samplers()[base]
        proposes = hasattr(host, "num_proposal_samples_per_ray")
        if (spec.proposal if proposes else spec.estimator) is None:
            return None
        shown, of_gate = _gate_of(sampler, spec, cells)
        of_gate = {f"occupancy.learning.{path}": value for path, value in of_gate.items()}
        changes = {"occupancy.sampler": base, **of_gate}
        if sampler == WITHOUT_GIFTS:
            changes |= NO_GIFTS
        elif sampler == DENSE and hasattr(host, "cone_angle"):  # as far as its own grid goes
            changes["occupancy.options"] = {"levels": getattr(host, "grid_levels", 1)}
        elif sampler == GRID:
            cells = cells or _own_cells_of(host) or 128
            sampler = f"{GRID}-{cells}"  # one key for each grid, however it was named
            shown, changes = f"grid {cells}³", _grid_changes(host, cells)
    if changes is None:
        return None
    return Contender(f"{METHOD_NAMES.get(method, method)} + {shown}", method, sampler, changes)


def _long_steps(host: Any) -> dict[str, Any] | None:
    """Changes that give a host steps `LONGER` times as long, of which it skips none; None where it
    has another rule for its steps."""
    if isinstance(host, SwitchNerfModelConfig):
        candidates = max(1, host.sizes.candidates // LONGER)
        return {"occupancy.sampler": DENSE, "host.sizes.candidates": candidates}
    if hasattr(host, "num_proposal_samples_per_ray"):
        samples = max(1, host.num_proposal_samples_per_ray[0] // LONGER)
        return {"occupancy.sampler": "dense-proposal", "occupancy.options": {"samples": samples}}
    if not hasattr(host, "render_step_size") or not hasattr(host, "cone_angle"):
        return None
    return {
        "occupancy.sampler": DENSE,
        "occupancy.options": {"levels": getattr(host, "grid_levels", 1)},
        "host.render_step_size": LONGER * (host.render_step_size or NGP_STEP),
        "host.cone_angle": LONGER * host.cone_angle,
    }


def _own_sampling_of(host: Any) -> str:
    if isinstance(host, SwitchNerfModelConfig) and host.sampling == "coarse-fine":
        return "coarse and fine samples"
    if hasattr(host, "num_proposal_samples_per_ray"):
        return "proposal networks"
    cells = _own_cells_of(host)
    return "own sampling" if cells is None else f"own grid {cells}³"


def _own_cells_of(host: Any) -> int | None:
    """Cells along an axis of the host's own grid."""
    owner = host.sizes if isinstance(host, SwitchNerfModelConfig) else host
    cells = getattr(owner, "grid_resolution", None)
    return cells if isinstance(cells, int) else None


def _grid_changes(host: Any, cells: int) -> dict[str, Any]:
    """Changes that give a host an occupancy grid with so many cells along an axis."""
    if isinstance(host, SwitchNerfModelConfig):  # its grid follows the bounds that it finds
        return {
            "occupancy.sampler": OWN_SAMPLER,
            "host.sampling": "occupancy-grid",
            "host.sizes.grid_resolution": cells,
        }
    options = {"resolution": cells, "levels": getattr(host, "grid_levels", 1)}
    return {"occupancy.sampler": GRID, "occupancy.options": options}


SCENE_LAYERS = LEARNING.sizes.field.experts.layers
SWITCH_CELLS = switch_nerf_host.sizes.grid_resolution
"""Cells of Switch-NeRF's own grid."""
GRIDS = (128, 256, 512) if ON_GPU else (64, 128, 256)
"""Cells along an axis, updated while the host trains; 512^3 takes two CPU cores all of a run."""
MADE_GRIDS = (64, 128, 256, 512)
"""Made from one field, each from the one before, which costs less than updates in training."""
STEPS = 2 * LEARNING.schedule.learn_steps
"""Of suites that ask what was learned: half for learning, and a quarter more for a gate that has
not settled."""
AT_ONCE = 1 if ON_GPU else min(2, usable_cores())
"""Runs at a time: on a CPU, small tensors gain more by another run than by another thread."""
ALL = "all"


@dataclass(frozen=True)
class Suite:
    """A named comparison."""

    question: str
    """What it answers, and who asked."""
    contenders: tuple[Contender, ...]
    seconds: float | None = None
    """Training time of a run; None trains for `STEPS`."""
    learn_seconds: float | None = None
    """Limit for learning an occupancy; None is the usual share."""

    @property
    def protocol(self) -> Protocol:
        """The default protocol. Suites with the same one share runs."""
        steps = STEPS if self.seconds is None else None
        return Protocol(self.seconds, steps, self.learn_seconds, at_once=AT_ONCE)


def _leco(name: str, changes: Mapping[str, Any]) -> Contender:
    """`leco-occupancy` with settings changed."""
    return Contender(name, "leco-occupancy", LEARNED, changes)


def _experts(name: str, changes: Mapping[str, Any]) -> Contender:
    return _leco(name, {**SEVERAL_EXPERTS, **changes})


def _empty_mlp(layers: int) -> dict[str, Any]:
    experts = "sizes.field.experts."
    return {f"{experts}empty_expert": "mlp", f"{experts}empty_layers": layers}


def _switch(sampler: str) -> Contender:
    """`leco-switch-nerf` with a sampler, as `--methods` and `--samplers` give it."""
    found = contender_of_host("leco-switch-nerf", sampler, switch_nerf_host)
    assert found is not None
    return found


SCENE_SIZED = _empty_mlp(SCENE_LAYERS)
PAPER = {"gate_loss.form": "paper", "gate_loss.fall_back": False}
NO_DENSITY = PAPER | {"gate_loss.density": 0.0}
OTHER_GATES = {"hash": "hash grid", "vm": "TensoRF planes", "k-planes": "K-planes"}

SUITES = {
    "representations": Suite(
        "Is a small MLP the best place for an occupancy? (reviews 1 and 2)",
        (
            replace(_leco("MLP on frequencies (ours)", {}), grids=MADE_GRIDS, taught=True),
            *(
                Contender(name, "leco-occupancy", f"{LEARNED}-{kind}", {GATE_KIND: kind})
                for kind, name in OTHER_GATES.items()
            ),
        ),
    ),
    "empty-expert": Suite(
        "How small must the empty-space expert be, and what if there is none? (reviews 3 and 6)",
        (
            _experts("identity (ours)", {}),
            _experts("MLP of one layer", _empty_mlp(1)),
            _experts("as large as a scene expert", SCENE_SIZED),
            _experts("none: density is zero", {"sizes.field.experts.empty_expert": "none"}),
            _experts("imbalance loss alone, identity", NO_DENSITY),
            _experts("imbalance loss alone, large", NO_DENSITY | SCENE_SIZED),
        ),
    ),
    "losses": Suite(
        "What do the losses of the gate do?",
        (
            _experts("contribution (ours)", {}),
            _experts("paper: imbalance and density", PAPER),
            _experts("paper without density loss", NO_DENSITY),
            _experts("balanced as in Switch-NeRF", NO_DENSITY | {"gate_loss.empty_ratio": None}),
        ),
    ),
    "freeze": Suite(
        "Why freeze and train again, instead of going on with the same network? (review 4)",
        (
            _leco("learn, freeze, go on", {}),
            replace(VARIANTS["leco-occupancy-retrained"], name="learn, freeze, from scratch"),
            replace(NEVER_FROZEN, name="never frozen"),
            replace(VARIANTS["leco-occupancy-homogeneous"], name="equal experts, no gate"),
        ),
        seconds=90.0,
        learn_seconds=45.0,
    ),
    "enough-time": Suite(
        "Does it still pay with enough training time? (review 5)",
        tuple(map(_switch, (LEARNED, OWN_SAMPLER, f"{GRID}-{SWITCH_CELLS}", LONG_STEPS))),
        seconds=120.0,
    ),
    "grid-resolution": Suite(
        "Is a finer occupancy grid as good? (review 1)",
        tuple(map(_switch, (LEARNED, *(f"{GRID}-{cells}" for cells in GRIDS), LONG_STEPS))),
        seconds=120.0,
    ),
}
"""Ordered so that each can reuse most runs of those before it."""


def in_order(names: Sequence[str]) -> list[str]:
    """Names of suites, or `all`, in the order of `SUITES`. InputError for an unknown one."""
    for name in names:
        if name not in SUITES and name != ALL:
            raise InputError(unknown_name("suite", name, [*SUITES, ALL]))
    return [name for name in SUITES if name in names or ALL in names]
