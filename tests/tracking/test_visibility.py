"""Detection probability: range, occlusion, out of view."""

from dataclasses import replace

import numpy as np
import pytest

from schemas.messages import LidarClusters
from tracking.visibility import VisibilityParams, detection_probability, hidden_share

PARAMS = VisibilityParams()


def test_probability_falls_with_range_and_ends(world):
    p = detection_probability(world.frame([]), PARAMS)(
        np.array([[5.0, 0], [40, 0], [50, 0], [54, 0], [56, 0], [500, 0]])
    )
    assert p[0] == PARAMS.p_detect
    assert (np.diff(p[:4]) < 0).all()
    assert p[3] > 0
    assert p[4:].tolist() == [0, 0]


def test_who_stands_behind_somebody_is_hidden(world):
    """The hider is seen; the one right behind is not, but is not out of view either; the one aside is."""
    p = detection_probability(world.frame([[5, 0]]), PARAMS)
    front, behind, aside = p(np.array([[5.0, 0], [10, 0], [10, 3]]))
    assert front == aside == PARAMS.p_detect
    assert behind == pytest.approx(PARAMS.p_detect_hidden)


def test_a_person_does_not_hide_itself(world):
    p = detection_probability(world.frame([[5, 0], [0, 8]]), PARAMS)
    assert (p(np.array([[5.1, 0], [0, 7.9]])) == PARAMS.p_detect).all()


def test_low_things_hide_little(world):
    frame = world.frame([[5, 0]])
    low = replace(frame, clusters=replace(frame.clusters, sizes_m=np.array([[0.4, 0.5, 0.2]])))
    behind = np.array([[10.0, 0]])
    assert detection_probability(low, PARAMS)(behind) > 2 * detection_probability(frame, PARAMS)(behind)


def test_half_covered():
    """An object of half the angle in the middle hides half."""
    share = hidden_share(np.array([[10.0, 0]]), 0.5, np.array([[5.0, 0]]), np.array([0.125]), nearer_by_m=0.5)
    assert share[0, 0] == pytest.approx(0.5, abs=0.01)


def test_sight_lines_wrap_round_behind():
    a, b = np.array([[-10.0, 0.01]]), np.array([[-5.0, -0.01]])
    assert hidden_share(a, 0.25, b, np.array([0.5]), nearer_by_m=0.5)[0, 0] == pytest.approx(1)


def test_nobody_and_nothing(world):
    frame = world.frame([])
    assert detection_probability(frame, PARAMS)(np.zeros((0, 2))).shape == (0,)
    bad = replace(frame, clusters=LidarClusters(1, "lidar", np.full((1, 3), np.nan), np.ones((1, 3)), np.array([4])))
    assert detection_probability(bad, PARAMS)(np.array([[3.0, 0]])) == pytest.approx(PARAMS.p_detect)


def test_a_cluster_of_an_impossible_size_hides_nobody(world):
    frame = world.frame([[5, 0]])
    huge = replace(frame, clusters=replace(frame.clusters, sizes_m=np.array([[2e4, 2e4, 2.0]])))
    assert detection_probability(huge, PARAMS)(np.array([[10.0, 0]])) == pytest.approx(PARAMS.p_detect)


def test_ranges_the_wrong_way_round_are_refused():
    with pytest.raises(ValueError, match="max_range_m 55 must be over full_range_m 60"):
        VisibilityParams(full_range_m=60.0)
