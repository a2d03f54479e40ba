"""Claims about which photographs are compared."""

from __future__ import annotations

import math
import tracemalloc

import numpy as np
import pytest
from rendered_survey import grid

from leco_plugin.scenes.poses.originals import Exif
from leco_plugin.scenes.poses.reconstruction import (
    ANCHORS,
    FEW,
    NEIGHBOURS,
    NEXT,
    _around,
    _in_order,
    _near,
    capture_order,
    choose_pairs,
    choose_posed_pairs,
)

NOWHERE = np.full(3, np.nan)


def names(count: int, pattern: str = "IMG_{}.jpg") -> list[str]:
    return [pattern.format(number) for number in range(count)]


def nothing(count: int) -> np.ndarray:
    return np.tile(NOWHERE, (count, 1))


def test_few_photographs_are_all_compared() -> None:
    found = choose_pairs(names(FEW), [Exif()] * FEW, nothing(FEW))
    assert len(found.pairs) == FEW * (FEW - 1) // 2


def test_near_photographs_are_compared_by_gps_and_far_ones_are_not() -> None:
    places = np.array(grid(30, 20, step=20.0))
    found = choose_pairs(names(600), [Exif()] * 600, places)
    assert found.reason == f"{NEIGHBOURS} nearest by GPS"
    assert 600 * NEIGHBOURS / 2 <= len(found.pairs) <= 600 * (NEIGHBOURS + 2)
    assert len({*found.pairs}) == len(found.pairs)
    by_place = [pair for pair in found.pairs if pair[1] - pair[0] > 2]
    apart = [float(np.linalg.norm(places[one] - places[other])) for one, other in by_place]
    assert max(apart) < 120.0
    assert all(one < other for one, other in found.pairs)


def test_lines_of_a_flight_are_compared_however_close_the_photographs_of_one_line_are() -> None:
    line, along = np.divmod(np.arange(600), 60)
    along = np.where(line % 2, 59 - along, along)  # to and fro, 40 m apart, every 3 m
    places = np.stack([3.0 * along, 40.0 * line, np.full(600, 90.0)], axis=1)
    found = choose_pairs(names(600), [Exif()] * 600, places)
    next_line = {(one, line[other]) for one, other in found.pairs if line[other] == line[one] + 1}
    assert len({one for one, _ in next_line}) == 540, "each photograph but those of the last line"
    assert len(found.pairs) <= 600 * 2 * NEIGHBOURS


def test_pairs_that_are_not_compared_take_no_memory() -> None:
    places = np.array(grid(30, 20, step=20.0))
    tracemalloc.start()
    try:
        choose_pairs(names(600), [Exif()] * 600, places)
        assert tracemalloc.get_traced_memory()[1] < 6e6  # all pairs have 13 MB
    finally:
        tracemalloc.stop()


def test_photographs_without_gps_are_compared_with_what_is_next_to_them() -> None:
    places = np.array(grid(20, 10, step=20.0))
    places[77] = NOWHERE
    found = choose_pairs(names(200), [Exif()] * 200, places)
    assert {(76, 77), (77, 78), (67, 77)} <= {*found.pairs}
    unordered = choose_pairs(["a.jpg"] * 200, [Exif()] * 200, places)
    assert sum(77 in pair for pair in unordered.pairs) == 199


@pytest.mark.parametrize("spread", [0.5, 19.9, 20.1, 200.0])
@pytest.mark.parametrize("known", [44, 45, 90])
def test_gps_decides_only_where_it_is_finer_than_the_survey(spread: float, known: int) -> None:
    """Metres from the middle, in the median, of half of all photographs or more."""
    places = np.random.default_rng(0).normal(size=(known, 3)) * [1.0, 3.0, 90.0]
    flat = places[:, :2] - np.median(places[:, :2], axis=0)
    places *= spread / np.median(np.linalg.norm(flat, axis=1))
    found = choose_pairs(names(90), [Exif()] * 90, np.concatenate([places, nothing(90 - known)]))
    assert (found.reason == "all pairs") == (spread < 20.0 or known < 45)


def test_pairs_are_those_of_a_loop_over_all_places() -> None:
    places = np.random.default_rng(1).normal(size=(30, 2)) * [1.0, 4.0]
    near, around = set(), set()
    for one in range(30):
        others = [other for other in range(30) if other != one]
        others.sort(key=lambda other: math.dist(places[one], places[other]))
        near |= {tuple(sorted((one, others[rank]))) for rank in (0, 1, 5)}
        taken = [0] * 8
        for other in others:
            east, north = places[other] - places[one]
            sector = round(math.degrees(math.atan2(north, east)) / 45.0) % 8
            if taken[sector] < 2:
                taken[sector] += 1
                around.add(tuple(sorted((one, other))))
    assert _near(places, np.array([0, 1, 5])) == near and _around(places) == around
    assert _in_order([3, 0, 2, 1], (1, 3, 9)) == {(0, 3), (0, 2), (1, 2), (1, 3)}


def test_gps_that_contradicts_the_order_does_not_decide_alone() -> None:
    places = np.array(grid(30, 20, step=20.0))
    shuffled = places[np.random.default_rng(0).permutation(600)]
    found = choose_pairs(names(600), [Exif()] * 600, shuffled)
    assert "which GPS contradicts" in found.reason
    assert {(number, number + 10) for number in range(590)} <= {*found.pairs}
    unordered = choose_pairs(["a.jpg"] * 600, [Exif()] * 600, shuffled)
    assert unordered.reason == f"{NEIGHBOURS} nearest by GPS", "no order tells anything"


def test_two_next_to_one_another_in_order_are_compared_however_far_apart_they_are() -> None:
    """Three places a kilometre apart; who goes from one to the next stood amid the others."""
    places = 50.0 * np.random.default_rng(0).normal(size=(300, 3))
    places[[97, 98, 99, 100, 101, 102]] *= 0.01
    places[100:200, 0] += 1000.0
    places[200:, 0] += 2000.0
    found = choose_pairs(names(300), [Exif()] * 300, places)
    assert found.reason == f"{NEIGHBOURS} nearest by GPS"
    between = {pair for pair in found.pairs if {*pair} <= {*range(97, 103)} and pair[0] < 100}
    assert {pair for pair in between if pair[1] >= 100} == {(98, 100), (99, 100), (99, 101)}


def test_one_wrong_position_does_not_make_a_small_place_wide() -> None:
    places = 2.0 * np.random.default_rng(0).normal(size=(60, 3))
    places[7, :2] = 5000.0
    assert choose_pairs(names(60), [Exif()] * 60, places).reason == "all pairs"


def test_an_ordered_survey_without_gps_grows_with_its_length() -> None:
    count = 2000
    found = choose_pairs(names(count), [Exif()] * count, nothing(count))
    assert len(found.pairs) < count * (NEXT + 11) + ANCHORS**2 / 2
    assert {(0, 1), (5, 15), (5, 5 + 1024), (0, 1980)} <= {*found.pairs}
    unordered = choose_pairs(["a.jpg"] * 200, [Exif()] * 200, nothing(200))
    assert len(unordered.pairs) == 200 * 199 // 2


def test_time_goes_before_names_and_numbers_count_by_value() -> None:
    assert capture_order(["IMG_10.jpg", "IMG_9.jpg"], [Exif()] * 2) == [1, 0]
    timed = [Exif(time=2.0), Exif(time=1.0)]
    assert capture_order(["IMG_1.jpg", "IMG_2.jpg"], timed) == [1, 0]
    assert capture_order(["b.jpg", "a.jpg"], [Exif()] * 2) is None
    assert capture_order(["b7.jpg", "a7.jpg"], [Exif()] * 2) is None
    times = [
        [Exif(time=each) for each in order] for order in ((3.0, 1.0, 2.0, 1.0), (2.0, 1.0) * 2)
    ]
    unnumbered = ["d.jpg", "c.jpg", "b.jpg", "a.jpg"]
    assert capture_order(unnumbered, times[0]) == [3, 1, 2, 0]
    assert capture_order(unnumbered, times[1]) is None, "half of them at one time"
    assert capture_order(["a2.jpg", "a1.jpg", "b2.jpg", "b1.jpg"], [Exif()] * 4) is None
    assert capture_order(["a2.jpg", "a1.jpg", "b3.jpg", "b1.jpg"], [Exif()] * 4) == [1, 0, 3, 2]


def test_photographs_that_look_another_way_are_not_compared_however_near() -> None:
    """Two rows, back to back: half of each photograph's nearest look away."""
    poses = np.tile(np.eye(3, 4), (2 * FEW, 1, 1))
    poses[:, 0, 3] = np.repeat(np.arange(FEW), 2)
    angles = np.where(np.arange(2 * FEW) % 2, 1.7, 0.0)  # beyond a right angle, no half turn
    poses[:, 0, 0] = poses[:, 2, 2] = np.cos(angles)
    poses[:, 0, 2], poses[:, 2, 0] = np.sin(angles), -np.sin(angles)
    pairs = choose_posed_pairs(poses).pairs
    assert {one % 2 for one, _ in pairs} == {0, 1}
    assert all(one % 2 == other % 2 for one, other in pairs)
