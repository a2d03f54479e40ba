"""Claims about `leco_plugin.studio.hash_encoding`."""

from __future__ import annotations

import copy
import pickle
import time
from typing import Any
from unittest.mock import patch

import pytest
import torch
from nerfstudio.field_components.encodings import HashEncoding
from nerfstudio.models.base_model import ModelConfig
from nerfstudio.models.instant_ngp import InstantNGPModelConfig
from nerfstudio.models.nerfacto import NerfactoModelConfig
from small_hosts import what_a_model_gets
from torch import Tensor, nn

from leco_plugin.hosts.guided import GuidedModelConfig, Host, set_up_host
from leco_plugin.hosts.guided_start import OWN_SAMPLER, OccupancyConfig
from leco_plugin.models.compute.native import has_native
from leco_plugin.samplers.kernels import VARIABLE
from leco_plugin.studio import hash_encoding
from leco_plugin.studio.hash_encoding import CpuHashEncoding, speed_up_hash_encodings

Sizes = dict[str, int]
SIZES: list[Sizes] = [
    {"num_levels": 4, "max_res": 64, "log2_hashmap_size": 8, "features_per_level": 2},
    {"num_levels": 1, "max_res": 16, "log2_hashmap_size": 13, "features_per_level": 1},
    {"num_levels": 3, "max_res": 2048, "log2_hashmap_size": 10, "features_per_level": 4},
]


def pair_of(sizes: Sizes) -> tuple[HashEncoding, HashEncoding]:
    """nerfstudio's encoding, and the same one made fast."""
    twin = HashEncoding(implementation="torch", hash_init_scale=1.0, **sizes)
    module = nn.ModuleList([copy.deepcopy(twin)])
    speed_up_hash_encodings(module)
    fast = module[0]
    assert isinstance(fast, CpuHashEncoding)
    return twin, fast


def gradients(encoding: HashEncoding, positions: Tensor, worth: Tensor) -> tuple[Tensor, ...]:
    leaf = positions.clone().requires_grad_()
    encoded = encoding(leaf)
    return encoded, *torch.autograd.grad((encoded * worth).sum(), [leaf, encoding.hash_table])


def points(shape: tuple[int, ...], seed: int = 0) -> Tensor:
    """Off the cells' sides, where there is no one slope."""
    return 0.001 + 0.998 * torch.rand(*shape, 3, generator=torch.Generator().manual_seed(seed))


@pytest.fixture(autouse=True, params=["native", "torch"])
def by(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Everything holds of the routines in C and of torch."""
    if request.param == "torch":
        monkeypatch.setenv(VARIABLE, "native")
    elif not has_native():
        pytest.skip("no C compiler")
    return str(request.param)


@pytest.mark.parametrize("sizes", SIZES)
@pytest.mark.parametrize("shape", [(200,), (5, 7), (0,), ()])
def test_it_is_nerfstudios_function_with_its_slopes(sizes: Sizes, shape: tuple[int, ...]) -> None:
    twin, fast = pair_of(sizes)
    positions = points(shape)
    worth = torch.randn(*shape, twin.get_out_dim())
    for ours, theirs in zip(gradients(fast, positions, worth), gradients(twin, positions, worth)):
        largest = float(theirs.detach().abs().max()) if theirs.numel() else 0.0
        torch.testing.assert_close(ours, theirs, rtol=0.0, atol=3e-4 * largest)


def test_corners_sides_and_places_outside_are_looked_up_as_nerfstudio_does() -> None:
    twin, fast = pair_of(SIZES[0])
    sides = torch.tensor([-3.0, -0.5, 0.0, 0.25, 1.0, 1.5])
    positions = torch.cartesian_prod(sides, sides, sides)
    torch.testing.assert_close(fast(positions), twin(positions))


def test_many_points_are_taken_in_parts(by: str, monkeypatch: pytest.MonkeyPatch) -> None:
    name = "hash_sums" if by == "native" else "_rows_and_weights"
    own, taken = getattr(hash_encoding, name), []

    def counted(positions: Tensor, *rest: Any, **named: Any) -> Any:
        taken.append(len(positions))
        return own(positions, *rest, **named)

    monkeypatch.setattr(hash_encoding, name, counted)
    monkeypatch.setattr(hash_encoding, "POINTS_AT_ONCE", 16)
    twin, fast = pair_of(SIZES[0])
    positions, worth = points((4, 10)), torch.randn(4, 10, twin.get_out_dim())
    for ours, theirs in zip(gradients(fast, positions, worth), gradients(twin, positions, worth)):
        torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-3)
    assert taken == [16, 16, 8]


def test_copies_and_what_was_stored_whole_stay_fast_and_the_same() -> None:
    _, fast = pair_of(SIZES[0])
    positions = points((20,))
    for other in (copy.deepcopy(fast), pickle.loads(pickle.dumps(fast))):
        assert type(other) is CpuHashEncoding and other.hash_table is not fast.hash_table
        assert torch.equal(other(positions), fast(positions))


def test_a_slope_can_be_differentiated_again() -> None:
    positions = points((50,))
    found = []
    for encoding in pair_of(SIZES[0]):
        leaf = positions.clone().requires_grad_()
        (slope,) = torch.autograd.grad(encoding(leaf).square().sum(), leaf, create_graph=True)
        slope.square().sum().backward()
        assert encoding.hash_table.grad is not None
        found.append((leaf.grad, encoding.hash_table.grad))
    torch.testing.assert_close(found[0], found[1], rtol=1e-3, atol=1e-1)


@pytest.mark.parametrize("frozen", ["positions", "table"])
def test_what_needs_no_gradient_gets_none(frozen: str) -> None:
    twin, fast = pair_of(SIZES[0])
    positions = points((20,)).requires_grad_(frozen != "positions")
    for encoding in (twin, fast):
        encoding.hash_table.requires_grad_(frozen != "table")
        encoding(positions).sum().backward()
    assert (positions.grad is None) == (frozen == "positions")
    assert (fast.hash_table.grad is None) == (frozen == "table")


def test_other_types_are_left_to_nerfstudio() -> None:
    twin, fast = pair_of(SIZES[0])
    positions = points((10,)).double()
    with patch.object(HashEncoding, "pytorch_fwd", return_value=torch.ones(1)) as theirs:
        fast(positions)
        assert theirs.call_count == 1
        fast(positions.float())
        assert theirs.call_count == 1
    torch.testing.assert_close(fast(positions), twin(positions))


def test_an_encoding_is_replaced_wherever_it_is_held_and_itself_stays_as_it_was() -> None:
    plain = HashEncoding(implementation="torch", **SIZES[0])
    other = HashEncoding(implementation="torch", **SIZES[0])
    module = nn.ModuleDict({"first": plain, "shared": nn.Sequential(plain), "other": other})
    names = list(module.state_dict())
    speed_up_hash_encodings(module)
    assert type(plain) is HashEncoding and type(module["first"]) is CpuHashEncoding
    assert module["first"] is module["shared"][0] is not module["other"]
    assert list(module.state_dict()) == names
    with torch.no_grad():
        module["first"].hash_table.mul_(2.0)
    torch.testing.assert_close(plain(points((9,))), module["first"](points((9,))))


def test_an_encoding_of_another_kind_stays_what_it_is() -> None:
    class Other(HashEncoding):
        pass

    module = nn.ModuleList([Other(implementation="torch", **SIZES[0])])
    speed_up_hash_encodings(module)
    assert type(module[0]) is Other


NGP = InstantNGPModelConfig(log2_hashmap_size=8)
NERFACTO = NerfactoModelConfig(implementation="torch", log2_hashmap_size=8, num_levels=2)


@pytest.mark.parametrize(
    ("host", "sampler", "encodings"),
    [
        (NGP, OWN_SAMPLER, 1),
        (NGP, "dense", 1),
        (NERFACTO, OWN_SAMPLER, 3),
        (NERFACTO, "dense-proposal", 1),
    ],
)
def test_encodings_of_a_host_keep_names(host: ModelConfig, sampler: str, encodings: int) -> None:
    config = GuidedModelConfig(host=host, occupancy=OccupancyConfig(sampler=sampler))
    model = config.setup(**what_a_model_gets())
    found = [module for module in model.modules() if isinstance(module, HashEncoding)]
    assert [type(module) for module in found] == encodings * [CpuHashEncoding]
    plain = set_up_host(host, Host, **what_a_model_gets())
    if sampler == OWN_SAMPLER:
        assert plain.state_dict().keys() == model.state_dict().keys()


def test_it_is_faster() -> None:
    sizes = {"num_levels": 16, "max_res": 1024, "log2_hashmap_size": 15, "features_per_level": 2}
    pair, positions = pair_of(sizes), points((8192,))
    seconds: list[list[float]] = [[], []]
    for _ in range(5):
        for encoding, times in zip(pair, seconds):
            began = time.process_time()
            encoding(positions).sum().backward()
            times.append(time.process_time() - began)
    assert min(seconds[1]) < 0.7 * min(seconds[0])
