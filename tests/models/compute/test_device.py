"""What a device has of memory, and that work in threads is done or its error raised."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from leco_plugin.models.compute.device import free_memory, memory_of
from leco_plugin.models.compute.native import in_threads


def test_free_memory_is_the_smaller_of_machine_and_container(tmp_path: Path) -> None:
    machine = tmp_path / "meminfo"
    machine.write_text("MemTotal: 900 kB\nMemAvailable: 500 kB\n")
    assert free_memory(machine, tmp_path) == 500 * 1024
    (tmp_path / "memory.max").write_text("100000\n")
    (tmp_path / "memory.current").write_text("40000\n")
    assert free_memory(machine, tmp_path) == 60000
    (tmp_path / "memory.stat").write_text("anon 9\nactive_file 5000\ninactive_file 20000\n")
    assert free_memory(machine, tmp_path) == 85000  # of the cache, the system makes room
    (tmp_path / "memory.max").write_text("max\n")
    assert free_memory(machine, tmp_path) == 500 * 1024
    assert free_memory(tmp_path / "none", tmp_path / "none") is None


def test_a_container_limits_what_a_machine_has(tmp_path: Path) -> None:
    whole = memory_of("cpu", tmp_path)
    assert whole is not None and whole > 1 << 28
    (tmp_path / "memory.max").write_text("1000000\n")
    assert memory_of("cpu", tmp_path) == 1000000
    assert memory_of("meta") is None


@pytest.mark.parametrize("fails", [0, 4])
def test_work_that_fails_in_any_thread_is_an_error(
    fails: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    done: list[int] = []

    def work(first: int, end: int) -> None:
        if first <= fails < end:
            raise MemoryError("of one part")
        done.extend(range(first, end))

    with pytest.raises(MemoryError, match="of one part"):
        in_threads(work, 8, 2)
    done.clear()
    in_threads(lambda first, end: done.extend(range(first, end)), 5, 3, at_once=2)
    assert sorted(done) == [*range(5)]
