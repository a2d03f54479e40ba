"""A saved occupancy decides as before; whatever else is in a file is refused in one line."""

from __future__ import annotations

import json
import os
import random
import re
from collections.abc import Iterator
from pathlib import Path
from typing import get_args

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save
from torch import Tensor

from leco_plugin import occupancy as occupancies
from leco_plugin.models.encodings import EncodingConfig
from leco_plugin.models.gate import LARGEST_SIZES, Gate, GateConfig
from leco_plugin.occupancy import LARGEST_FILE, Occupancy, Precision, gate_precision
from leco_plugin.space import Space

GATES = {
    "frequency": GateConfig(EncodingConfig(octaves=2), width=8, layers=1, scene_experts=2),
    "hash": GateConfig(EncodingConfig("hash", levels=2, log2_table=5), width=8, layers=1),
    "vm": GateConfig(EncodingConfig("vm", components=2, plane_cells=3), width=8, layers=1),
    "k-planes": GateConfig(
        EncodingConfig("k-planes", levels=2, coarsest=2, plane_cells=3), width=8, layers=1
    ),
    "grid": GateConfig(EncodingConfig("grid", plane_cells=3), width=8, layers=1),
}


def occupancy(kind: str = "frequency", **options) -> Occupancy:
    torch.manual_seed(0)
    report = {"image_price_db": 0.01, "bounds": "a box of 2 m²"}
    space = Space("contraction", (0.1, 0.2, 0.3), 1.5)
    return Occupancy(Gate(GATES[kind]), space, 0.3, report=report, **options).eval()


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    return content_of(occupancy(), tmp_path_factory.mktemp("sound"))


def content_of(occupancy: Occupancy, folder: Path) -> bytes:
    path = folder / "occupancy.safetensors"
    occupancy.save(path)
    return path.read_bytes()


def parts(content: bytes, folder: Path) -> tuple[dict[str, str], dict[str, Tensor]]:
    path = folder / "parts.safetensors"
    path.write_bytes(content)
    with safe_open(path, framework="pt") as file:
        return file.metadata(), {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118


@pytest.mark.parametrize("precision", get_args(Precision))
def test_products_have_the_type_that_the_precision_names(precision) -> None:
    with gate_precision("cpu", precision):
        assert (torch.ones(2, 2) @ torch.ones(2, 2)).dtype == getattr(torch, precision)


@pytest.mark.parametrize("kind", GATES)
@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_a_loaded_occupancy_decides_as_the_saved_one(kind, precision, tmp_path: Path) -> None:
    saved = occupancy(kind, precision=precision)
    saved.save(tmp_path / "o.safetensors")
    loaded = Occupancy.load(tmp_path / "o.safetensors")
    positions = torch.randn(2000, 3) * 3
    assert torch.equal(loaded.query(positions), saved.query(positions))
    assert torch.equal(loaded.occupied(positions), saved.occupied(positions))
    assert (loaded.threshold, loaded.report, loaded.precision, loaded.num_params) == (
        saved.threshold,
        saved.report,
        precision,
        saved.num_params,
    )
    assert not any(parameter.requires_grad for parameter in loaded.parameters())


@pytest.mark.parametrize("kind", GATES)
def test_a_gate_that_bfloat16_holds_exactly_takes_half_the_bytes(kind, tmp_path: Path) -> None:
    full, rounded = occupancy(kind), occupancy(kind)
    for parameter in rounded.gate.parameters():
        parameter.data = parameter.data.bfloat16().float()
    long, short = content_of(full, tmp_path), content_of(rounded, tmp_path)
    assert len(long) - len(short) > 1.9 * (full.num_params - 3 * 8)  # but for the norm of ones
    loaded = Occupancy.load(tmp_path / "occupancy.safetensors")
    positions = torch.randn(2000, 3) * 3
    assert torch.equal(loaded.query(positions), rounded.query(positions))
    assert all(parameter.dtype == torch.float32 for parameter in loaded.gate.parameters())
    loaded.save(tmp_path / "again.safetensors")
    assert (tmp_path / "again.safetensors").stat().st_size == len(short)


@pytest.mark.parametrize("default", [torch.float64, torch.float16])
def test_a_file_is_read_in_float32_whatever_torchs_default_is(default, tmp_path: Path) -> None:
    saved = occupancy()
    saved.save(tmp_path / "occupancy.safetensors")
    positions = torch.randn(100, 3)
    torch.set_default_dtype(default)
    try:
        loaded = Occupancy.load(tmp_path / "occupancy.safetensors").with_threshold(0.3)
        values = loaded.query(positions)
        loaded.save(tmp_path / "again.safetensors")
    finally:
        torch.set_default_dtype(torch.float32)
    floating = [value for value in loaded.state_dict().values() if value.is_floating_point()]
    assert {value.dtype for value in floating} == {torch.float32}
    assert Occupancy.load(tmp_path / "again.safetensors").threshold == loaded.threshold
    assert values.equal(saved.query(positions))


@pytest.mark.parametrize("shape", [(3,), (4, 2), (2, 4, 3), (3, 3, 3)])
def test_positions_of_another_shape_are_refused_in_a_line(shape: tuple[int, ...]) -> None:
    said = f"^positions must be \\[N, 3\\], got {re.escape(str(list(shape)))}$"
    for ask in (occupancy().query, occupancy().occupied):
        with pytest.raises(ValueError, match=said):
            ask(torch.zeros(shape))


def test_a_position_exactly_at_the_threshold_is_kept() -> None:
    made, positions = occupancy(), torch.rand(1, 3)
    at = made.with_threshold(float(made.query(positions)))
    assert bool(at.occupied(positions))


@pytest.mark.parametrize("threshold", [-0.1, 1.1, float("nan")])
def test_a_threshold_is_in_zero_to_one(threshold: float) -> None:
    with pytest.raises(ValueError, match=r"^a threshold is in \[0, 1\], not "):
        occupancy().with_threshold(threshold)


def test_outside_a_box_and_where_a_position_is_not_finite_space_is_empty() -> None:
    boxed = Occupancy(Gate(GATES["frequency"]), Space("box"), 0.0)
    nowhere = torch.tensor([[1.01, 0.0, 0.0], [float("nan"), 0.0, 0.0], [0.0, float("inf"), 0.0]])
    assert boxed.query(nowhere).tolist() == [0.0, 0.0, 0.0]
    assert boxed.query(torch.zeros(0, 3)).shape == (0,)


def test_a_file_has_the_mode_of_an_ordinary_file_and_leaves_no_other(tmp_path: Path) -> None:
    before = os.umask(0o022)
    try:
        occupancy().save(tmp_path / "o.safetensors")
    finally:
        os.umask(before)
    assert (tmp_path / "o.safetensors").stat().st_mode & 0o777 == 0o644
    assert [path.name for path in tmp_path.iterdir()] == ["o.safetensors"]


def test_a_folder_that_is_not_there_is_an_os_error(tmp_path: Path) -> None:
    with pytest.raises(OSError):
        occupancy().save(tmp_path / "nowhere" / "o.safetensors")
    with pytest.raises(OSError):
        Occupancy.load(tmp_path / "nowhere.safetensors")
    with pytest.raises(OSError, match=re.escape(f"{tmp_path} is a folder")):
        Occupancy.load(tmp_path)


def damaged(content: bytes, count: int) -> Iterator[bytes]:
    """Files cut short, with flipped bits, with bytes overwritten, inserted or appended."""
    dice = random.Random(0)
    for _ in range(count):
        data = bytearray(content)
        at = dice.randrange(len(data))
        kind = dice.choice(["cut", "flip", "flip", "flip early", "zero", "insert", "append"])
        if kind == "cut":
            del data[at:]
        elif kind == "flip":
            data[at] ^= 1 << dice.randrange(8)
        elif kind == "flip early":  # in the header
            data[dice.randrange(600)] ^= 1 << dice.randrange(8)
        elif kind == "zero":
            data[at : at + 16] = bytes(len(data[at : at + 16]))
        elif kind == "insert":
            data[at:at] = dice.randbytes(dice.randrange(1, 9))
        else:
            data += dice.randbytes(dice.randrange(1, 100))
        yield bytes(data)


def is_refused_or_the_same(path: Path, state: dict[str, Tensor]) -> bool:
    """Whether the file is refused; fails when it is neither refused in one line, with its path, nor
    the same."""
    try:
        loaded = Occupancy.load(path).state_dict()
    except (ValueError, OSError) as error:
        assert str(path) in str(error) and "\n" not in str(error)
        return True
    assert loaded.keys() == state.keys()
    assert all(torch.equal(loaded[name], value) for name, value in state.items())
    return False


@pytest.mark.parametrize("kind", GATES)
def test_damaged_files_are_refused_or_load_to_the_same_tensors(kind, tmp_path: Path) -> None:
    """A thousand of them, over all kinds of gates."""
    saved, path, refused = occupancy(kind), tmp_path / "o.safetensors", 0
    for content in damaged(content_of(saved, tmp_path), 250):
        path.write_bytes(content)
        refused += is_refused_or_the_same(path, saved.state_dict())
    assert refused > 235


FOREIGN = {
    "empty": b"",
    "zeros": bytes(1000),
    "text": b"not a safetensors file\n" * 10,
    "pickle": b"\x80\x04\x95" + bytes(100),
    "huge header": (2**60).to_bytes(8, "little") + b"{}",
    "tensors of another project": save({"weight": torch.zeros(3)}),
    "no tensors": save({}, metadata={"format": "leco-occupancy", "version": "1"}),
}


@pytest.mark.parametrize("name", FOREIGN)
def test_foreign_files_are_refused_in_one_line(name: str, tmp_path: Path) -> None:
    path = tmp_path / "o.safetensors"
    path.write_bytes(FOREIGN[name])
    assert is_refused_or_the_same(path, {})


def test_an_oversized_file_is_refused_unread(sound: bytes, tmp_path: Path) -> None:
    path = tmp_path / "o.safetensors"
    path.write_bytes(sound)
    os.truncate(path, LARGEST_FILE + 1)
    with pytest.raises(ValueError, match="bytes"):
        Occupancy.load(path)


HEADERS = {
    "format": ["other", ""],
    "version": ["0", "2", "1\n2", ""],
    "precision": ["float16", "a\nb"],
    "report": ["", "{", "[" * 5000],
    "gate": [
        "",
        "[]",
        "null",
        '"a"',
        "{}",
        '{"encoding": 3}',
        '{"encoding": {"kind": "frequency"}, "a\\nb": 1}',
        *(
            json.dumps({"encoding": {"kind": kind, name: size}})
            for kind in GATES
            for name in LARGEST_SIZES.keys() - {"width", "layers", "scene_experts"}
            for size in (0, -1, 10**6, 10**400, 1.5, "a\nb", None, True)
        ),
        *(
            json.dumps({"encoding": {}, name: size})
            for name in ("width", "layers", "scene_experts")
            for size in (0, -1, 63, 10**6, 10**400, 1.5, "3", None, [1])
        ),
        '{"encoding": {"kind": ["hash"]}}',
    ],
    "sha256": ["", "0" * 64],
}


@pytest.mark.parametrize("key", HEADERS)
def test_a_header_of_nonsense_is_refused_in_one_line(key: str, sound, tmp_path: Path) -> None:
    header, tensors = parts(sound, tmp_path)
    path = tmp_path / "o.safetensors"
    for value in HEADERS[key]:
        path.write_bytes(save(tensors, metadata=header | {key: value}))
        assert is_refused_or_the_same(path, tensors), value
    path.write_bytes(save(tensors, metadata={k: v for k, v in header.items() if k != key}))
    assert is_refused_or_the_same(path, tensors)


@pytest.mark.parametrize("key", ["report", "precision"])
def test_a_sound_header_that_is_not_the_saved_one_is_refused(key, sound, tmp_path: Path) -> None:
    """What was declared is under the checksum as the weights are."""
    header, tensors = parts(sound, tmp_path)
    other = {"report": json.dumps({"image_price_db": 0.0}), "precision": "bfloat16"}[key]
    assert header[key] != other
    path = tmp_path / "o.safetensors"
    path.write_bytes(save(tensors, metadata=header | {key: other}))
    with pytest.raises(ValueError, match="do not match its checksum"):
        Occupancy.load(path)


@pytest.mark.parametrize("kind", GATES)
def test_a_header_that_claims_another_gate_is_refused(kind: str, tmp_path: Path) -> None:
    saved = occupancy(kind)
    header, tensors = parts(content_of(saved, tmp_path), tmp_path)
    gate, path = saved.gate.config.to_dict(), tmp_path / "o.safetensors"
    used = {
        "frequency": {"octaves"},
        "hash": {"levels", "features", "log2_table"},
        "vm": {"components", "plane_cells"},
        "k-planes": {"levels", "features", "coarsest", "plane_cells"},
        "grid": {"features", "plane_cells"},
    }[kind]
    claims = [{"kind": other} for other in GATES if other != kind]
    claims += [{name: size} for name in used for size in (1, 7, LARGEST_SIZES[name])]
    claims += [{name: LARGEST_SIZES[name] for name in used}]
    for claim in claims:
        claimed = gate | {"encoding": gate["encoding"] | claim}
        path.write_bytes(save(tensors, metadata=header | {"gate": json.dumps(claimed)}))
        assert is_refused_or_the_same(path, saved.state_dict()), claim


def test_tensors_that_do_not_fit_the_header_are_refused(sound: bytes, tmp_path: Path) -> None:
    header, tensors = parts(sound, tmp_path)
    path = tmp_path / "o.safetensors"
    for name, value in tensors.items():
        others = [value[None], value.double() if value.is_floating_point() else value.int()]
        if value.is_floating_point():
            others += [torch.full_like(value, bad) for bad in (float("nan"), float("inf"))]
            others += [value.half(), value + 1.0]
        for other in others:
            path.write_bytes(save(tensors | {name: other.contiguous()}, metadata=header))
            assert is_refused_or_the_same(path, tensors), name
        rest = {key: tensor for key, tensor in tensors.items() if key != name}
        path.write_bytes(save(rest, metadata=header))
        assert is_refused_or_the_same(path, tensors), name
    path.write_bytes(save(tensors | {"one\nmore": torch.zeros(1)}, metadata=header))
    assert is_refused_or_the_same(path, tensors)


UNSOUND = {
    "a threshold below 0": ("threshold_value", -0.1, "threshold"),
    "a threshold above 1": ("threshold_value", 1.1, "threshold"),
    "a gate with a NaN": (
        "gate.head.bias",
        torch.tensor([0.0, float("nan"), 0.0]),
        "gate.head.bias holds values",
    ),
    "a space without extent": ("space.half_extent", 0.0, "half extent"),
    "inverted walls": ("walls", torch.tensor([0.0, 0.0, 0.5, 1.0, 1.0, -0.5]), "walls"),
}


@pytest.mark.parametrize("name", UNSOUND)
def test_values_that_decide_nothing_are_neither_saved_nor_loaded(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tensor, value, message = UNSOUND[name]
    wrong, path = occupancy(), tmp_path / "o.safetensors"
    wrong.state_dict()[tensor].copy_(torch.as_tensor(value))
    with pytest.raises(ValueError, match=f"{re.escape(str(path))}: .*{message}"):
        wrong.save(path)
    assert list(tmp_path.iterdir()) == []
    with monkeypatch.context() as trusting:
        trusting.setattr(occupancies, "_check_values", lambda *_: None)
        wrong.save(path)
    with pytest.raises(ValueError, match=f"{re.escape(str(path))}: .*{message}"):
        Occupancy.load(path)


UNREADABLE = {
    "a gate in float64": (lambda: occupancy().double(), "tensor 'gate.*float64"),
    "walls in float64": (
        lambda: occupancy(walls=torch.ones(6, dtype=torch.float64)),
        "tensor 'walls'.*float64",
    ),
    "a precision that no gate is asked in": (
        lambda: occupancy(precision="float64"),
        "unknown precision 'float64'",
    ),
    "a gate of more experts than files have": (
        lambda: Occupancy(Gate(GateConfig(scene_experts=65)), Space(), 0.5),
        "scene_experts is 65",
    ),
}


@pytest.mark.parametrize("name", UNREADABLE)
def test_what_could_not_be_loaded_again_is_not_saved(name: str, tmp_path: Path) -> None:
    make, message = UNREADABLE[name]
    with pytest.raises(ValueError, match=message):
        make().save(tmp_path / "o.safetensors")
    assert list(tmp_path.iterdir()) == []


def test_what_lies_outside_the_walls_is_empty_also_after_a_round_trip(tmp_path: Path) -> None:
    torch.manual_seed(0)
    walls = torch.tensor([-1e6, -1e6, -0.2, 1e6, 1e6, 0.3])
    occupancy = Occupancy(Gate(GateConfig()), Space(), 1e-6, walls=walls)
    occupancy.save(tmp_path / "occupancy.safetensors")
    positions = torch.rand(2000, 3) * 2 - 1
    loaded = Occupancy.load(tmp_path / "occupancy.safetensors")
    between = (positions[:, 2] >= -0.2) & (positions[:, 2] <= 0.3)
    for same_place in (
        loaded,
        loaded.with_threshold(2e-6),
        loaded.with_gate(Gate(GateConfig()), 1e-6, {}),
    ):
        assert torch.equal(same_place.occupied(positions), between)


def test_walls_stay_where_they_were_given() -> None:
    walls = torch.tensor([-1.0, -1.0, -0.2, 1.0, 1.0, 0.3])
    made, given = occupancy(walls=walls), walls.clone()
    walls.zero_()
    assert torch.equal(made.walls, given)


def test_a_wall_is_where_it_is_said_to_be_though_there_is_none_on_the_other_side() -> None:
    walls = torch.tensor([-1e6, -1e6, 0.1234567, 1e6, 0.3, 1e6])
    occupancy = Occupancy(Gate(GateConfig()), Space(), 1e-6, walls=walls)
    one = torch.zeros(5, 3) + torch.tensor([0.0, 0.0, 0.5])
    one[0, 2] = walls[2]
    one[1, 2] = torch.nextafter(walls[2], torch.tensor(-1.0))
    one[2, 1] = walls[4]
    one[3, 1] = torch.nextafter(walls[4], torch.tensor(1.0))
    assert occupancy.occupied(one).tolist() == [True, False, True, False, True]
