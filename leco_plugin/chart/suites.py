"""The comparisons that the paper's reviewers asked for, as data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from leco_plugin.chart.contender import GRID, LEARNED, LONG_STEPS, Contender
from leco_plugin.chart.methods import NEVER_FROZEN, VARIANTS, contender_of_host
from leco_plugin.chart.protocol import Cores, Protocol, forecast_minutes
from leco_plugin.evaluation.report import usable_cores
from leco_plugin.host_configs import switch_nerf_host
from leco_plugin.hosts.guided_start import OWN_SAMPLER
from leco_plugin.method_configs import LEARNING, ON_GPU
from leco_plugin.scenes.input_error import InputError

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
CPU_STEPS = 400
"""The same on a CPU, for forecasts."""
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
        return self._protocol(STEPS, AT_ONCE)

    @property
    def on_two_cores(self) -> Protocol:
        """The protocol on two CPU cores, for forecasts on any machine."""
        return self._protocol(CPU_STEPS, 2)

    def _protocol(self, steps: int, at_once: int) -> Protocol:
        few = steps if self.seconds is None else None
        return Protocol(self.seconds, few, self.learn_seconds, at_once=at_once)

    def minutes(self, cores: Cores, seeds: int = 3) -> float:
        """Forecast of all its runs on two CPU cores."""
        return seeds * forecast_minutes(self.contenders, self.on_two_cores, cores)


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


def _switch(sampler: str) -> Contender:
    """`leco-switch-nerf` with a sampler, as `--methods` and `--samplers` give it."""
    found = contender_of_host("leco-switch-nerf", sampler, switch_nerf_host)
    assert found is not None
    return found


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
    """Names of suites, `all` among them or not, in the order of `SUITES`.

    Raises:
        InputError: there is no such suite.
    """
    for name in names:
        if name not in SUITES and name != ALL:
            listed = ", ".join(SUITES)
            raise InputError(f"there is no suite {name!r}; there are {listed}, and {ALL}")
    return [name for name in SUITES if name in names or ALL in names]
