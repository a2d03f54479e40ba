"""Claims about which methods and samplers make contenders."""

from __future__ import annotations

from dataclasses import replace

import pytest
from nerfstudio.configs import method_configs

from leco_plugin.chart.methods import contenders
from leco_plugin.host_configs import leco_ngp, ngp_host
from leco_plugin.scenes.input_error import InputError


def found(*methods: str, samplers: tuple[str, ...] = ()) -> list[tuple[str, str]]:
    return [(one.method, one.sampler) for one in contenders(methods, samplers)]


def test_a_host_is_charted_guided_and_as_it_is() -> None:
    assert found("leco-ngp", "leco-nerfacto") == [
        ("leco-ngp", "learned-occupancy"),
        ("leco-ngp", "own"),
        ("leco-nerfacto", "learned-occupancy"),
        ("leco-nerfacto", "own"),
    ]


def test_a_method_that_learns_itself_is_charted_as_it_is() -> None:
    assert found("leco-occupancy") == [("leco-occupancy", "learned-occupancy")]


def test_each_method_gets_the_samplers_that_it_can_use() -> None:
    samplers = ("learned-occupancy-vm", "dense", "own")
    assert found("leco-occupancy", "leco-ngp", "leco-nerfacto", samplers=samplers) == [
        ("leco-occupancy", "learned-occupancy-vm"),
        ("leco-occupancy", "dense"),
        ("leco-ngp", "learned-occupancy-vm"),
        ("leco-ngp", "dense"),
        ("leco-ngp", "own"),
        ("leco-nerfacto", "learned-occupancy-vm"),
        ("leco-nerfacto", "own"),
    ]


def test_another_kind_of_gate_is_learned_with_its_own_features() -> None:
    own, hosted = contenders(["leco-occupancy", "leco-ngp"], ["learned-occupancy-k-planes"])
    assert own.changes == {"sizes.gate.encoding.kind": "k-planes"}
    assert hosted.changes["occupancy.learning.sizes.gate.encoding.kind"] == "k-planes"
    assert hosted.changes["occupancy.sampler"] == "learned-occupancy-k-planes"


def test_an_occupancy_grid_has_the_cells_that_its_name_says_and_the_levels_of_the_host() -> None:
    (one,) = contenders(["leco-ngp"], ["occupancy-grid-96"])
    options = {"resolution": 96, "levels": ngp_host().grid_levels}
    assert one.changes == {"occupancy.sampler": "occupancy-grid", "occupancy.options": options}
    assert one.name == "Instant-NGP + grid 96³"


def test_switch_nerf_uses_the_grid_that_it_fits_to_its_bounds() -> None:
    (one,) = contenders(["leco-switch-nerf"], ["occupancy-grid-96"])
    assert one.changes == {
        "occupancy.sampler": "own",
        "host.sampling": "occupancy-grid",
        "host.sizes.grid_resolution": 96,
    }


def test_names_say_what_a_host_does_by_itself() -> None:
    methods = ["leco-ngp", "leco-nerfacto", "leco-switch-nerf"]
    assert [one.name for one in contenders(methods, ["own"])] == [
        f"Instant-NGP + own grid {ngp_host().grid_resolution}³",
        "Nerfacto + proposal networks",
        "Switch-NeRF + coarse and fine samples",
    ]


def test_the_phases_of_learning_are_methods_of_the_chart() -> None:
    names = [f"leco-occupancy-{what}" for what in ("never-frozen", "retrained", "homogeneous")]
    never, retrained, homogeneous = contenders(names)
    assert never.changes == {"schedule.freeze": False, "front_to_back": True}
    assert retrained.changes == {"schedule.restart": True}
    assert homogeneous.changes == never.changes | {"homogeneous": True}
    assert contenders(["leco-occupancy"], ["dense"]) == [never]


def test_a_method_joins_by_being_registered(monkeypatch: pytest.MonkeyPatch) -> None:
    plain = replace(leco_ngp.config.pipeline, model=ngp_host())
    config = replace(leco_ngp.config, method_name="third", pipeline=plain)
    monkeypatch.setitem(method_configs.all_methods, "third", config)
    assert found("third") == [("third", "own")]
    assert found("third", samplers=("learned-occupancy",)) == [("third", "learned-occupancy")]


def test_what_is_asked_for_twice_is_made_once() -> None:
    assert len(contenders(["leco-ngp", "leco-ngp"], ["own", "own"])) == 1


@pytest.mark.parametrize(
    ("methods", "samplers", "said"),
    [
        ([], [], "--methods"),
        (["no-such"], [], "no method 'no-such'.*leco-occupancy-retrained"),
        (["leco-ngp"], ["no-such"], "no sampler 'no-such'.*own"),
        (["leco-ngp"], ["occupancy-grid-"], "no sampler"),
        (["leco-occupancy"], ["own"], "leco-occupancy has none of the samplers own"),
        (["leco-nerfacto"], ["dense"], "leco-nerfacto has none of the samplers dense"),
        (["leco-nerfacto"], ["own", "dense"], "'dense' fits none of leco-nerfacto"),
        (["leco-occupancy-retrained"], ["dense"], "it has learned-occupancy"),
    ],
)
def test_what_fits_nothing_is_refused_in_a_line(
    methods: list[str], samplers: list[str], said: str
) -> None:
    with pytest.raises(InputError, match=said) as refused:
        contenders(methods, samplers)
    assert "\n" not in str(refused.value)
