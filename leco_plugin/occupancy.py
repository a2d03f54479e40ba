"""`Occupancy`: a gate with its space, threshold and report, a module and one small file.

Torch and safetensors only: any project that samples rays can load `occupancy.safetensors`. Nothing
in such a file is ever executed, and a file that is not sound is refused in one line.
"""

from __future__ import annotations

import hashlib
import json
from contextvars import ContextVar
from pathlib import Path
from typing import Any, Literal, cast, get_args

import torch
from torch import Tensor, nn

from leco_plugin.models.frozen_gate import occupancy_of
from leco_plugin.models.gate import Gate, GateConfig, check_sizes
from leco_plugin.on_cpu import on_cpu
from leco_plugin.samplers.boxes import check_positions
from leco_plugin.samplers.kernels import fused
from leco_plugin.scenes.input_error import first_line
from leco_plugin.scenes.whole_files import write_whole
from leco_plugin.seen import SeenSpace, cells_from_bytes
from leco_plugin.space import NO_WALL, Space

FORMAT = "leco-occupancy"
VERSION, WITHOUT_SEEN = "2", "1"
"""Of files. One without the tensor `seen`, where all space counts as seen, is of version 1, and any
release reads it."""
SEEN, SEEN_CELLS = "seen", "seen.cells"
"""Names of that tensor in a file, and of what it holds in a module."""
LARGEST_FILE = 64 * 2**20
"""Bytes; a thousand times a usual gate. A larger file is another thing by mistake."""

BACKDROP_PRICE = "backdrop_price_db"
"""In a report: what the image loses when rays do not end in a backdrop, dB."""
NEEDS_A_BACKDROP = 1.0
"""dB from which hosts of a bounded scene are given a backdrop. What shines through surfaces that
brief learning has not made opaque is worth up to 0.6 dB, and a host that is given a backdrop for
that loses more; 2.4% of sky is worth 11 dB."""

CAMERAS_THAT_VOUCH = "cameras_that_vouch"
"""In a report: what whole photographs lose that taught it nothing, see `calibration.promise`."""

TESTS_LOSE = "tests_lose"
"""In a report: the share of its surfaces that each of some test photographs has lost so far, where
a small gate is to follow."""

CALIBRATED_AT = "calibrated_threshold"
"""In a report: the threshold that its figures are of, where a host has lowered it since."""

SHOWN: ContextVar[float | None] = ContextVar("SHOWN", default=None)
"""Threshold with which the current thread renders, for the slider of nerfstudio's viewer; None is
the run's own. A thread has its own value, so that training beside the viewer never sees it."""

Precision = Literal["float32", "bfloat16", "float16"]


class Occupancy(nn.Module):
    """Where a scene is occupied: o(x) = 1 - G_0(x), and whether o(x) reaches the threshold.

    Attributes:
        gate: the gating network, shared and not frozen by this class. That of a file is frozen.
        space: scene positions to the gate's cube.
        precision: the type of matrix products it was trained and calibrated in; queries keep to it,
            because the same weights decide otherwise in another one.
        report: what was measured when it was calibrated, JSON values only.
        walls: [6] min and max corner of the box in which the gate was taught. No ray reached what
            lies outside: it is empty. None is no walls.
        seen: the space that training rays cross. The rest is empty. None is all space.
    """

    threshold_value: Tensor
    walls: Tensor

    def __init__(
        self,
        gate: Gate,
        space: Space,
        threshold: float,
        precision: Precision = "float32",
        report: dict[str, Any] | None = None,
        walls: Tensor | None = None,
        seen: SeenSpace | None = None,
    ) -> None:
        super().__init__()
        self.gate = gate
        self.space = space
        self.precision: Precision = precision
        self.report = dict(report or {})
        # in float32 as in a file, whatever torch's default type is
        tau = torch.tensor(float(threshold), dtype=torch.float32)
        self.register_buffer("threshold_value", tau)
        self.seen = SeenSpace() if seen is None else seen
        everywhere = torch.tensor([-NO_WALL] * 3 + [NO_WALL] * 3, dtype=torch.float32)
        self.register_buffer("walls", everywhere if walls is None else walls.detach().clone())

    @property
    def threshold(self) -> float:
        """tau: positions with o(x) >= tau are kept."""
        return float(on_cpu(self.threshold_value))

    def with_threshold(self, threshold: float, report: dict[str, Any] | None = None) -> Occupancy:
        """An occupancy with another threshold that shares everything else.

        Args:
            report: of that threshold; None is this one's.
        Raises:
            ValueError: it is not in [0, 1].
        """
        if not 0.0 <= threshold <= 1.0:
            raise ValueError(f"a threshold is in [0, 1], not {threshold}")
        return self.with_gate(self.gate, threshold, self.report if report is None else report)

    def with_gate(self, gate: Gate, threshold: float, report: dict[str, Any]) -> Occupancy:
        """An occupancy of another gate in the same space, with the same walls and seen cells."""
        given = (gate, self.space, threshold, self.precision, report, self.walls, self.seen)
        return Occupancy(*given).to(self.walls.device).train(self.training)

    def shows_a_backdrop(self) -> bool:
        """Whether pictures show a sky or distance behind what the gate was taught about: always in
        an unbounded scene, in a bounded one where calibration found it."""
        price = self.report.get(BACKDROP_PRICE)
        found = isinstance(price, float) and NEEDS_A_BACKDROP < price < float("inf")
        return self.space.kind == "contraction" or found

    @torch.no_grad()
    def query(self, positions: Tensor) -> Tensor:
        """o(x) of scene positions.

        Args:
            positions: [N, 3] of any floating type, scene units, on the module's device.
        Returns:
            [N] float32 in [0, 1]; 0 outside a bounded space or the walls, in space that no training
            ray crosses, and where a position is not finite.
        Raises:
            ValueError: positions are of another shape.
        """
        check_positions(positions)
        # by coordinate: on a CPU rows of three numbers take five times as long
        columns = torch.stack(positions.to(self.space.center.dtype).unbind(-1))
        mapped = self.space.map(columns.T)
        low, high = self.walls.view(2, 3, 1)
        beyond_walls = torch.maximum(columns - high, low - columns).amax(dim=0)
        # 0 or 1 from one comparison of distances, the cheapest on a CPU; of NaN it is 0
        inside = torch.maximum(mapped.T.abs().amax(dim=0) - 1.0, beyond_walls).le_(0.0)
        mapped = mapped.clamp_(-1.0, 1.0).nan_to_num_()
        return self.of_mapped(mapped).mul_(inside).mul_(self.seen(mapped))

    @torch.no_grad()
    def unseen(self, positions: Tensor) -> Tensor:
        """Whether scene positions [N, 3] lie in the space, but where no training ray crosses it:
        bool [N]; errors as of `query`."""
        check_positions(positions)
        mapped = self.space.map(positions.to(self.space.center.dtype))
        inside = mapped.abs().amax(dim=-1) <= 1.0  # of NaN it is not
        return inside & ~self.seen(mapped.clamp(-1.0, 1.0).nan_to_num())

    def of_mapped(self, mapped: Tensor) -> Tensor:
        """The gate's answers at mapped positions [N, 3] in [-1, 1], wherever they lie: [N]."""
        if mapped.device.type == "cpu":
            return occupancy_of(self.gate, mapped, getattr(torch, self.precision))
        with gate_precision(mapped.device.type, self.precision):
            return self.gate.occupancy(mapped)

    def occupied(self, positions: Tensor) -> Tensor:
        """Whether scene positions [N, 3] are kept: bool [N]; errors as of `query`.

        On CUDA by the fused kernel where it runs, which may differ close to the threshold.
        """
        check_positions(positions)
        decided = fused.decide(self, positions)
        return self.query(positions) >= self.threshold_value if decided is None else decided

    @property
    def num_params(self) -> int:
        """Learned numbers in the gate."""
        return sum(parameter.numel() for parameter in self.gate.parameters())

    def save(self, path: str | Path) -> None:
        """Writes the file whole or not at all.

        Tensors of the gate whose values bfloat16 holds exactly are stored in it: a gate that was
        rounded to it (`leco shrink`) takes half the bytes.

        Raises:
            OSError: the folder cannot be written to, or the disk is full.
            ValueError: `load` would refuse this occupancy; no file is written.
        """
        path = Path(path)
        header = {
            "format": FORMAT,
            "version": WITHOUT_SEEN if self.seen.everywhere else VERSION,
            "gate": json.dumps(self.gate.config.to_dict()),
            "precision": self.precision,
            "report": json.dumps(self.report),
        }
        state = self.state_dict()
        del state[SEEN_CELLS]
        tensors = {name: _shorten(name, value) for name, value in state.items()}
        _check_precision(path, self.precision)
        _check_shapes(path, tensors, _expected_shapes(self.gate.config))
        _check_values(path, tensors)
        if not self.seen.everywhere:
            tensors[SEEN] = self.seen.to_bytes()
        header["sha256"] = _digest(header, tensors)
        if not path.parent.is_dir():
            raise FileNotFoundError(f"there is no folder {path.parent} to save {path.name} in")
        from safetensors.torch import save  # a gate in memory needs torch only

        # not save_file: that leaves a file which only its owner can read
        content = save(tensors, metadata=header)
        write_whole(path, content)

    @classmethod
    def load(cls, path: str | Path, device: str | torch.device = "cpu") -> Occupancy:
        """Reads and checks a file written by `save`.

        Raises:
            OSError: there is no such file, or it cannot be read.
            ValueError: the file is truncated, oversized, foreign, of another version, or holds
                tensors that are missing, misshapen or not finite. One line each.
        """
        from safetensors import SafetensorError, safe_open

        path = Path(path)
        if path.is_dir():
            raise IsADirectoryError(f"{path} is a folder; an occupancy is a file")
        if not path.exists():
            raise FileNotFoundError(f"there is no {path}: give the occupancy.safetensors of a run")
        size = path.stat().st_size
        if size > LARGEST_FILE:
            raise ValueError(f"{path} has {size} bytes; an occupancy has at most {LARGEST_FILE}")
        try:
            with safe_open(path, framework="pt", device="cpu") as file:
                header = file.metadata() or {}
                tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        except OSError as error:
            raise OSError(f"{path} cannot be read: {first_line(error)}") from None
        except (SafetensorError, *_UNREADABLE) as error:
            raise ValueError(
                f"{path} is no safetensors file, or not a whole one ({first_line(error)}): give "
                "the occupancy.safetensors of a run"
            ) from None
        return cls._checked(path, header, tensors).to(device)

    @classmethod
    def _checked(cls, path: Path, header: dict[str, str], tensors: dict[str, Tensor]) -> Occupancy:
        if header.get("format") != FORMAT:
            raise ValueError(f"{path} is a safetensors file, but not an occupancy of leco_plugin")
        version = header.get("version")
        if version not in (WITHOUT_SEEN, VERSION):
            raise ValueError(
                f"{path} has format version {version!r}; this reads {WITHOUT_SEEN} and {VERSION}"
            )
        seen = tensors.pop(SEEN, None)
        if (seen is None) != (version == WITHOUT_SEEN):
            raise ValueError(f"{path} of version {version} and the tensor {SEEN!r} do not fit")
        precision = header.get("precision")
        _check_precision(path, precision)
        try:
            config = GateConfig.from_dict(json.loads(header["gate"]))
            report = json.loads(header["report"])
            expected = _expected_shapes(config)
        except _UNREADABLE as error:
            raise ValueError(f"{path} has a damaged header: {first_line(error)}") from None
        _check_shapes(path, tensors, expected)
        _check_values(path, tensors)
        try:
            cells = None if seen is None else cells_from_bytes(seen)
        except ValueError as error:
            raise ValueError(f"{path}: tensor {SEEN!r} is damaged: {first_line(error)}") from None
        stored = tensors if seen is None else tensors | {SEEN: seen}
        if header.get("sha256") != _digest(header, stored):
            raise ValueError(f"{path} is damaged: its contents do not match its checksum")
        report = report if isinstance(report, dict) else {}
        occupancy = cls(Gate(config), Space(), 0.0, cast(Precision, precision), report).float()
        occupancy.load_state_dict(tensors)  # which without cells leaves all space seen
        if cells is not None:
            occupancy.seen.cells.copy_(cells)
        return occupancy.requires_grad_(False).eval()


def _check_precision(path: Path, precision: str | None) -> None:
    """Refuse the name of a type in which no gate is asked."""
    if precision not in get_args(Precision):
        raise ValueError(f"{path} names an unknown precision {precision!r}")


def _check_shapes(path: Path, tensors: dict[str, Tensor], expected: dict[str, _Described]) -> None:
    """Refuse other tensors than a gate of the header has."""
    found = {name: (tuple(tensor.shape), tensor.dtype) for name, tensor in tensors.items()}
    for name in sorted(expected.keys() | found.keys()):
        if not _fits(name, expected.get(name), found.get(name)):
            raise ValueError(
                f"{path}: tensor {name!r} is {found.get(name)}, "
                f"the header asks for {expected.get(name)}"
            )


def _check_values(path: Path, tensors: dict[str, Tensor]) -> None:
    """Refuse numbers that decide nothing, in one line with the path of the file."""
    for name, tensor in tensors.items():
        if tensor.is_floating_point() and not bool(tensor.isfinite().all()):
            raise ValueError(f"{path}: tensor {name} holds values that are not finite")
    threshold = float(tensors["threshold_value"])
    if not 0.0 <= threshold <= 1.0:
        raise ValueError(f"{path}: the threshold {threshold} is not in [0, 1]")
    if not float(tensors["space.half_extent"]) > 0.0:
        raise ValueError(f"{path}: the half extent of its space is not positive")
    low, high = tensors["walls"].view(2, 3)
    if bool((low > high).any()):
        raise ValueError(f"{path}: its walls end before they begin")


_UNREADABLE = (
    AttributeError,
    KeyError,
    MemoryError,
    OverflowError,
    RuntimeError,  # RecursionError among them
    TypeError,
    ValueError,
)
"""Errors of json and torch on a damaged header."""


def _digest(header: dict[str, str], tensors: dict[str, Tensor]) -> str:
    """SHA-256 of everything in a file: a gate with a flipped bit would decide wrongly."""
    digest = hashlib.sha256()
    for name in sorted(header.keys() - {"sha256"}):
        digest.update(json.dumps([name, header[name]]).encode())
    for name in sorted(tensors):
        tensor = tensors[name].contiguous()
        digest.update(json.dumps([name, list(tensor.shape), str(tensor.dtype)]).encode())
        digest.update(tensor.reshape(-1).view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()


_Described = tuple[tuple[int, ...], torch.dtype]
OF_GATE = "gate."
"""Prefix of the names of the gate's tensors."""


def _shorten(name: str, value: Tensor) -> Tensor:
    """A tensor as it is stored: one of the gate's in bfloat16 where that loses nothing."""
    value = value.detach().cpu().contiguous()
    if name.startswith(OF_GATE) and value.dtype == torch.float32:
        short = value.bfloat16()
        if torch.equal(short.float(), value):
            return short
    return value


def _fits(name: str, wanted: _Described | None, found: _Described | None) -> bool:
    """Whether a stored tensor has the shape and type that are wanted."""
    if wanted is None or found is None or not name.startswith(OF_GATE):
        return wanted == found
    return wanted[0] == found[0] and found[1] in (wanted[1], torch.bfloat16)


def _expected_shapes(config: GateConfig) -> dict[str, _Described]:
    """Names, shapes and types that a file with this gate must hold, found without allocating it."""
    check_sizes(config)
    with torch.device("meta"):
        module = Occupancy(Gate(config), Space(), 0.0).float()  # whatever torch's default is
    state = module.state_dict()
    del state[SEEN_CELLS]
    return {name: (tuple(value.shape), value.dtype) for name, value in state.items()}


def gate_precision(device_type: str, precision: Precision) -> torch.autocast:
    """The context in which a gate of this precision is asked."""
    half = torch.float16 if precision == "float16" else torch.bfloat16
    return torch.autocast(device_type, dtype=half, enabled=precision != "float32")
