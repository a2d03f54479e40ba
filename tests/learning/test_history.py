"""Claims about the history of a gate."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from leco_plugin.learning.history import FILE_NAME, GateHistory, as_learned
from leco_plugin.models.encodings import EncodingConfig
from leco_plugin.models.gate import Gate, GateConfig
from leco_plugin.occupancy import Occupancy
from leco_plugin.space import Space


def a_gate(width: int = 8) -> Gate:
    return Gate(GateConfig(EncodingConfig(octaves=1), width=width, layers=1, scene_experts=2))


def a_history(gate: Gate, looks: int = 3) -> GateHistory:
    history = GateHistory()
    for look in range(looks):
        with torch.no_grad():
            gate.head.bias += 1.0
        routes, sigmas = torch.tensor([0, 0, 0, 2]), torch.tensor([0.0, 3.0, 0.0, 5.0])
        history.look(10 * look, look / 3, gate, routes, sigmas)
    return history


def test_shares_and_mean_densities_are_those_of_the_points_of_each_expert() -> None:
    history = a_history(a_gate(), 1)
    assert history.all("shares")[0].tolist() == [0.75, 0.0, 0.25]
    assert history.all("densities")[0].tolist() == [1.0, 0.0, 5.0]


def test_the_gate_of_each_look_comes_back_from_the_file(tmp_path: Path) -> None:
    gate = a_gate()
    before = gate.head.bias.detach().clone()
    a_history(gate).save(tmp_path)
    found = GateHistory.load(tmp_path / FILE_NAME, gate)
    assert found.steps == [0, 10, 20] and found.all("seconds").tolist() == [0.0, 1 / 3, 2 / 3]
    for look in range(3):
        weights = found.weights(look)
        torch.testing.assert_close(weights["head.bias"], before + 1.0 + look)
    assert weights.keys() == gate.state_dict().keys()
    assert [path.name for path in tmp_path.iterdir()] == [FILE_NAME]


def test_a_resumed_run_goes_on_with_the_looks_before_its_first_step(tmp_path: Path) -> None:
    gate = a_gate()
    history = a_history(gate)
    history.save(tmp_path)
    folder, nested = tmp_path / "nerfstudio_models", tmp_path / "models" / "of_this"
    for models in (folder, nested):
        models.mkdir(parents=True)
    (tmp_path / "config.yml").touch()
    for checkpoint in (folder, folder / "step-000000015.ckpt", nested):
        found = GateHistory.load_before(checkpoint, 16, gate)
        assert found.steps == [0, 10] and len(found) == 2
        found.look(16, 1.0, gate, torch.tensor([0]), torch.tensor([0.0]))
        assert GateHistory.load(found.save(folder), gate).steps == [0, 10, 16]
    (tmp_path / "config.yml").unlink()
    assert GateHistory.load_before(folder, 10, gate).steps == [0]  # step 10 is made again
    assert len(GateHistory.load_before(folder, 16, a_gate(width=12))) == 0
    assert len(GateHistory.load_before(tmp_path / "a" / "b" / "none.ckpt", 16, gate)) == 0


def test_other_files_are_refused_in_a_line(tmp_path: Path) -> None:
    path = a_history(a_gate()).save(tmp_path)
    with pytest.raises(ValueError, match="another gate"):
        GateHistory.load(path, a_gate(width=12))
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match="not a whole safetensors file"):
        GateHistory.load(path, a_gate())
    Occupancy(a_gate(), Space(), 0.5).save(path)
    with pytest.raises(ValueError, match="not a history"):
        GateHistory.load(path, a_gate())
    with pytest.raises(FileNotFoundError):
        GateHistory.load(tmp_path / "none", a_gate())
    with pytest.raises(ValueError, match="single look"):
        GateHistory().save(tmp_path)


@pytest.mark.parametrize("learned", [3, {}, {"gate": 3, "threshold": 0.5}])
def test_a_damaged_report_names_no_learned_gate(learned: Any) -> None:
    occupancy = Occupancy(a_gate(), Space(), 0.5, report={"learned": learned})
    with pytest.raises(ValueError, match="names no gate as `learned`"):
        as_learned(occupancy)


def test_a_gate_that_a_host_taught_along_is_as_it_was_learned() -> None:
    occupancy = Occupancy(a_gate(), Space(), 0.5, report={"learned": "along"})
    assert as_learned(occupancy) is occupancy
