"""Claims about the rule by which contenders are ahead, level or behind."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from leco_plugin.chart.summary import compare

NAN, OPEN = math.nan, "undecided"
SPREAD = st.lists(st.integers(0, 9).map(float), min_size=2, max_size=6)


@pytest.mark.parametrize(
    ("ours", "theirs", "word", "said"),
    [
        # the 97.5% point of t is 2.776 with 4 degrees of freedom, 12.706 with one: from a table
        ((21.0, 22.0, 23.0), (11.0, 12.0, 13.0), "ahead", "ahead: +10.00 ± 2.27 dB, 3 seeds"),
        ((11.0, 12.0, 13.0), (21.0, 22.0, 23.0), "behind", "behind: -10.00 ± 2.27 dB, 3 seeds"),
        ((21.1, 21.2, 21.3), (21.0, 21.1, 21.2), "level", "level: +0.10 ± 0.23 dB, 3 seeds"),
        ((21.0, 22.0, 23.0), (20.0, 21.0, 22.0), OPEN, "undecided: +1.00 ± 2.27 dB, 3 seeds"),
        ((20.0, 22.0), (19.0, 19.0), OPEN, "undecided: +2.00 ± 12.71 dB, 2 seeds"),
        ((20.0, 22.0), (19.0, 19.0, 19.0), OPEN, "undecided: +2.00 ± 12.71 dB, 2 and 3 seeds"),
        ((20.0,), (11.0, 12.0, 13.0), None, "+8.00 dB, one seed: no verdict"),
        ((20.0,), (10.0,), None, "+10.00 dB, one seed: no verdict"),
        ((20.0, 20.0), (20.0, 20.0), "level", "level: +0.00 ± 0.00 dB, 2 seeds"),
        ((20.5, 20.5), (20.0, 20.0), "ahead", "ahead: +0.50 ± 0.00 dB, 2 seeds"),
        ((20.0, NAN), (10.0, 10.0), None, "+nan dB, not a number: no verdict"),
        ((20.0, 21.0), (math.inf, 10.0), None, "-inf dB, not a number: no verdict"),
    ],
)
def test_planted_answers_are_found(ours, theirs, word, said) -> None:
    found = compare(ours, theirs)
    assert (found.word, found.said()) == (word, said)


@settings(max_examples=30)
@given(SPREAD, SPREAD)
def test_the_interval_is_that_of_scipy_and_swapping_two_swaps_the_verdict(ours, theirs) -> None:
    found, swapped = compare(ours, theirs), compare(theirs, ours)
    opposite = {"ahead": "behind", "behind": "ahead", "level": "level", OPEN: OPEN}
    assert swapped.word == opposite[found.word] and swapped.margin == pytest.approx(found.margin)
    if min(len(set(ours)), len(set(theirs))) > 1:  # scipy warns of one that does not scatter
        interval = stats.ttest_ind(ours, theirs, equal_var=False).confidence_interval(0.95)
        low, high = found.difference - found.margin, found.difference + found.margin
        assert (low, high) == pytest.approx((interval.low, interval.high))
        assert found.is_open == (interval.low <= 0.0 <= interval.high)


def test_seeds_are_no_pairs() -> None:
    """Each run gains 0.1 on that of the same number, which pairs would call a lead."""
    theirs = [20.0, 21.0, 22.0, 23.0, 24.0]
    assert compare([value + 0.1 for value in theirs], theirs).is_open


@pytest.mark.parametrize(
    ("close", "word"), [(2.26, OPEN), (2.28, "level"), (0.5, OPEN), (None, "level")]
)
def test_two_are_level_only_where_the_seeds_leave_little_room(close, word) -> None:
    """A quarter of the mean of all is 5.4 here; the margin is 2.27."""
    assert compare((21.0, 22.0, 23.0), (20.0, 21.0, 22.0), close=close).word == word
    small, wide = (0.1, 0.2, 0.3), (0.2, 0.3, 0.4)
    assert compare(small, wide, close=None).word == OPEN


def test_nothing_cannot_be_compared() -> None:
    with pytest.raises(ValueError, match="0 runs cannot be compared with 1"):
        compare([], [20.0])
