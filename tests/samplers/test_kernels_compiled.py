"""Every kernel is compiled for A100 and H100 without one, those of the automatic sizes for cards at
home too: what interprets may still not compile."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest
import torch
from samplers.ahead_of_time import AT_HOME, CAPABILITIES, SHARED, Compiled, compiling

from leco_plugin.models.encodings import EncodingConfig
from leco_plugin.models.gate import Gate, GateConfig
from leco_plugin.models.sizing.sizes import LARGE, PAPER, SMALL
from leco_plugin.occupancy import Occupancy
from leco_plugin.samplers.cells.cache import CacheReport, CellCache, Tables
from leco_plugin.samplers.kernels import fused
from leco_plugin.samplers.kernels.gate_weights import GateWeights, gate_weights
from leco_plugin.samplers.marching import March, Rays, number
from leco_plugin.space import Space

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning:triton")

GATES = {
    "small": (SMALL.gate, "box", "bfloat16"),
    "large": (LARGE.gate, "contraction", "bfloat16"),
    "width 16": (GateConfig(width=16, layers=1), "box", "bfloat16"),
    "width 128": (GateConfig(EncodingConfig(octaves=20), width=128), "contraction", "bfloat16"),
    "paper": (PAPER.gate, "contraction", "bfloat16"),
    "float32": (GateConfig(width=32, layers=2), "box", "float32"),
}


def weights_of(name: str, capability: int, monkeypatch: pytest.MonkeyPatch) -> GateWeights:
    """A gate's weights, or a skip where its kernel is left to torch on such a device."""
    config, kind, precision = GATES[name]
    occupancy = Occupancy(Gate(config), Space(kind), 0.5, precision)
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda *_: (capability // 10, 0))
    if reason := fused._why_not(occupancy, torch.device("cuda")):
        pytest.skip(f"left to torch: {reason}")
    return gate_weights(occupancy)


def assert_it_fits(compiled: Compiled, capability: int) -> None:
    assert compiled.registers <= 255
    assert compiled.shared <= SHARED[capability]
    assert compiled.spilled <= 1024


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("triton")
    return tmp_path_factory.mktemp("compiled")


def on_each_card(names: Iterable[str], on_one: dict[str, int]) -> list[Any]:
    """Names with capabilities. Each takes seconds: those in `on_one` are compiled for one card by
    default, and for none where that is `NONE`."""
    return [
        pytest.param(name, card, marks=[pytest.mark.long] if on_one.get(name, card) != card else [])
        for name in names
        for card in CAPABILITIES
    ]


NONE = 0
ON_ONE = {
    "small": 80,
    "large": 90,
    "width 16": NONE,  # compiled below, for any strides
    "width 128": NONE,  # compiled below, as a part of the march
    "paper": 90,
    "float32": 80,
}


@pytest.mark.parametrize(("name", "capability"), on_each_card(GATES, ON_ONE))
def test_the_gate_compiles(name: str, capability: int, folder: Path, monkeypatch) -> None:
    from leco_plugin.samplers.kernels import gate_kernel

    weights = weights_of(name, capability, monkeypatch)
    with compiling(gate_kernel, "_gate_kernel", capability, folder) as compiled:
        gate_kernel.gate_decisions(weights, torch.zeros(300, 3))
    assert len(compiled) == 1
    assert_it_fits(compiled[0], capability)


def test_the_gate_compiles_for_any_strides(folder: Path, monkeypatch) -> None:
    from leco_plugin.samplers.kernels import gate_kernel

    weights = weights_of("width 16", 90, monkeypatch)
    with compiling(gate_kernel, "_gate_kernel", 90, folder) as compiled:
        for places in (
            torch.zeros(3, 300).T,
            torch.zeros(300, 16)[:, :3],
            torch.zeros(3).expand(9, 3),
        ):
            gate_kernel.gate_decisions(weights, places)
    assert len(compiled) == 3
    for each in compiled:
        assert_it_fits(each, 90)


MARCHES = {
    "small": ("small", 0.0, torch.int16),
    "large": ("large", 1.0 / 256.0, torch.int32),
    "width 128": ("width 128", 1.0 / 256.0, torch.int16),
}
"""Gate, cone angle, and the type of the coarse cells."""


def cells(space: Space, dtype: torch.dtype, resolution: int = 32) -> CellCache:
    """Cells that know nothing, of the shapes that a kernel reads."""
    tables = Tables(
        coarse=torch.zeros((resolution + 2) ** 3, dtype=dtype),
        fine=torch.zeros(4, 64, dtype=torch.uint8),
        first_plane=torch.zeros(4, dtype=torch.int32),
        planes=torch.zeros(5, 7, dtype=torch.int8),
        clearance=torch.zeros(4 * resolution**3, dtype=torch.uint8),
    )
    return CellCache(
        tables, space, CacheReport(resolution, tables.bytes, *[0.0] * 2, 0, *[0.0] * 3)
    )


@pytest.mark.parametrize(
    ("name", "capability"), on_each_card(MARCHES, {"small": 80, "large": 80, "width 128": 90})
)
def test_the_march_compiles(name: str, capability: int, folder: Path, monkeypatch) -> None:
    weights = weights_of(MARCHES[name][0], capability, monkeypatch)
    assert weights.padded_width <= fused.WIDEST_MARCH
    compile_march(name, weights, capability, folder)


def compile_march(name: str, weights: GateWeights, capability: int, folder: Path) -> None:
    from leco_plugin.samplers.kernels import march_kernel

    gate, cone_angle, dtype = MARCHES[name]
    cache = cells(Space(GATES[gate][1]), dtype)
    rays = Rays(torch.zeros(5, 3), torch.ones(5, 3), torch.zeros(5), torch.ones(5))
    candidates = number(rays, March(0.1, cone_angle))
    with compiling(march_kernel, "_march_kernel", capability, folder) as compiled:
        march_kernel.march_kept(cache, weights, candidates)
    assert len(compiled) == 1  # nothing ran, nothing was counted, nothing is written
    assert_it_fits(compiled[0], capability)


@pytest.mark.long  # `large` is compiled for other cards by default
@pytest.mark.parametrize("capability", AT_HOME)
def test_the_automatic_sizes_compile_for_cards_at_home(
    capability: int, folder: Path, monkeypatch
) -> None:
    from leco_plugin.samplers.kernels import gate_kernel

    weights = weights_of("large", capability, monkeypatch)
    with compiling(gate_kernel, "_gate_kernel", capability, folder) as compiled:
        gate_kernel.gate_decisions(weights, torch.zeros(300, 3))
    assert_it_fits(compiled[0], capability)
    compile_march("large", weights, capability, folder)
