"""Claims about gates of growing size."""

from __future__ import annotations

from leco_plugin.capacity.choice import NAMES
from leco_plugin.capacity.search import gates, grids, ladder, name_of, values_of
from leco_plugin.models.gate import Gate, GateConfig, check_sizes


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


def test_every_family_grows() -> None:
    candidates = gates() + grids((64, 32))
    assert {candidate.family for candidate in candidates} == set(NAMES)
    assert len({candidate.key for candidate in candidates}) == len(candidates)
    for family in NAMES:
        sizes = [candidate.bytes for candidate in candidates if candidate.family == family]
        assert sizes == sorted(sizes) and sizes[-1] > 2 * sizes[0]
    assert grids((32,))[0].bytes == 32**3 / 8
    for candidate in gates():
        assert candidate.gate is not None
        check_sizes(candidate.gate)
