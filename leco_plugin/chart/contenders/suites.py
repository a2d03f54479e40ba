"""The comparisons that the paper's reviewers asked for, each by name and as data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from leco_plugin.chart.contenders import forecast
from leco_plugin.chart.contenders.contender import Contender
from leco_plugin.chart.contenders.forecast import Cores
from leco_plugin.chart.contenders.methods import GRID, LEARNED, NEVER_FROZEN, VARIANTS
from leco_plugin.chart.contenders.protocol import Protocol
from leco_plugin.evaluation.machine import usable_cores
from leco_plugin.hosts.guided_start import OWN_SAMPLER
from leco_plugin.method_configs import LEARNING, ON_GPU, best_device
from leco_plugin.models.switch.config import switch_sizes_for
from leco_plugin.scenes.input_error import InputError

SCENE_LAYERS = LEARNING.sizes.field.experts.layers
SWITCH_CELLS = switch_sizes_for(best_device()).grid_resolution
"""Of the grid that Switch-NeRF has by itself."""
GRIDS = (128, 256, 512) if ON_GPU else (64, 128, 256)
"""Cells along an axis, learned beside the host; 512^3 would take two CPU cores all of a run."""
MADE_GRIDS = (64, 128, 256, 512)
"""Made from one field, each from the one before, which costs less than training beside them."""
STEPS = 2 * LEARNING.schedule.learn_steps
"""Where the question is what was learned: learning has its half, and half of that again where a
gate has not settled."""
CPU_STEPS = 400
"""What that is on a CPU, for forecasts."""
AT_ONCE = 1 if ON_GPU else min(2, usable_cores())
"""Runs beside each other: small tensors gain more by another run than by another thread."""
ALL = "all"


@dataclass(frozen=True)
class Suite:
    """A named comparison."""

    question: str
    """What it answers, and who asked."""
    contenders: tuple[Contender, ...]
    seconds: float | None = None
    """Training time of a run, without `--seconds` and `--steps`."""
    learn_seconds: float | None = None
    """Most of that for learning an occupancy; None is the usual share."""

    @property
    def protocol(self) -> Protocol:
        """Of its runs where nothing else is asked for. Suites that agree in it share runs."""
        steps = STEPS if self.seconds is None else None
        return Protocol(self.seconds, steps, self.learn_seconds, at_once=AT_ONCE)

    @property
    def on_two_cores(self) -> Protocol:
        """The same for a forecast, whatever machine this is."""
        steps = CPU_STEPS if self.seconds is None else None
        return Protocol(self.seconds, steps, self.learn_seconds, at_once=2)

    def minutes(self, cores: Cores, seeds: int = 3) -> float:
        """About how long all of it takes on two CPU cores."""
        return seeds * forecast.minutes(self.contenders, self.on_two_cores, cores)


def _leco(name: str, **changes: object) -> Contender:
    """`leco-occupancy` with settings changed; `__` stands for the dots of their paths."""
    paths = {path.replace("__", "."): value for path, value in changes.items()}
    return Contender(name, "leco-occupancy", LEARNED, paths)


def _paper(name: str, **changes: object) -> Contender:
    return _leco(name, gate_loss__form="paper", gate_loss__fall_back=False, **changes)


def _empty_mlp(layers: int) -> dict[str, object]:
    """Changes that make the empty-space expert an MLP as wide as a scene expert."""
    return {
        "sizes__field__experts__empty_expert": "mlp",
        "sizes__field__experts__empty_layers": layers,
    }


def _switch(sampling: str, sampler: str, **changes: object) -> Contender:
    """`leco-switch-nerf` with a sampler, as `--methods` and `--samplers` would have it."""
    paths = {path.replace("__", "."): value for path, value in changes.items()}
    return Contender(f"Switch-NeRF + {sampling}", "leco-switch-nerf", sampler, paths)


def _switch_grid(cells: int) -> Contender:
    return _switch(
        f"grid {cells}³",
        f"{GRID}-{cells}",
        occupancy__sampler=OWN_SAMPLER,
        host__sampling="occupancy-grid",
        host__sizes__grid_resolution=cells,
    )


SWITCH_LEARNED = _switch("learned occupancy", LEARNED, occupancy__sampler=LEARNED)
SWITCH_OWN = _switch("coarse and fine samples", OWN_SAMPLER, occupancy__sampler=OWN_SAMPLER)
SCENE_SIZED = _empty_mlp(SCENE_LAYERS)

SUITES = {
    "representations": Suite(
        "Is a small MLP the best place for an occupancy? (reviews 1 and 2)",
        (
            replace(_leco("MLP on frequencies (ours)"), grids=MADE_GRIDS, taught=True),
            *(
                Contender(
                    name, "leco-occupancy", f"{LEARNED}-{kind}", {"sizes.gate.encoding.kind": kind}
                )
                for kind, name in (
                    ("hash", "hash grid"),
                    ("vm", "TensoRF planes"),
                    ("k-planes", "K-planes"),
                )
            ),
        ),
    ),
    "empty-expert": Suite(
        "How small must the empty-space expert be, and what if there is none? (reviews 3 and 6)",
        (
            _leco("identity (ours)"),
            _leco("MLP of one layer", **_empty_mlp(1)),
            _leco("as large as a scene expert", **SCENE_SIZED),
            _leco("none: density is zero", sizes__field__experts__empty_expert="none"),
            _paper("imbalance loss alone, identity", gate_loss__density=0.0),
            _paper("imbalance loss alone, large", gate_loss__density=0.0, **SCENE_SIZED),
        ),
    ),
    "losses": Suite(
        "What do the losses of the gate do?",
        (
            _leco("contribution (ours)"),
            _paper("paper: imbalance and density"),
            _paper("paper without density loss", gate_loss__density=0.0),
            _paper(
                "balanced as in Switch-NeRF",
                gate_loss__density=0.0,
                gate_loss__empty_ratio=None,
            ),
        ),
    ),
    "freeze": Suite(
        "Why freeze and train again, instead of going on with the same network? (review 4)",
        (
            _leco("learn, freeze, go on"),
            replace(VARIANTS["leco-occupancy-retrained"], name="learn, freeze, from scratch"),
            replace(NEVER_FROZEN, name="never frozen"),
            replace(VARIANTS["leco-occupancy-homogeneous"], name="equal experts, no gate"),
        ),
        seconds=90.0,
        learn_seconds=45.0,
    ),
    "enough-time": Suite(
        "Does it still pay with enough training time? (review 5)",
        (SWITCH_LEARNED, SWITCH_OWN, _switch_grid(SWITCH_CELLS)),
        seconds=120.0,
    ),
    "grid-resolution": Suite(
        "Is a finer occupancy grid as good? (review 1)",
        (SWITCH_LEARNED, *(_switch_grid(cells) for cells in GRIDS)),
        seconds=120.0,
    ),
}
"""In an order in which each can take over most from those before it."""


def suite(name: str) -> Suite:
    """The suite of a name.

    Raises:
        InputError: there is none.
    """
    if name not in SUITES:
        raise InputError(f"there is no suite {name!r}; there are {', '.join(SUITES)}, and {ALL}")
    return SUITES[name]


def in_order(names: Sequence[str]) -> list[str]:
    """Names of suites, `all` among them or not, in the order of `SUITES`.

    Raises:
        InputError: there is no such suite.
    """
    for name in names:
        if name != ALL:
            suite(name)
    return [name for name in SUITES if name in names or ALL in names]
