"""Percentiles of a histogram against numpy's, and what a share excuses."""

import numpy as np
import pytest

from replay.diff_result import Difference, Kind
from replay.diff_tally import Sizes, TopicTally

ANY = Difference(Kind.VALUE, "/x", 0.0, 0, "x", "x", "1", "2")


@pytest.mark.parametrize("seed", range(4))
def test_percentiles_are_within_a_bin_of_exact_ones(seed):
    rng = np.random.default_rng(seed)
    sizes = 10 ** rng.uniform(-6, 3, 2000)
    histogram, half = Sizes(), Sizes()
    histogram.add(sizes[:700])
    half.add(sizes[700:])
    histogram.merge(half)
    for percent in (1, 50, 99, 100):
        exact = np.percentile(sizes, percent, method="inverted_cdf")
        assert histogram.percentile(percent) == pytest.approx(exact, rel=0.006)
    assert histogram.largest == sizes.max()


def test_one_size_is_every_percentile_and_none_is_none():
    sizes = Sizes()
    assert sizes.percentile(50) is None
    sizes.add(np.array([0.058, 0.0, np.inf, np.nan]))
    assert (sizes.percentile(50), sizes.percentile(99), sizes.largest) == (0.058, 0.058, 0.058)


def test_sizes_beyond_the_bins_are_kept():
    sizes = Sizes()
    sizes.add(np.array([1e-30, 1e30]))
    assert (sizes.percentile(1), sizes.percentile(99)) == (
        pytest.approx(1e-18, rel=0.01),
        pytest.approx(1e18, rel=0.01),
    )


@pytest.mark.parametrize(("share", "same"), [(0.0, False), (0.09, False), (0.1, True), (1.0, True)])
@pytest.mark.parametrize("what", ["values", "messages", "items"])
def test_a_share_excuses_each_of_its_kind(what, share, same):
    tally = TopicTally("/x", (10, 9))
    tally.begin(0.0, 0)
    tally.same_values("x", 9)
    tally.items_seen.update({"tracks": 10, "tracks.history.x": 1000})
    if what == "values":
        tally.other_values("x", 1, np.array([3.0]), lambda: ANY)
    elif what == "messages":
        tally.lone_message(lambda: ANY)
    else:
        tally.lone_items("tracks", 1, lambda: ANY)
    tally.end(7)
    result = tally.result(share)
    assert result.same is same
    assert result.first is ANY
    assert [place for place, count in enumerate(result.when) if count] == [7]


def test_a_message_that_differs_in_many_ways_counts_once_over_time():
    tally = TopicTally("/x", (1, 1))
    tally.begin(2.5, 0)
    tally.other_values("x", 4, np.array([1.0, 2.0, 3.0, 4.0]), lambda: ANY)
    tally.lone_items("tracks", 3, lambda: ANY)
    tally.end(0)
    result = tally.result(0)
    assert result.when[0] == 1
    assert (result.different, result.items, result.fields[0].first_at_s) == (4, 3, 2.5)
