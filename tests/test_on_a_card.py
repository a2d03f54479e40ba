"""Methods trained on a pretended card: no tensor of the CPU meets one of the card's."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

PROGRAM = Path(__file__).with_name("training_on_a_card.py")


def run(*arguments: object) -> str:
    """What the program prints. In a process of its own: torch keeps a backend for good."""
    done = subprocess.run(
        [sys.executable, PROGRAM, *map(str, arguments)], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr[-4000:]
    return done.stdout


def test_a_pretended_card_refuses_what_a_card_refuses() -> None:
    assert run("refusals").split() == ["refused"] * 6


def test_a_frozen_gate_samples_on_a_card_as_on_a_cpu() -> None:
    assert run("sampling").split() == ["same"] * 4


def test_the_cpu_knows_what_it_decides_by_however_that_was_written() -> None:
    assert run("reading").split() == ["known"] * 6


def test_what_skipping_costs_is_measured_on_a_card_without_float64() -> None:
    assert run("without_float64") == "measured\n"


@pytest.fixture(scope="module")
def method(tmp_path_factory: pytest.TempPathFactory) -> str:
    """What is said of the method's whole life on a card."""
    return run("leco-occupancy", tmp_path_factory.mktemp("method"))


@pytest.fixture(scope="module")
def hosts(tmp_path_factory: pytest.TempPathFactory) -> str:
    """What is said of guided hosts on a card."""
    return run("hosts", tmp_path_factory.mktemp("hosts"))


@pytest.mark.slow
def test_the_method_is_trained_and_resumed_and_rendered_on_a_card(method: str) -> None:
    assert method.splitlines()[-1] == "frozen, sharpened, resumed and rendered on card:0"


@pytest.mark.slow
def test_hosts_are_guided_on_a_card(hosts: str) -> None:
    for host in ("leco-ngp", "leco-nerfacto", "leco-switch-nerf"):
        assert f"{host} guided and rendered on card:0\n" in hosts


@pytest.mark.slow
def test_a_step_waits_for_the_card_for_sizes_and_to_see_that_losses_are_finite(
    method: str, hosts: str
) -> None:
    """In this package. The numbers are those of `docs/decisions.md`, and may only shrink."""
    most = {"leco-occupancy, learning,": 11, "leco-occupancy, guided,": 9, "leco-ngp": 9}
    for name, times in most.items():
        found = re.search(rf"^{name} waits (\d+) times a step: (.*)$", method + hosts, re.M)
        assert found is not None and int(found[1]) <= times, found
