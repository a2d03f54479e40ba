"""A pickle is gone through without running, believing or waiting for anything in it."""

from __future__ import annotations

import contextlib
import io
import pickletools
import time
import zipfile

import pytest
import torch

from leco_plugin.scenes.mega_nerf_format.pt_pickle import Look, Refused


def records_of(value: object) -> dict[str, bytes]:
    file = io.BytesIO()
    torch.save(value, file)
    with zipfile.ZipFile(file) as archive:
        return {n.removeprefix("archive/"): archive.read(n) for n in archive.namelist()}


def look(pickled: bytes, **records: bytes) -> None:
    Look({"data.pkl": pickled} | records).through()


SLOW_KEY = b"}K\x01\x85q\x00" + b"h\x00h\x00\x86q\x00" * 60
"""A dictionary and pairs of pairs of pairs: a key whose hash takes 2^60 steps."""
MAPPING = b"ccollections\nOrderedDict\n"


def test_what_torch_saves_passes() -> None:
    whole = torch.arange(20.0)
    value = {"a": [whole, whole[3:9:2].view(3, 1), ()], "b": (1, 2.0, None, True, "word", 1 << 99)}
    Look(records_of(value)).through()
    Look(records_of(torch.zeros(0, 3))).through()
    Look(records_of(torch.ones(1, dtype=torch.bool).expand(40, 60))).through()
    Look(records_of(torch.nn.Linear(2, 2).state_dict() | {"H": 1})).through()


@pytest.mark.parametrize(
    ("pickled", "reason"),
    [
        (b"\x80\x02" + SLOW_KEY + b"Ns.", "keys that are no words"),
        (b"\x80\x02}(K\x01NK\x02Nu.", "keys that are no words"),
        (b"\x80\x04\x95\x01\0\0\0\0\0\0\0.", "instruction FRAME"),
        (b"\x80\x02" + b"N" * 70_000 + b".", "far too many"),
        (b"\x80\x02" + MAPPING + b")Rb.", "instruction BUILD"),
        (b"\x80\x02" + MAPPING + b")\x81.", "instruction NEWOBJ"),
        (b"\x80\x02" + MAPPING + b"]\x85R.", "does not write"),
        (b"\x80\x02ctorch\nFloatStorage\n)R.", "calls what cannot be called"),
        (b"\x80\x02]K\x01R.", "calls what cannot be called"),
        (b"\x80\x02cos\nsystem\n.", "holds os.system, and only tensors and numbers"),
        (b"\x80\x02ctorch.jit\n_load\n.", "holds torch.jit._load"),
        (b"\x80\x02}(]Nu.", "keys that are no words"),
        (b"\x80\x02}Na.", "a list that is none"),
        (b"(S'a'\ntQ.", "instruction STRING"),
    ],
)
def test_strange_pickles_are_refused_with_the_reason(pickled: bytes, reason: str) -> None:
    with pytest.raises(Refused, match=reason):
        look(pickled)


@pytest.mark.parametrize(
    "pickled",
    [b"", b"\x80\x02h\x07.", b"\x80\x02t.", b"\x80\x02X\xff\xff\xff\x7fa.", b"\x80\x02Q."],
)
def test_damaged_pickles_raise(pickled: bytes) -> None:
    with pytest.raises((ValueError, KeyError, IndexError)):
        look(pickled)


@pytest.mark.parametrize(
    "pickled",
    [
        b"\x80\x02" + b"N" * 30_000 + b"(t" * 15_000 + b".",
        b"\x80\x02" + b"(" * 30_000 + b"t" * 30_000 + b".",
        b"\x80\x02" + SLOW_KEY + b"\x86.",
        b"\x80\x02r\xff\xff\xff\x7fN.",
        b"\x80\x02]" + b"q\x00h\x00\x85" * 12_000 + b".",
    ],
)
def test_nothing_takes_long(pickled: bytes) -> None:
    began = time.thread_time()
    with contextlib.suppress(Refused, ValueError, KeyError, IndexError):
        look(pickled)
    assert time.thread_time() - began < 2


def change(value: object, *replacements: tuple[bytes, bytes]) -> None:
    """Looks at a saved value with something replaced in its pickle."""
    records = records_of(value)
    for old, new in replacements:
        assert records["data.pkl"].count(old) == 1, pickletools.dis(records["data.pkl"])
        records["data.pkl"] = records["data.pkl"].replace(old, new)
    Look(records).through()


TWELVE = torch.zeros(12)
HUGE = b"\x8a\x06\0\0\0\0\0\x01"  # 2^40


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        (b"K\x0ctq", b"J\0\0\0\x70tq", "claims 1879048192 values where it has 48 bytes"),
        (b"K\x0ctq", b"J\xff\xff\xff\xfftq", "claims -1 values"),
        (b"K\x0ctq", b"K\x0dtq", "claims 13 values"),
        (b"FloatStorage", b"DoubleStorage", "claims 12 values where it has 48 bytes"),
        (b"X\x01\0\0\x000q", b"X\x01\0\0\x007q", "claims 12 values where it has 0 bytes"),
        (b"K\x00K\x0c\x85", b"K\x05K\x0c\x85", "does not lie in its storage"),
        (b"K\x01\x85q", b"K\x02\x85q", "does not lie in its storage"),
        (b"K\x0c\x85q", b"J\xff\xff\xff\xff\x85q", "no shape"),
        (b"K\x0c\x85q", b"K\x0cK\x01\x86q", "no shape"),
        (b"K\x0c\x85q", b"]q", "no shape"),
        (b"\x89" + MAPPING, b"N" + MAPPING, "a tensor with hooks"),
        (b")R", b")RX\x01\0\0\0aNs", "a tensor with hooks"),
    ],
)
def test_a_tensor_is_believed_only_as_far_as_its_bytes(old: bytes, new: bytes, reason: str) -> None:
    with pytest.raises(Refused, match=reason):
        change(TWELVE, (old, new))


def test_a_value_repeated_without_end_is_refused() -> None:
    with pytest.raises(Refused, match="a size that nothing here has"):
        change(TWELVE, (b"K\x0c\x85", HUGE + b"\x85"), (b"K\x01\x85", b"K\x00\x85"))
