"""One to one assignment of sparse pairs: boxes to clusters in fusion, measurements to labels in the filter."""

import numpy as np
from scipy.optimize import linear_sum_assignment

from schemas.messages import BoolArray, FloatArray, IntArray


def assign(rows: IntArray, columns: IntArray, gains: FloatArray) -> BoolArray:
    """Marks the pairs (P,) to keep so that no row and no column occurs twice and the total gain is the largest.

    Where a row and a column know only each other there is nothing to solve: the Hungarian method gets the contested
    pairs alone.

    Args:
        rows: (P,) numbers from 0; no pair of row and column occurs twice.
        columns: (P,) likewise.
        gains: (P,) not negative.
    """
    kept: BoolArray = (np.bincount(rows)[rows] == 1) & (np.bincount(columns)[columns] == 1)
    contested = np.flatnonzero(~kept)
    if len(contested) == 0:
        return kept
    row, R = _renumbered(rows[contested])
    column, C = _renumbered(columns[contested])
    matrix = np.zeros((R, C))
    matrix[row, column] = gains[contested]
    best = np.full(R, -1)
    assigned_rows, assigned_columns = linear_sum_assignment(matrix, maximize=True)
    best[assigned_rows] = assigned_columns
    kept[contested] = best[row] == column
    return kept


def _renumbered(numbers: IntArray) -> tuple[IntArray, int]:
    """Returns the numbers (P,) without the gaps between them, in the same order, and how many different ones."""
    used = np.zeros(int(numbers.max()) + 1, np.int64)
    used[numbers] = 1
    place = np.cumsum(used)
    return place[numbers] - 1, int(place[-1])
