"""A card that any machine has: its tensors say `card:0`, hold their numbers on the CPU, and refuse,
as those of a GPU do, to meet tensors or random numbers of another device.

It has none of CUDA's operations: what is chosen for `cuda` alone is not tried. Who would wait for a
GPU is noted in `waits`.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from unittest.mock import patch

import torch
import torch.distributed.tensor  # its annotations want the real `torch.Generator`
from torch import Tensor
from torch.utils import backend_registration
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

NAME = "card"
CARD = f"{NAME}:0"
aten = torch.ops.aten
COPIES = {aten._to_copy.default, aten.copy_.default}
"""What may have tensors of two devices."""
INDEXING = {aten.index.Tensor, aten.index_put_.default, aten._index_put_impl_.default}
"""What takes indices of the CPU, whatever it indexes."""
READING = {
    *(aten._local_scalar_dense.default, aten.equal.default, aten.nonzero.default),
    *(aten.masked_select.default, aten.bincount.default, aten.repeat_interleave.Tensor),
    *(aten._unique2.default, aten.unique_dim.default, aten.unique_consecutive.default),
}
"""What asks a GPU for a number, or for the size of what it gives."""
waits: list[str] = []
"""Where the CPU waited to read from the card: module and function of this package or of nerfstudio,
whichever is nearer. What is copied to the card is not counted, though from pageable memory a GPU
waits for that too."""


class OnCard(Tensor):
    """A tensor on the card."""

    held: Tensor
    __torch_function__ = torch._C._disabled_torch_function_impl

    @staticmethod
    def __new__(cls: type[OnCard], held: Tensor) -> OnCard:
        """Of numbers that are on the CPU."""
        made: OnCard = torch.Tensor._make_wrapper_subclass(
            cls,
            held.shape,
            strides=held.stride(),
            storage_offset=held.storage_offset(),
            dtype=held.dtype,
            device=torch.device(CARD),
        )
        made.held = held
        return made

    def __init__(self, held: Tensor) -> None:
        """What there is to do `__new__` has done."""

    @classmethod
    def __torch_dispatch__(
        cls, function: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        return _answer(function, args, kwargs or {})

    def new_tensor(self, data: Any, dtype: Any = None, device: Any = None) -> Tensor:
        return _tensor(data, dtype=dtype or self.dtype, device=device or CARD)

    def __reduce_ex__(self, protocol: Any) -> Any:
        return self.held.__reduce_ex__(protocol)  # as what is loaded to the CPU

    def tolist(self) -> Any:
        _note_wait()
        return self.held.tolist()

    def numpy(self, *, force: bool = False) -> Any:
        raise TypeError("can't convert a tensor on a card to numpy: copy it to the CPU first")

    __array__ = numpy


def _is_card(device: Any) -> bool:
    return device is not None and torch.device(device).type == NAME


def _answer(function: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    """What an operation gives, computed on the CPU; RuntimeError where devices are mixed."""
    tensors = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, Tensor)]
    on_card = [tensor for tensor in tensors if isinstance(tensor, OnCard)]
    elsewhere = [one for one in tensors if not isinstance(one, OnCard) and one.dim() > 0]
    asked = kwargs.get("device")
    gives = _is_card(asked) if asked is not None else bool(on_card)
    if function is aten.copy_.default or function in INDEXING:
        gives = isinstance(args[0], OnCard)
    mixed = bool(on_card and elsewhere)
    if function in INDEXING:
        mixed = bool(on_card) and not gives
    if mixed and function not in COPIES:
        shapes = [[tuple(one.shape) for one in some] for some in (on_card, elsewhere)]
        raise RuntimeError(f"{function}: {shapes[0]} are on the card and {shapes[1]} are not")
    if on_card and _reads(function, args, kwargs):
        _note_wait()
    generators = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, _Generator)]
    if any((one._cdata in _of_card) != gives for one in generators):
        raise RuntimeError(f"{function}: a generator of another device than the tensor's")

    def bare(value: Any) -> Any:
        if isinstance(value, OnCard):
            return value.held
        return torch.device("cpu") if isinstance(value, torch.device) and _is_card(value) else value

    given, options = tree_map(bare, (args, kwargs))
    out = function(*given, **options)
    as_before = {id(one): two for one, two in zip(tree_leaves(given), tree_leaves(args))}

    def placed(value: Any) -> Any:
        if not isinstance(value, Tensor):
            return value
        known = as_before.get(id(value))
        if known is not None and isinstance(known, OnCard) == gives:
            return known
        return OnCard(value) if gives else value

    return tree_map(placed, out)


def _reads(function: Any, args: Any, kwargs: dict[str, Any]) -> bool:
    """Whether an operation on tensors of the card makes the CPU wait for it."""
    if function in READING:
        return kwargs.get("output_size") is None
    if function in INDEXING:
        masks = [one for one in args[1] if one is not None and one.dtype == torch.bool]
        one_value = function is not aten.index.Tensor and args[2].numel() == 1
        return bool(masks) and not one_value
    if function is aten.copy_.default:
        return not isinstance(args[0], OnCard)
    asked = kwargs.get("device")
    return function in COPIES and asked is not None and not _is_card(asked)


def _note_wait() -> None:
    frame: Any = sys._getframe()
    while frame is not None:
        module = frame.f_globals.get("__name__", "")
        if module.split(".")[0] in ("leco_plugin", "nerfstudio"):
            waits.append(f"{module}.{frame.f_code.co_name}")
            return
        frame = frame.f_back


class _Mode(TorchDispatchMode):
    """Sees what makes tensors of none, too."""

    def __torch_dispatch__(
        self, function: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        return _answer(function, args, kwargs or {})


class _Module(backend_registration._DummyBackendModule):
    """What torch asks of a backend."""

    def get_amp_supported_dtype(self) -> list[torch.dtype]:
        return [torch.bfloat16, torch.float16, torch.float32]

    def device_count(self) -> int:
        return 1

    def current_device(self) -> int:
        return 0


_Generator, _of_card = torch.Generator, dict[int, torch.Generator]()
_make_tensor, _make_as_tensor = torch.tensor, torch.as_tensor


def _generator(device: Any = "cpu") -> torch.Generator:
    made = _Generator()
    if _is_card(device):
        _of_card[made._cdata] = made
    return made


def _tensor(data: Any, *, dtype: Any = None, device: Any = None, **rest: Any) -> Tensor:
    made = _make_tensor(data, dtype=dtype, **rest)
    return made if device is None else made.to(device)


def _as_tensor(data: Any, dtype: Any = None, device: Any = None) -> Tensor:
    made = _make_as_tensor(data, dtype=dtype)
    return made if device is None else made.to(device)


@contextmanager
def pretended_card() -> Iterator[torch.device]:
    """A card, for a while. What it needs of torch stays for the rest of the process."""
    if torch._C._get_privateuse1_backend_name() == "privateuseone":
        backend_registration._setup_privateuseone_for_python_backend(NAME, _Module())
    with (
        patch.object(torch, "Generator", _generator),
        patch.object(torch, "tensor", _tensor),
        patch.object(torch, "as_tensor", _as_tensor),
        _Mode(),
    ):
        yield torch.device(CARD)
