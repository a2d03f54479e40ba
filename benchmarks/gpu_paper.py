"""What the GPU suite's bars are on paper: `python benchmarks/gpu_paper.py`.

Bytes and operations against the data sheets of two cards; nothing here is measured on a card.
docs/gpu-kernels.md holds the tables that this prints, and a test compares them.
"""

from __future__ import annotations

from typing import NamedTuple

import checkout  # noqa: F401
from gpu_counts import STEPS, Counted
from gpu_floor import Ceilings, floor_seconds, operations_per_position
from gpu_twin import bytes_of_twin

from leco_plugin.models.field import HMoEField
from leco_plugin.models.sizing.sizes import LARGE, PAPER, SMALL, Sizes

CARDS = {"H100 SXM": Ceilings(3.35e12, 989e12), "A100 SXM": Ceilings(2.04e12, 312e12)}
"""Data sheets: memory bandwidth, and dense bf16 products."""
GATES = {"small": SMALL.gate, "large": LARGE.gate, "paper": PAPER.gate}
TWIN_BAR = 5.0
"""Times that the fused gate must be faster than its eager twin."""
KEPT = (0.1, 0.25, 0.4)
"""Shares of the candidates that a guided step shades."""
COUNTED = Counted(
    rays=4096,
    candidates=2_928_640,
    stretches=94_208,
    near=70_524,
    asked=16_203,
    kept=577_402,
    cell_bytes=960_834,
)
"""What `gpu_counts.py` prints."""
LAUNCHES = 2
BYTES_OF_RAY, BYTES_KEPT = 4 * (6 + 5) + 8 * 3, 8 + 4 + 4
"""In each launch: coordinates, numbers, where its samples begin and end, how many they are. Of a
sample: its ray, its start, its end."""
GRID_BYTES = 4 * 128**3
"""One for each cell of four levels, if all are read."""
PAIR, ROUND_TRIP = 2, 3
"""Operations of a multiplication with an addition; products of a step for one of its forward."""


def gate_table() -> str:
    """The floor of each gate on each card, picoseconds a position."""
    lines = [
        "| gate | operations | card | by operations | by bytes | floor |",
        "|---|---|---|---|---|---|",
    ]
    for name, gate in GATES.items():
        for card, ceilings in CARDS.items():
            terms = {k: 1e12 * v for k, v in floor_seconds(gate, 1, ceilings).items()}
            lines.append(
                f"| {name} | {operations_per_position(gate):,} | {card} "
                f"| {terms['operations']:.1f} ps | {terms['bytes']:.1f} ps "
                f"| {terms['floor']:.1f} ps: {1e3 / terms['floor']:.1f} billion a second |"
            )
    return "\n".join(lines)


def twin_table() -> str:
    """What each gate's eager twin takes at least, and what the second bar leaves the kernel."""
    head = "| gate | bytes of its twin | " + " | ".join(f"{card}: twin, bar" for card in CARDS)
    lines = [head + " |", "|---" * (2 + len(CARDS)) + "|"]
    for name, gate in GATES.items():
        moved = bytes_of_twin(gate)
        taken = [1e12 * moved / ceilings.bytes_per_second for ceilings in CARDS.values()]
        cells = " | ".join(f"{time:.0f} ps, {time / TWIN_BAR:.0f} ps" for time in taken)
        lines.append(f"| {name} | {moved:,.0f} | {cells} |")
    return "\n".join(lines)


def field_operations(sizes: Sizes) -> int:
    """Of the matrix products of a sample's density: projection, one scene expert, density head.

    Colour is left out: only samples that are seen have one.
    """
    config, width = sizes.field, sizes.field.experts.width
    inputs = HMoEField(config, 1).encoding.out_dim
    layers = config.experts.layers + (config.experts.skip is not None)  # one is twice as wide
    return PAIR * (inputs * width + layers * width**2 + width)


class Step(NamedTuple):
    """A training step of one batch on paper."""

    operations: float
    kept_bytes: float
    """Held for the backward: written once and read once at least."""

    def floor(self, card: Ceilings) -> float:
        """Seconds by the larger of operations and bytes."""
        by_bytes = 2.0 * self.kept_bytes / card.bytes_per_second
        return max(by_bytes, self.operations / card.operations_per_second)


def step_of(sizes: Sizes, samples: float, asked: float, guided: bool) -> Step:
    """Operations and memory of a step that shades some samples, of candidates that were asked."""
    gate, field = operations_per_position(sizes.gate), field_operations(sizes)
    gate_shaded = gate * (1 if guided else ROUND_TRIP)  # a frozen gate has no backward
    operations = samples * (ROUND_TRIP * field + gate_shaded) + asked * gate
    return Step(operations, samples * bytes_kept(sizes, guided))


def bytes_kept(sizes: Sizes, guided: bool) -> int:
    """Bytes that a sample's activations take until the backward, in bfloat16.

    Features of encoding and gate in float32; of the experts, the input of each layer; where the
    gate learns, the same of its own.
    """
    width, experts = sizes.field.experts.width, sizes.field.experts
    inputs = HMoEField(sizes.field, 1).encoding.out_dim
    layers = experts.layers + (experts.skip is not None)
    field = 4 * inputs + 2 * width * (1 + layers + 1)
    gate = 4 * (3 + 6 * sizes.gate.encoding.octaves) + 2 * sizes.gate.width * (
        sizes.gate.layers + 1
    )
    return field + (0 if guided else gate)


def training_table() -> str:
    """A step of the paper's sizes, dense and guided at the same candidates of 1024 rays."""
    candidates = 1024 * PAPER.candidates
    dense = step_of(PAPER, candidates, 0, guided=False)
    head = "| step | Tflop | activations | " + " | ".join(f"floor, {card}" for card in CARDS)
    lines = [head + " |", "|---" * (3 + len(CARDS)) + "|"]
    rows = {"dense": dense}
    rows |= {
        f"guided, {share:.0%} kept": step_of(PAPER, share * candidates, candidates, guided=True)
        for share in KEPT
    }
    for name, step in rows.items():
        floors = " | ".join(
            f"{1e3 * step.floor(card):.2f} ms, {dense.floor(card) / step.floor(card):.1f} x faster"
            for card in CARDS.values()
        )
        lines.append(
            f"| {name} | {step.operations / 1e12:.3f} "
            f"| {step.kept_bytes / 2**30:.2f} GiB, {step.kept_bytes / dense.kept_bytes:.2f} x "
            f"| {floors} |"
        )
    return "\n".join(lines)


def sampling_table(work: Counted = COUNTED) -> str:
    """The suite's rays through unbounded space, with the gate and cells and with a grid."""
    operations = LAUNCHES * work.asked * STEPS * operations_per_position(SMALL.gate)
    written = BYTES_KEPT * work.kept
    moved = LAUNCHES * BYTES_OF_RAY * work.rays + written + work.cell_bytes
    lines = [
        "| card | by operations | by bytes | floor | grid 128^3 x 4, by bytes |",
        "|---|---|---|---|---|",
    ]
    for card, ceilings in CARDS.items():
        ours, bytes_moved, grid = (
            1e6 * operations / ceilings.operations_per_second,
            1e6 * moved / ceilings.bytes_per_second,
            1e6 * (written + GRID_BYTES) / ceilings.bytes_per_second,
        )
        floor = max(ours, bytes_moved)
        lines.append(
            f"| {card} | {ours:.1f} us | {bytes_moved:.1f} us | {floor:.1f} us | {grid:.1f} us |"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    print(gate_table(), twin_table(), training_table(), sampling_table(), sep="\n\n")
