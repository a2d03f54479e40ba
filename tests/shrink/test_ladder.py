"""Claims about the gates that are tried."""

from __future__ import annotations

from leco_plugin.capacity.measuring import gates
from leco_plugin.models.gate import Gate, GateConfig, check_sizes
from leco_plugin.shrink.ladder import ladder, name_of, values_of


def test_it_goes_from_small_to_large_and_stays_below_the_original() -> None:
    gates = ladder(values_of(GateConfig()))
    sizes = [values_of(gate) for gate in gates]
    assert sizes == sorted(sizes) and sizes[0] < 300 and sizes[-1] < values_of(GateConfig())
    assert {gate.encoding.kind for gate in gates} == {"frequency", "hash", "vm", "k-planes"}
    assert len({name_of(gate) for gate in gates}) == len(gates)


def test_gates_of_few_octaves_on_hash_grids_and_on_planes_have_a_norm() -> None:
    for gate in ladder(10**9):
        many = gate.encoding.kind == "frequency" and gate.encoding.octaves >= 5
        assert gate.normed == (not many)


def test_gates_on_hash_grids_are_those_of_the_capacity_page_and_below() -> None:
    tables = [gate for gate in ladder(10**9) if gate.encoding.kind == "hash"]
    measured = [candidate.gate for candidate in gates() if candidate.family == "hash"]
    assert [gate.encoding.log2_table for gate in tables] == [6, 7, 8]
    assert tables[-1] == measured[0]


def test_each_can_be_built_and_saved() -> None:
    for gate in ladder(10**9):
        check_sizes(gate)
        assert values_of(gate) == sum(p.numel() for p in Gate(gate).parameters())
