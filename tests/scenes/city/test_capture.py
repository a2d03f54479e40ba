"""Views follow from the configuration, and some are held out."""

import numpy as np
import pytest

from leco_plugin.scenes.city.capture import CaptureConfig, views_of
from leco_plugin.scenes.city.city import City, CityConfig


@pytest.fixture(scope="module")
def city() -> City:
    return City(CityConfig(blocks=2, seed=1))


def test_views_are_always_the_same(city: City) -> None:
    capture = CaptureConfig(aerial_per_block=3, street_per_block=1, test_every=4)
    views, again = views_of(city, capture), views_of(City(city.config), capture)
    assert [view.name for view in views] == [view.name for view in again]
    for one, other in zip(views, again):
        np.testing.assert_array_equal(one.pose, other.pose)
    assert [view.number for view in views] == list(range(16))
    assert [view.number for view in views if view.held_out] == [2, 6, 10, 14]
    assert views[12].name == "street_00000"


def test_of_two_views_the_last_is_held_out(city: City) -> None:
    capture = CaptureConfig(aerial_per_block=0.5, street_per_block=0, test_every=9)
    assert [view.held_out for view in views_of(city, capture)] == [False, True]


def test_one_view_is_too_few(city: City) -> None:
    with pytest.raises(ValueError, match="1 pictures are too few"):
        views_of(city, CaptureConfig(aerial_per_block=0.3, street_per_block=0))


@pytest.mark.parametrize(
    "bad",
    [
        {"width": 0},
        {"field_of_view": 180.0},
        {"aerial_per_block": -1.0},
        {"aerial_per_block": 0.0, "street_per_block": 0.0},
        {"test_every": 1},
    ],
)
def test_pictures_that_cannot_be_taken_are_refused_in_one_line(bad: dict) -> None:
    with pytest.raises(ValueError, match=r"^[^\n]+$"):
        CaptureConfig(**bad)
