"""Claims about `benchmarks/profile_steps.py`: to which part time belongs, and what it must cost."""

from __future__ import annotations

import time
from types import SimpleNamespace
from typing import Any

import profile_steps
import pytest
import torch
from gpu_floor import Ceilings
from profile_floors import linear_weights, milliseconds, of_encoding
from profile_page import profile_sections
from profile_parts import REST, Parts, Times, Work, profiler, split
from torch import Tensor, nn

from leco_plugin.models.encodings import HashEncoding

SLOW = 0.05


class _SlowBackward(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        return 2.0 * x

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:  # type: ignore[override]
        time.sleep(SLOW)
        return 2.0 * gradient


class _Slow(nn.Module):
    def forward(self, x: Tensor) -> Tensor:
        return _SlowBackward.apply(x)


class _Net(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.first, self.second, self.third = nn.Linear(4, 4), _Slow(), nn.Linear(4, 4)

    def step(self) -> None:
        hidden = self.first(torch.ones(8, 4))
        hidden.detach().sum()  # makes no node, and has the number of the one that follows
        self.third(self.second(hidden)).sum().backward()


def profiled(net: _Net) -> tuple[Times, Parts]:
    parts = Parts()
    parts.name(net, "step", REST)
    parts.name(net.second, "forward", "slow")
    for layer in (net.first, net.third):
        parts.name(layer, "forward", "quick", lambda result, x: Work(x.numel(), samples=len(x)))
    net.step()
    parts.work.clear()
    with profiler() as finished:
        net.step()
    parts.close()
    return split(finished.events(), of_device=False), parts


def test_a_slow_backward_belongs_to_the_part_whose_forward_made_it() -> None:
    # a busy machine may stop any of them for a while, not all
    tries = [profiled(_Net()) for _ in range(5)]
    times, parts = min(tries, key=lambda found: found[0].total)
    assert times.backward["slow"] > SLOW
    others = times.total - times.backward["slow"]
    assert others < SLOW / 2 and times.backward["quick"] > 0.0 < times.forward[REST]
    assert parts.work == {"quick": Work(bytes=64, samples=16)}


def test_names_are_taken_away() -> None:
    net = _Net()
    before = vars(net.second).keys()
    profiled(net)
    assert vars(net.second).keys() == before and "step" not in vars(net)


def test_a_floor_is_the_larger_of_bytes_and_operations() -> None:
    assert milliseconds(10.0, 10.0, Ceilings(5.0, 100.0), calls=2) == pytest.approx(1000.0)
    assert milliseconds(10.0, 10.0, Ceilings(100.0, 5.0), calls=1) == pytest.approx(2000.0)
    assert linear_weights(nn.Sequential(nn.Linear(3, 5), nn.ReLU(), nn.Linear(5, 2))) == 25


def test_a_hash_grid_reads_four_rows_a_level() -> None:
    grid = HashEncoding(levels=2, features=3, log2_table=4, coarsest=4, finest=8)
    places = torch.rand(5, 3)
    work = of_encoding(grid)(grid(places), places)
    looked_up = 5 * 2 * 4 * 3
    assert work.bytes == 4 * (5 * 3 + looked_up + 5 * 6) and work.operations == 2 * looked_up
    zeros = 2 * 16 * 3
    assert work.backward_bytes == 4 * (5 * 3 + 5 * 6 + 2 * looked_up + zeros)
    with torch.no_grad():
        assert of_encoding(grid)(grid(places), places).backward_bytes == 0


def test_steps_without_the_profiler_are_those_just_before_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """By the clock of this test; the profiler makes a step ten times as long."""
    now, parts = [0.0], Parts()
    taken = iter((9.0, 1.0, 3.0, 20.0, 20.0, 5.0, 7.0, 60.0, 60.0))
    monkeypatch.setattr(profile_steps, "time", SimpleNamespace(perf_counter=lambda: now[0]))

    class Trainer:
        stop_training = False

        def __init__(self) -> None:
            self.guide = SimpleNamespace(occupancy=None)
            self.pipeline = SimpleNamespace(model=SimpleNamespace(leco_guide=self.guide))

        def train_iteration(self, step: int) -> int:
            now[0] += next(taken)
            return step

    trainer = Trainer()
    parts.name(trainer, "train_iteration", REST, lambda step, _: Work(rays=10 * step))
    begins = {"learning": 3, "guided": 2}
    course = profile_steps.Course(trainer, parts, begins, 2, Ceilings(1.0, 1.0))
    for step in range(9):
        assert not trainer.stop_training
        if step == 5:
            trainer.guide.occupancy = "learned"
        assert trainer.train_iteration(step) == step
    assert trainer.stop_training
    found = {phase: (its["unprofiled_ms"], its["rays"]) for phase, its in course.found.items()}
    assert found == {"learning": (2000.0, 35.0), "guided": (6000.0, 75.0)}


def test_the_page_says_what_takes_most() -> None:
    part = dict(forward=3.0, backward=6.0, forward_floor=0.5, backward_floor=1.0)
    small = dict(forward=1.0, backward=0.0, forward_floor=0.0, backward_floor=0.0)
    phase = {"rays": 10, "samples": 100, "ms": 10.0, "parts": {"field": part, "rest": small}}
    row = {"guided": phase | {"unprofiled_ms": 9.0}, "rendering": phase | {"rays_a_second": 100}}
    row |= {"load": 2.0, "ceilings": {"bytes_per_second": 1e9, "operations_per_second": 1e9}}
    text = "\n".join(profile_sections({"machine": {}, "scenes": {"city": {"leco-ngp": row}}}))
    assert "Field and rest take 100% of a guided step, the backward pass 60%" in text
    assert "| field | 3.00 + 6.00 | 0.50 + 1.00 |" in text and "| learning" not in text
    assert "Other processes ran meanwhile (load 2.0)" in text
    phase["parts"]["of a later code"] = small
    text = "\n".join(profile_sections({"machine": {}, "scenes": {"city": {"leco-ngp": row}}}))
    assert "| of a later code | 1.00 | - |" in text
