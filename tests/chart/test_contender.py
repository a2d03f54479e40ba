"""Claims about contenders as data."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field, replace

import pytest

from leco_plugin.chart.contenders.contender import Contender, changed, short_names


@dataclass(frozen=True)
class Inner:
    depth: int = 1


@dataclass
class Outer:
    inner: Inner = field(default_factory=Inner)
    width: int = 2


CONTENDER = Contender("A + b", "a", "b", {"inner.depth": 3}, 2.0, (64,))


def test_a_setting_deep_in_a_config_is_changed_and_the_original_is_not() -> None:
    before = Outer()
    after = changed(before, "inner.depth", 5)
    assert after == Outer(Inner(5)) and before == Outer()


@pytest.mark.parametrize("path", ["height", "inner.height", "width.depth"])
def test_a_setting_that_is_not_there_is_named(path: str) -> None:
    with pytest.raises(ValueError, match=path.rpartition(".")[2]):
        changed(Outer(), path, 1)


def test_a_contender_survives_json() -> None:
    again = Contender.from_dict(json.loads(json.dumps(asdict(CONTENDER))))
    assert again == CONTENDER and again.key == CONTENDER.key


def test_the_name_is_no_part_of_what_a_contender_is() -> None:
    assert replace(CONTENDER, name="other").key == CONTENDER.key


@pytest.mark.parametrize(
    "change",
    [
        {"method": "x"},
        {"sampler": "x"},
        {"changes": {"inner.depth": 4}},
        {"budget": 1.0},
        {"grids": ()},
    ],
)
def test_everything_else_is(change: dict[str, object]) -> None:
    assert replace(CONTENDER, **change).key != CONTENDER.key


@pytest.mark.parametrize(
    ("names", "short"),
    [
        (["NGP + a", "NGP + b"], ["a", "b"]),
        (["LeCO + a", "LeCO, never frozen"], ["a", "never frozen"]),
        (["NGP + a", "Nerfacto + a"], ["NGP + a", "Nerfacto + a"]),
        (["identity", "MLP"], ["identity", "MLP"]),
        (["NGP + a", "b"], ["NGP + a", "b"]),
        (["NGP + a"], ["NGP + a"]),
    ],
)
def test_a_method_that_all_share_is_left_out_of_their_names(
    names: list[str], short: list[str]
) -> None:
    assert short_names(names) == short
