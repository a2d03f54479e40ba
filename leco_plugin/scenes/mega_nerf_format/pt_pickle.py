"""Goes through the pickle of a .pt file as torch would, with markers in place of tensors.

Only the instructions are known with which torch.save describes tensors, numbers, strings and
containers of them. Nothing is imported or called, and nothing is hashed but strings: a pickle of a
few hundred bytes can hold a key whose hash takes years.
"""

from __future__ import annotations

import math
import pickletools
from collections.abc import Callable
from typing import Any

LONGEST = 1 << 16
"""Bytes; the pickle of a picture's metadata has about 500."""
_VALUES = frozenset(
    ("NONE", "NEWTRUE", "NEWFALSE", "BININT", "BININT1", "BININT2", "LONG1", "BINFLOAT")
)
_CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False}
_TUPLES = {"EMPTY_TUPLE": 0, "TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}
_SIZES = {8: ("Double", "Long"), 4: ("Float", "Int"), 2: ("Half", "BFloat16", "Short")}
_SIZES |= {1: ("Char", "Byte", "Bool")}
_ITEM_SIZES = {f"torch {k}Storage": size for size, kinds in _SIZES.items() for k in kinds}
_MAPPING, _TENSOR = "collections OrderedDict", "torch._utils _rebuild_tensor_v2"
_A_TENSOR = object()
_MOST_VALUES = 1 << 32
"""Of a tensor; one that repeats a value may have more than its storage."""


class Refused(Exception):
    """What is wrong with a file, without its name."""


class _Name(str):
    """A class or a function that a pickle names."""


class _Storage(int):
    """How many values a storage has."""


class Look:
    """One look through the records of an archive."""

    def __init__(self, records: dict[str, bytes]) -> None:
        self.records = records
        self.stack: list[Any] = []
        self.marks: list[int] = []
        self.memo: dict[int, Any] = {}

    def through(self) -> None:
        """Goes through all instructions.

        Raises:
            Refused: something is not what torch.save writes, or claims more than there is.
            Exception: the pickle is damaged.
        """
        pickled = self.records["data.pkl"]
        if len(pickled) > LONGEST:
            raise Refused(f"describes its contents in {len(pickled)} bytes, far too many")
        for opcode, argument, _ in pickletools.genops(pickled):
            self._do(opcode.name, argument)

    def _do(self, name: str, argument: Any) -> None:
        """One instruction."""
        stack = self.stack
        if name in _VALUES or name == "BINUNICODE":
            stack.append(_CONSTANTS.get(name, argument))
        elif name in _TUPLES:
            count = _TUPLES[name]
            stack.append(tuple(stack.pop() for _ in range(count))[::-1])
        elif name in ("BINPUT", "LONG_BINPUT"):
            self.memo[argument] = stack[-1]
        elif name in ("BINGET", "LONG_BINGET"):
            stack.append(self.memo[argument])
        elif name in _MORE:
            _MORE[name](self, argument)
        else:
            raise Refused(_foreign(f"a pickle with the instruction {name}"))

    def _to_mark(self) -> list[Any]:
        """Takes what was put on the stack since the last mark."""
        place = self.marks.pop()
        taken = self.stack[place:]
        del self.stack[place:]
        return taken

    def _set(self, pairs: list[Any]) -> None:
        """Puts keys and values, alternating, into the dictionary on the stack."""
        into = self.stack[-1]
        if type(into) is not dict or len(pairs) % 2 or any(type(k) is not str for k in pairs[::2]):
            raise Refused("holds a dictionary with keys that are no words")
        into.update(zip(pairs[::2], pairs[1::2]))

    def _append(self, values: list[Any]) -> None:
        into = self.stack[-1]
        if type(into) is not list:
            raise Refused("is damaged: it has a list that is none")
        into += values

    def _name(self, name: str) -> None:
        if name not in _ITEM_SIZES and name not in (_MAPPING, _TENSOR):
            raise Refused(_foreign(name.replace(" ", ".")))
        self.stack.append(_Name(name))

    def _storage(self) -> None:
        """Compares the claim of a storage with its record."""
        kind, name, key, _, items = self.stack.pop()
        known = type(name) is _Name and name in _ITEM_SIZES
        if kind != "storage" or not known or type(key) is not str or type(items) is not int:
            raise Refused("is damaged: it has a storage of no kind")
        there = len(self.records.get(f"data/{key}", b""))
        if not 0 <= items * _ITEM_SIZES[name] <= there:
            raise Refused(f"claims {items} values where it has {there} bytes")
        self.stack.append(_Storage(items))

    def _call(self) -> None:
        """Makes a tensor or an empty dictionary; nothing else is called."""
        arguments, name = self.stack.pop(), self.stack.pop()
        if type(name) is not _Name or name in _ITEM_SIZES or type(arguments) is not tuple:
            raise Refused("is damaged: it calls what cannot be called")
        if name == _MAPPING:
            if arguments:
                raise Refused("holds a dictionary in a form that torch does not write")
            self.stack.append({})
        else:
            _check_tensor(*arguments)
            self.stack.append(_A_TENSOR)


def _check_tensor(
    storage: Any, offset: Any, size: Any, stride: Any, requires_grad: Any, hooks: Any
) -> None:
    """A tensor lies in its storage, and brings nothing that would be called."""
    fits = type(storage) is _Storage and type(size) is tuple and type(stride) is tuple
    steps = [*size, *stride, offset] if fits else [-1]
    if any(type(step) is not int or step < 0 for step in steps) or len(size) != len(stride):
        raise Refused("is damaged: it has a tensor of no shape")
    if len(size) > 8 or math.prod(size) > _MOST_VALUES:
        raise Refused("holds a tensor of a size that nothing here has")
    last = offset + sum((n - 1) * step for n, step in zip(size, stride))
    if all(size) and last >= storage:
        raise Refused("is damaged: it has a tensor that does not lie in its storage")
    if type(requires_grad) is not bool or type(hooks) is not dict or hooks:
        raise Refused(_foreign("a tensor with hooks"))


def _foreign(what: str) -> str:
    return f"holds {what}, and only tensors and numbers are read"


_MORE: dict[str, Callable[[Look, Any], None]] = {
    "PROTO": lambda look, _: None,
    "STOP": lambda look, _: None,
    "MARK": lambda look, _: look.marks.append(len(look.stack)),
    "EMPTY_DICT": lambda look, _: look.stack.append({}),
    "EMPTY_LIST": lambda look, _: look.stack.append([]),
    "TUPLE": lambda look, _: look.stack.append(tuple(look._to_mark())),
    "SETITEM": lambda look, _: look._set([look.stack.pop(-2), look.stack.pop()]),
    "SETITEMS": lambda look, _: look._set(look._to_mark()),
    "APPEND": lambda look, _: look._append([look.stack.pop()]),
    "APPENDS": lambda look, _: look._append(look._to_mark()),
    "GLOBAL": lambda look, name: look._name(name),
    "BINPERSID": lambda look, _: look._storage(),
    "REDUCE": lambda look, _: look._call(),
}
