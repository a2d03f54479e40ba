"""Claims about the gates that are tried."""

from __future__ import annotations

from dataclasses import replace

from leco_plugin.models.gate import Gate, GateConfig, check_sizes
from leco_plugin.shrink.ladder import ladder, name_of, values_of


def test_it_goes_from_small_to_large_and_stays_below_the_original() -> None:
    gates = ladder(values_of(GateConfig()))
    sizes = [values_of(gate) for gate in gates]
    assert sizes == sorted(sizes) and sizes[0] < 300 and sizes[-1] < values_of(GateConfig())
    assert {gate.encoding.kind for gate in gates} == {"frequency", "vm", "k-planes"}
    assert len({name_of(gate) for gate in gates}) == len(gates)


def test_of_each_size_the_one_without_a_norm_comes_first() -> None:
    gates = ladder(values_of(GateConfig()))
    assert [gate.normed for gate in gates] == [False, True] * (len(gates) // 2)
    assert [replace(gate, normed=True) for gate in gates[::2]] == gates[1::2]


def test_each_can_be_built_and_saved() -> None:
    for gate in ladder(10**9):
        check_sizes(gate)
        assert values_of(gate) == sum(p.numel() for p in Gate(gate).parameters())
