"""The comparisons that the paper's reviewers asked for, each by name and as data."""

from __future__ import annotations

from dataclasses import dataclass, replace

from leco_plugin.chart.contender import Contender
from leco_plugin.chart.methods import GRID, LEARNED, NEVER_FROZEN, VARIANTS
from leco_plugin.chart.protocol import Protocol
from leco_plugin.method_configs import LEARNING, ON_GPU
from leco_plugin.models.guided_start import OWN_SAMPLER
from leco_plugin.scenes.input_error import InputError

SCENE_LAYERS = LEARNING.sizes.field.experts.layers
SCENE_EXPERTS = LEARNING.sizes.gate.scene_experts
GRIDS = (128, 256, 512) if ON_GPU else (64, 128, 256)
"""A grid of 256^3 cells in four levels takes a minute of two CPU cores each time it is updated."""
MADE_GRIDS = (64, 128, 256, 512)
"""Made from one field, each from the one before, which costs less than training beside them."""


@dataclass(frozen=True)
class Suite:
    """A named comparison."""

    question: str
    """What it answers, and who asked."""
    contenders: tuple[Contender, ...]
    seconds: float = 80.0
    """Training time of a run without `--seconds`: enough for 30 s of learning an occupancy, and
    three seeds take under 45 minutes on two CPU cores."""

    def minutes(self, seeds: int = 3) -> float:
        """About how long all of it takes on two CPU cores."""
        minutes = Protocol(self.seconds).minutes(self.contenders)
        assert minutes is not None
        return seeds * minutes


def _leco(name: str, **changes: object) -> Contender:
    """`leco-occupancy` with settings changed; `__` stands for the dots of their paths."""
    paths = {path.replace("__", "."): value for path, value in changes.items()}
    return Contender(name, "leco-occupancy", LEARNED, paths)


def _empty_mlp(name: str, layers: int) -> Contender:
    return _leco(
        name,
        sizes__field__experts__empty_expert="mlp",
        sizes__field__experts__empty_layers=layers,
    )


def _paper(name: str, **changes: object) -> Contender:
    return _leco(name, gate_loss__form="paper", **changes)


def _ngp_grid(cells: int) -> Contender:
    options = {"resolution": cells, "levels": NGP_LEVELS}
    changes = {"occupancy.sampler": GRID, "occupancy.options": options}
    return Contender(f"Instant-NGP + grid {cells}³", "leco-ngp", f"{GRID}-{cells}", changes)


OURS = _leco("learn, freeze, go on")
NGP_LEARNED = Contender(
    "Instant-NGP + learned occupancy", "leco-ngp", LEARNED, {"occupancy.sampler": LEARNED}
)
NGP_OWN = Contender(
    "Instant-NGP + own grid", "leco-ngp", OWN_SAMPLER, {"occupancy.sampler": OWN_SAMPLER}
)
NGP_LEVELS = 4
"""Nested grids, as many as Instant-NGP has around a scene without bounds."""

SUITES = {
    "empty-expert": Suite(
        "How small must the empty-space expert be, and what if there is none? (reviews 3 and 6)",
        (
            _leco("identity (ours)"),
            _empty_mlp("MLP of one layer", 1),
            _empty_mlp("MLP as large as a scene expert", SCENE_LAYERS),
            _empty_mlp("MLP twice as deep", 2 * SCENE_LAYERS),
            _leco("none: density is zero", sizes__field__experts__empty_expert="none"),
        ),
    ),
    "losses": Suite(
        "What do the losses of the gate do?",
        (
            _leco("contribution (ours)"),
            _leco("ours without agreement", gate_loss__agreement=0.0),
            _paper("paper: imbalance and density"),
            _paper("paper without density loss", gate_loss__density=0.0),
            _paper(
                "balanced as in Switch-NeRF",
                gate_loss__density=0.0,
                gate_loss__empty_ratio=1.0 / (1 + SCENE_EXPERTS),
            ),
        ),
    ),
    "freeze": Suite(
        "Why freeze and train again, instead of going on with the same network? (review 4)",
        (
            OURS,
            replace(VARIANTS["leco-occupancy-retrained"], name="learn, freeze, from scratch"),
            replace(NEVER_FROZEN, name="never frozen"),
            replace(VARIANTS["leco-occupancy-homogeneous"], name="equal experts, no gate"),
        ),
    ),
    "representations": Suite(
        "Is a small MLP the best place for an occupancy? (reviews 1 and 2)",
        (
            replace(_leco("MLP on frequencies (ours)"), grids=MADE_GRIDS),
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
    "enough-time": Suite(
        "Does it still pay with enough training time? (review 5)",
        (
            replace(OURS, name="LeCO + learned occupancy"),
            VARIANTS["leco-occupancy-homogeneous"],
            NGP_LEARNED,
            NGP_OWN,
        ),
        seconds=160.0,
    ),
    "grid-resolution": Suite(
        "Is a finer occupancy grid as good? (review 1)",
        (NGP_LEARNED, *(_ngp_grid(cells) for cells in GRIDS)),
    ),
}


def suite(name: str) -> Suite:
    """The suite of a name.

    Raises:
        InputError: there is none.
    """
    if name not in SUITES:
        raise InputError(f"there is no suite {name!r}; there are {', '.join(SUITES)}")
    return SUITES[name]
