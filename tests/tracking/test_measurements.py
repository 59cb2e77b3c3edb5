"""Building measurements: refusal, sorting and the floor on covariances."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tracking.measurements import CameraEvidence, empty_measurements, floor_eigenvalues, make_measurements


@given(st.permutations(range(6)))
def test_order_of_input_does_not_matter(order):
    generator = np.random.default_rng(1)
    positions, probability = generator.normal(size=(6, 2)), generator.uniform(0.1, 0.9, 6)
    positions[3] = positions[2]  # a tie in position is broken by the rest
    covs = np.stack([np.eye(2) * scale for scale in generator.uniform(0.1, 0.2, 6)])
    index, order = np.arange(6), np.array(order)
    a = make_measurements(positions, covs, probability, index)
    b = make_measurements(positions[order], covs[order], probability[order], index[order])
    np.testing.assert_array_equal(a.positions_m, b.positions_m)
    np.testing.assert_array_equal(a.covariances_m2, b.covariances_m2)
    np.testing.assert_array_equal(a.pedestrian_probability, b.pedestrian_probability)
    np.testing.assert_array_equal(a.cluster_index, b.cluster_index)


def test_what_is_not_sound_is_dropped_and_counted():
    good, bad = np.eye(2) * 0.1, np.array([[1.0, 2.0], [2.0, 1.0]])
    positions = np.array([[0, 0], [np.nan, 0], [1, 1], [2, 2], [3, 3], [np.inf, 1]])
    covs = np.stack([good, good, bad, good * np.nan, -good, good])
    scan = make_measurements(positions, covs)
    assert scan.cluster_index.tolist() == [0]
    assert scan.refused == 5
    assert scan.refused_cluster_index.tolist() == [1, 2, 3, 4, 5]


def test_evidence_follows_its_measurement():
    scan = make_measurements(np.array([[5.0, 0], [1.0, 0]]), np.eye(2), evidence=[(CameraEvidence("A0", 3, 0.8),), ()])
    assert scan.evidence == ((), (CameraEvidence("A0", 3, 0.8),))
    assert scan.cluster_index.tolist() == [1, 0]


@given(st.floats(0, np.pi), st.floats(0, 0.1), st.floats(0.01, 1))
def test_eigenvalues_are_floored_and_directions_kept(angle, small, large):
    R = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    cov = R @ np.diag([large, small]) @ R.T
    floored = floor_eigenvalues(cov[None], 0.05)[0]
    expected = R @ np.diag(np.maximum([large, small], 0.05)) @ R.T
    np.testing.assert_allclose(floored, expected, atol=1e-12)


def test_nothing():
    scan = make_measurements(np.zeros((0, 2)), np.zeros((0, 2, 2)))
    assert len(scan) == len(empty_measurements()) == 0
    assert scan.refused == 0


def test_wrong_shapes_are_refused():
    with pytest.raises(ValueError, match=r"shape \(M, 2\), got \(3, 3\)"):
        make_measurements(np.zeros((3, 3)), np.eye(2))
    with pytest.raises(ValueError, match="2 positions, 3 covariances"):
        make_measurements(np.zeros((2, 2)), np.ones((3, 2, 2)))


def test_the_last_tie_does_not_fall_to_the_order_of_input():
    """Two measurements that differ in the covariance's last entry only."""
    covs = np.array([np.diag([0.04, 0.05]), np.diag([0.04, 0.09])])
    a, b = (make_measurements(np.zeros((2, 2)), covs[order], np.full(2, 0.5)) for order in ([0, 1], [1, 0]))
    assert np.array_equal(a.covariances_m2, b.covariances_m2)


def test_a_refused_measurement_without_a_cluster_names_none():
    scan = make_measurements(np.array([[np.nan, 0.0], [1e9, 0.0]]), np.eye(2), cluster_index=np.array([-1, 3]))
    assert scan.refused == 2
    assert scan.refused_cluster_index.tolist() == [3]
