"""Samplers are found by name, and a broken one of another package harms nobody."""

from __future__ import annotations

import contextlib
import functools
import importlib
import inspect
import re
import warnings
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest
import torch
from ball_occupancy import ball
from samplers.analytic_occupancy import Balls, camera_rays

from leco_plugin.samplers import registry
from leco_plugin.samplers.base import Estimator
from leco_plugin.samplers.estimator import LearnedOccupancyEstimator
from leco_plugin.samplers.grid import OccupancyGridEstimator
from leco_plugin.samplers.registry import (
    SamplerSpec,
    build_estimator,
    build_proposal,
    refuse_unknown_options,
    samplers,
)

KINDS = ["hash", "vm", "k-planes", "grid"]
BOX = torch.tensor([-1.0] * 3 + [1.0] * 3)
FOREIGN = SamplerSpec("another package's", estimator=lambda aabb, occupancy: torch.nn.Identity())


@pytest.mark.parametrize("name", ["dense", "occupancy-grid", "learned-occupancy"])
def test_ours_are_estimators_that_sample(name):
    estimator = build_estimator(name, aabb=BOX, occupancy=Balls())
    assert isinstance(estimator, Estimator)
    samples = estimator.sampling(*camera_rays(10), render_step_size=0.1)
    assert len(samples) == 3


def test_options_reach_the_sampler():
    grid = build_estimator("occupancy-grid", aabb=BOX, resolution=16, levels=2)
    assert grid.binaries.shape == (2, 16, 16, 16)
    learned = build_estimator("learned-occupancy", occupancy=Balls(), cache_bytes=0)
    assert learned.cache is None


@pytest.mark.parametrize(
    ("builder", "made"),
    [
        (registry.build_grid, OccupancyGridEstimator),
        (registry.build_learned, LearnedOccupancyEstimator),
    ],
)
def test_an_option_left_out_is_what_it_is_without_the_registry(builder, made):
    own = inspect.signature(made).parameters
    options = {
        name: each.default
        for name, each in inspect.signature(builder).parameters.items()
        if name not in registry.GIVEN
    }
    assert options == {name: own[name].default for name in options}
    assert options.keys() == own.keys() - registry.GIVEN - {"roi_aabb"}


def test_options_that_a_sampler_does_not_have_are_named():
    refuse_unknown_options("learned-occupancy", ["cache_bytes", "tolerance", "num_candidates"])
    refuse_unknown_options("dense", ["levels"], ("estimator",))
    with pytest.raises(ValueError, match=r"'dense' has no option 'aabb'; there are levels$"):
        refuse_unknown_options("dense", ["levels", "aabb"])
    with pytest.raises(ValueError, match=r"'dense' has no option 'levels' .* there are none$"):
        refuse_unknown_options("dense", ["levels"], ("proposal",))
    with pytest.raises(ValueError, match="no sampler 'dens'"):
        refuse_unknown_options("dens", [])


def test_a_builder_that_takes_anything_is_not_asked_what(monkeypatch):
    spec = SamplerSpec("takes all", estimator=lambda aabb, **options: torch.nn.Identity())
    monkeypatch.setitem(registry.OURS, "takes-all", spec)
    refuse_unknown_options("takes-all", ["whatever"])


class TakesMore(torch.nn.Module):
    """A builder that is a class."""

    def __init__(self, aabb, occupancy, cells=4, *, levels=1):
        super().__init__()
        self.cells = cells * levels


@pytest.mark.parametrize(
    ("builder", "options", "said"),
    [
        (TakesMore, {"cells": 2, "levels": 3}, None),
        (
            TakesMore,
            {"cubes": 2},
            r"has no option 'cubes' in packed .*are cells, levels$",
        ),
        (functools.partial(TakesMore, cells=8), {"levels": 3}, None),
        (functools.partial(TakesMore, cells=8), {"cubes": 2}, "has no option 'cubes'"),
        (dict, {"whatever": 2}, None),  # nobody knows what a compiled class takes
        ("nowhere.at_all:build", {}, r"nowhere\.at_all:build cannot be imported: No module named"),
        ("math:build", {}, "math:build cannot be imported: module 'math' has no attribute 'build'"),
        ("half_written:build", {}, r"^half_written:build cannot be imported: expected .*line 1\)$"),
        ("./mine.py:build", {}, r"^\./mine\.py:build cannot be imported: .*relative import"),
    ],
)
def test_builders_of_any_kind_are_asked_what_they_take(
    builder, options, said, monkeypatch, tmp_path
):
    (tmp_path / "half_written.py").write_text("def build(aabb, occupancy)\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(registry.OURS, "theirs", SamplerSpec("theirs", estimator=builder))
    expected = contextlib.nullcontext() if said is None else pytest.raises(ValueError, match=said)
    with expected:
        build_estimator("theirs", aabb=BOX, occupancy=None, **options)
    if "cubes" not in options and said is None:
        refuse_unknown_options("theirs", options)


def test_a_builder_that_needs_what_it_is_not_given_says_so(monkeypatch):
    monkeypatch.setitem(registry.OURS, "theirs", SamplerSpec("theirs", estimator=TakesMore))
    with pytest.raises(ValueError, match=r"^sampler 'theirs' needs occupancy$"):
        build_estimator("theirs", aabb=BOX)
    with pytest.raises(ValueError, match=r"^aabb must be a finite box \(min, max\), got None$"):
        build_estimator("occupancy-grid", aabb=None)


def test_a_proposal_host_gets_a_sampler():
    pytest.importorskip("nerfstudio")
    sampler = build_proposal("learned-occupancy", occupancy=Balls(), num_samples=8, cache_bytes=0)
    assert sampler.num_samples == 8


@pytest.mark.parametrize("kind", KINDS)
def test_a_learned_occupancy_of_one_kind_asks_a_gate_of_that_kind(kind):
    name, occupancy = f"learned-occupancy-{kind}", ball(kind)
    estimator = build_estimator(name, aabb=BOX, occupancy=occupancy, cache_bytes=0)
    positions = torch.rand(500, 3) * 4.0 - torch.tensor([1.0, 0.0, 1.5])
    assert torch.equal(estimator.occupied(positions), occupancy.occupied(positions))
    assert 0 < int(estimator.occupied(positions).sum()) < 500
    for other in [ball(), *(ball(other) for other in KINDS if other != kind), Balls()]:
        remedy = f"ns-train leco-occupancy --pipeline.model.sizes.gate.encoding.kind {kind} "
        with pytest.raises(ValueError, match=f"'{name}' asks a gate on {kind} .*{remedy}") as error:
            build_estimator(name, aabb=BOX, occupancy=other)
        assert "\n" not in str(error.value)
    with pytest.raises(ValueError, match=f"'{name}' needs an occupancy"):
        build_estimator(name, aabb=BOX)


@pytest.mark.parametrize("kind", KINDS)
def test_a_proposal_host_gets_a_gate_of_one_kind(kind):
    pytest.importorskip("nerfstudio")
    options = {"num_samples": 8, "cache_bytes": 0}
    assert build_proposal(f"learned-occupancy-{kind}", occupancy=ball(kind), **options)
    with pytest.raises(ValueError, match=f"asks a gate on {kind} features"):
        build_proposal(f"learned-occupancy-{kind}", occupancy=ball(), **options)


def test_every_sampler_of_ours_is_an_entry_point_too():
    pyproject = Path(__file__).parents[2] / "pyproject.toml"
    section = pyproject.read_text().split(f'entry-points."{registry.GROUP}"]')[1].split("[")[0]
    found = dict(re.findall(r'^([\w-]+) = "leco_plugin.samplers.registry:(\w+)"$', section, re.M))
    assert {name: getattr(registry, value) for name, value in found.items()} == registry.OURS


def test_mistakes_are_named():
    with pytest.raises(
        ValueError, match="no sampler 'grid'; there are dense, dense-proposal, learned-occ"
    ):
        build_estimator("grid")
    with pytest.raises(ValueError, match="'learned-occupancy' needs an occupancy"):
        build_estimator("learned-occupancy", aabb=BOX)
    with pytest.raises(ValueError, match="'dense' has no option 'foo' in packed hosts"):
        build_estimator("dense", foo=1)
    with pytest.raises(ValueError, match=r"^sampler 'occupancy-grid' needs aabb$"):
        build_estimator("occupancy-grid")
    with pytest.raises(ValueError, match="'dense' has nothing for proposal hosts"):
        build_proposal("dense")


def test_entry_points_of_other_packages_are_found_and_broken_ones_left_out(monkeypatch):
    here = "leco_plugin.samplers.registry"
    entries = [
        EntryPoint("foreign", f"{here}:FOREIGN", registry.GROUP),
        EntryPoint("broken", "no_such_module:spec", registry.GROUP),
        EntryPoint("builder", f"{here}:build_dense", registry.GROUP),  # no SamplerSpec
        EntryPoint("dense", "no_such_module:spec", registry.GROUP),  # ours stay ours
        EntryPoint("foreign", f"{here}:DENSE", registry.GROUP),  # of yet another package
    ]
    monkeypatch.setattr("leco_plugin.samplers.registry.entry_points", lambda group: entries)
    monkeypatch.setattr(registry, "FOREIGN", FOREIGN, raising=False)
    with pytest.warns(UserWarning, match="leco_plugin.samplers '.*' is left out") as warned:
        found = samplers()
    said = [re.findall(r"'(\w+)' is.*?(taken)?$", str(each.message))[0] for each in warned]
    named = [("broken", ""), ("builder", ""), ("dense", "taken"), ("foreign", "taken")]
    assert said == named
    assert found["foreign"] is FOREIGN
    assert set(found) == {*registry.OURS, "foreign"}
    assert found["dense"] is registry.DENSE
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert isinstance(build_estimator("foreign", aabb=BOX, occupancy=None), torch.nn.Identity)
        with pytest.raises(ValueError, match="'broken' is registered, but no_such_module:spec can"):
            build_estimator("broken", aabb=BOX)
        with pytest.raises(ValueError, match="of type function, where a SamplerSpec is expected"):
            build_estimator("builder", aabb=BOX)


def test_a_package_that_is_installed_while_the_process_runs_is_found(tmp_path, monkeypatch):
    """As in a notebook."""
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(registry, "FOREIGN", FOREIGN, raising=False)
    assert "late" not in samplers()
    installed = tmp_path / "late-1.0.dist-info"
    installed.mkdir()
    (installed / "METADATA").write_text("Metadata-Version: 2.1\nName: late\nVersion: 1.0\n")
    entry = f"[{registry.GROUP}]\nlate = leco_plugin.samplers.registry:FOREIGN\n"
    (installed / "entry_points.txt").write_text(entry)
    importlib.invalidate_caches()
    assert samplers()["late"] is FOREIGN


@pytest.mark.parametrize(
    ("body", "said"),
    [
        ("raise SystemExit(3)", "SystemExit: 3"),
        ("raise SystemExit", "SystemExit"),
        ("raise ValueError('first\\nsecond')", "ValueError: first"),
    ],
)
def test_a_module_that_ends_the_process_or_talks_at_length_is_left_out_in_a_line(
    body, said, tmp_path, monkeypatch
):
    (tmp_path / "a_foreign_sampler.py").write_text(body)
    monkeypatch.syspath_prepend(tmp_path)
    entry = EntryPoint("foreign", "a_foreign_sampler:SPEC", registry.GROUP)
    monkeypatch.setattr("leco_plugin.samplers.registry.entry_points", lambda group: [entry])
    with pytest.warns(UserWarning) as warned:
        assert set(samplers()) == set(registry.OURS)
    (message,) = [str(each.message) for each in warned]
    assert message.endswith(f"left out: a_foreign_sampler:SPEC cannot be loaded: {said}")


def test_the_torch_core_imports_nothing_of_nerfstudio_or_nerfacc():
    import subprocess
    import sys

    package = Path(registry.__file__).parents[1]
    found = [*(package / "samplers").rglob("*.py"), package / "occupancy.py", package / "space.py"]
    found += [package / "models" / f"{name}.py" for name in ("gate", "frozen_gate", "encodings")]
    names = [".".join(file.relative_to(package.parent).with_suffix("").parts) for file in found]
    others = ("_kernel", ".grid")  # Triton's, and nerfacc's own grid
    code = f"""
import importlib, sys
for name in {[name for name in names if not name.endswith(others)]}:
    importlib.import_module(name)
assert not [m for m in sys.modules if m.split(".")[0] in ("nerfstudio", "nerfacc", "tyro")]
importlib.import_module("leco_plugin.samplers.grid")
assert "nerfstudio" not in sys.modules
"""
    subprocess.run([sys.executable, "-c", code], check=True)
