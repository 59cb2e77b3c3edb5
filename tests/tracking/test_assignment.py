"""The sparse assignment against every possible one, and against the dense Hungarian method."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import linear_sum_assignment

from tracking.assignment import assign

seeds = st.integers(0, 10_000)


@given(seeds, st.floats(0.02, 1))
def test_it_is_one_to_one_and_as_good_as_the_dense_solution(seed, density):
    generator = np.random.default_rng(seed)
    rows, columns = np.nonzero(generator.random((9, 14)) < density)
    gains = generator.uniform(0.1, 1, len(rows))
    kept = assign(rows, columns, gains)
    assert len(set(rows[kept])) == len(set(columns[kept])) == kept.sum()
    dense = np.zeros((9, 14))
    dense[rows, columns] = gains
    assert gains[kept].sum() == pytest.approx(dense[linear_sum_assignment(dense, maximize=True)].sum())


@given(seeds)
def test_the_order_of_the_pairs_does_not_matter(seed):
    generator = np.random.default_rng(seed)
    rows, columns = np.nonzero(generator.random((6, 6)) < 0.5)
    gains, order = generator.uniform(0.1, 1, len(rows)), generator.permutation(len(rows))
    kept = assign(rows, columns, gains)
    np.testing.assert_array_equal(assign(rows[order], columns[order], gains[order]), kept[order])


def test_giving_up_the_best_pair_for_two_good_ones():
    """Row 0 would gain most from column 0, but row 1 has nothing else; row 7 is nobody's rival."""
    kept = assign(np.array([0, 0, 1, 7]), np.array([0, 5, 0, 9]), np.array([1.0, 0.8, 0.7, 1e-9]))
    assert kept.tolist() == [False, True, True, True]


def test_no_pairs():
    nothing = np.zeros(0, np.int64)
    assert assign(nothing, nothing, np.zeros(0)).shape == (0,)
