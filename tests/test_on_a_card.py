"""Methods trained on a pretended card: no tensor of the CPU meets one of the card's."""

from __future__ import annotations

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


@pytest.mark.slow
def test_the_method_is_trained_and_resumed_and_rendered_on_a_card(tmp_path: Path) -> None:
    said = run("leco-occupancy", tmp_path)
    assert said.splitlines()[-1] == "frozen, sharpened, resumed and rendered on card:0"


@pytest.mark.slow
def test_hosts_are_guided_on_a_card(tmp_path: Path) -> None:
    said = run("hosts", tmp_path)
    for host in ("leco-ngp", "leco-nerfacto", "leco-switch-nerf"):
        assert f"{host} guided and rendered on card:0\n" in said
