"""Planted scenes with known answers, scanned by a small VLP-16 of the test's own."""

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from schemas.messages import PointCloud
from tracking.fusion import FusionParams, fuse
from tracking.measurements import no_predicted_tracks
from tracking.segmentation import SegmentationParams, segment
from tracking.sensor_frame import SensorFrame

PARAMS = SegmentationParams()
TO_40_M = PARAMS.model_copy(update={"max_range_m": 40.0})  # rings on a ramp are 20 m apart out there
HEIGHT_M = 1.37
FLAT = ((-1e3, 1e3, 0.0, 0.0),)
RAMP = ((-1e3, 8.0, 0.0, 0.0), (8.0, 1e3, -0.4, 0.05))  # up by 5 % from 8 m ahead on
# x from, x to, then z = offset + slope x


@dataclass(frozen=True)
class Body:
    """An upright elliptic cylinder that faces the sensor."""

    x: float
    y: float
    half_width_m: float = 0.25
    half_depth_m: float = 0.15
    bottom_m: float = 0.0
    top_m: float = 1.75


def scan(bodies=(), ground=FLAT, *, tilt_deg=7.0, noise_m=0.02, rings=16, seed=0, walls=()):
    """A scan of ground pieces, bodies and walls (x of a plane across, y from, y to, top), sensor nose down by a tilt.

    Returns the cloud and lidar_from_map's rotation; the sensor is 1.37 m above the origin.
    """
    azimuth, elevation = np.meshgrid(
        np.radians(np.arange(0, 360, 0.2)), np.radians(-15 + 30 / (rings - 1) * np.arange(rings))
    )
    beams = np.stack([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], -1)
    beams = beams.reshape(-1, 3)
    t = np.radians(tilt_deg)
    R = np.array([[np.cos(t), 0, np.sin(t)], [0, 1, 0], [-np.sin(t), 0, np.cos(t)]])
    x, y, z = (beams @ R.T).T
    nearest = np.full(len(beams), np.inf)

    def meet(distance, hits):
        ok = hits & np.isfinite(distance) & (distance > 0)
        nearest[ok] = np.minimum(nearest[ok], distance[ok])

    with np.errstate(divide="ignore", invalid="ignore"):
        for x_from, x_to, offset, slope in ground:
            distance = (offset - HEIGHT_M) / (z - slope * x)
            meet(distance, (x * distance >= x_from) & (x * distance < x_to))
        for wall_x, y_from, y_to, top in walls:
            distance = wall_x / x
            meet(distance, (y * distance >= y_from) & (y * distance <= y_to) & (HEIGHT_M + z * distance <= top))
        for body in bodies:
            away = np.hypot(body.x, body.y)
            along = (x * body.x + y * body.y) / away / body.half_depth_m
            across = (y * body.x - x * body.y) / away / body.half_width_m
            a, b, c = along**2 + across**2, along * away / body.half_depth_m, (away / body.half_depth_m) ** 2 - 1
            distance = (b - np.sqrt(b * b - a * c)) / a
            up = HEIGHT_M + z * distance
            meet(distance, (up >= body.bottom_m) & (up <= body.top_m))
    rng = np.random.default_rng(seed)
    seen = nearest < 80
    ranges = nearest[seen] + noise_m * rng.standard_normal(int(seen.sum()))
    return cloud_of((beams[seen] * ranges[:, None]).astype(np.float32)), R


def cloud_of(points):
    return PointCloud(123, "velodyne", np.asarray(points).reshape(-1, 3))


def in_map(clusters, R):
    return clusters.centroids_m @ R.T + (0, 0, HEIGHT_M)


def assert_same(a, b):
    for name in ("centroids_m", "sizes_m", "points"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


@pytest.mark.parametrize("tilt_deg", [-4.0, 0.0, 7.0, 12.0])
def test_two_bodies_on_a_plane_seen_by_a_tilted_sensor_are_two_clusters(tilt_deg):
    cloud, R = scan([Body(8, 3), Body(7, -2, 0.4, 0.25, top_m=1.2)], tilt_deg=tilt_deg)
    found = segment(cloud, PARAMS)
    assert (found.stamp_ns, found.frame_id) == (123, "velodyne")
    assert len(found.points) == 2
    places = in_map(found, R)  # by bearing: from the right
    np.testing.assert_allclose(places[:, :2], [[6.8, -1.95], [7.9, 2.95]], atol=0.12)  # their near sides
    np.testing.assert_allclose(np.hypot(*found.sizes_m[:, :2].T), [0.8, 0.5], atol=0.3)
    assert (places[:, 2] > 0.4).all()
    assert (found.sizes_m[:, 2] > (0.7, 1.0)).all()
    assert (found.points > 60).all()


@pytest.mark.parametrize("ground", [FLAT, RAMP, ((-1e3, 1e3, 0.0, 0.05),)], ids=["flat", "ramp", "slope"])
@pytest.mark.parametrize("noise_m", [0.0, 0.03, 0.08])
def test_ground_alone_is_no_cluster(ground, noise_m):
    for seed, tilt_deg in enumerate((0.0, 7.0, 10.0)):
        cloud, _ = scan(ground=ground, noise_m=noise_m, tilt_deg=tilt_deg, seed=seed)
        assert len(cloud.points_m) > 5000
        assert len(segment(cloud, TO_40_M if ground == RAMP else PARAMS).points) == 0


def test_a_person_on_a_ramp_stands_on_the_ramp():
    cloud, R = scan([Body(20, 1, bottom_m=0.6, top_m=2.35)], RAMP)
    (place,) = in_map(segment(cloud, TO_40_M), R)
    np.testing.assert_allclose(place[:2], [19.9, 1.0], atol=0.1)
    assert 1.1 < place[2] < 1.9


@pytest.mark.parametrize("bearing_deg", [0, 90, 180, 250])
def test_one_person_25_m_away_is_one_cluster_though_rings_are_90_cm_apart(bearing_deg):
    angle = np.radians(bearing_deg)
    cloud, R = scan([Body(25 * np.cos(angle), 25 * np.sin(angle))])
    found = segment(cloud, PARAMS)
    assert len(found.points) == 1
    assert np.linalg.norm(in_map(found, R)[0, :2] - 24.9 * np.array([np.cos(angle), np.sin(angle)])) < 0.15
    assert found.points[0] >= 5  # one ring or two


@pytest.mark.parametrize("apart_m", [0.55, 0.65, 0.8, 1.2])
@pytest.mark.parametrize("noise_m", [0.02, 0.06])
def test_two_people_10_m_ahead_come_apart(apart_m, noise_m):
    """At 0.55 m their fronts are 5 cm apart, a beam and a half."""
    cloud, R = scan([Body(10, apart_m / 2), Body(10, -apart_m / 2)], noise_m=noise_m)
    places = in_map(segment(cloud, PARAMS), R)
    np.testing.assert_allclose(places[:, :2], [[9.88, -apart_m / 2], [9.88, apart_m / 2]], atol=0.07)


def test_three_people_in_a_touching_row_are_three_and_a_bush_as_wide_is_one():
    row, _ = scan([Body(9, y) for y in (-0.5, 0.0, 0.5)])
    bush, _ = scan([Body(9, 0, 0.75, 0.5, top_m=1.6)])
    assert len(segment(row, PARAMS).points) == 3
    assert len(segment(bush, PARAMS).points) == 1
    together = segment(row, PARAMS.model_copy(update={"max_row_m": 0.0}))
    assert len(together.points) == 1
    assert together.sizes_m[0, 1] == pytest.approx(1.5, abs=0.1)


def test_a_tree_is_apart_from_who_stands_under_it():
    tree = [Body(8, 0, 1.5, 1.0, bottom_m=2.6, top_m=6.0)]
    assert len(segment(scan(tree)[0], PARAMS).points) == 0  # nothing stands there
    cloud, R = scan([*tree, Body(8, 0)])
    found = segment(cloud, PARAMS)
    assert len(found.points) == 1
    assert found.sizes_m[0, 2] < 1.8
    assert in_map(found, R)[0, 2] < 1.2


def test_a_pole_shows_as_taller_than_people_are():
    (size,) = segment(scan([Body(12, 2, 0.1, 0.1, top_m=4.5)], tilt_deg=0.0)[0], PARAMS).sizes_m
    assert size[2] > 2.1


def test_walls_are_left_out_and_cars_kept():
    cloud, R = scan([Body(9, 4)], walls=[(15, -10, 10, 4.0), (12, -4, -0.5, 1.5)])
    found = segment(cloud, PARAMS)
    assert len(found.points) == 2
    np.testing.assert_allclose(in_map(found, R)[:, :2], [[12, -2.25], [8.9, 3.95]], atol=0.15)
    assert found.sizes_m[0, 1] == pytest.approx(3.5, abs=0.15)


def test_the_vehicle_itself_is_left_out_and_so_is_what_is_far():
    cloud, _ = scan([Body(1.2, 0.3), Body(30, -3)])
    assert len(segment(cloud, PARAMS.model_copy(update={"max_range_m": 25.0})).points) == 0
    assert len(segment(cloud, PARAMS.model_copy(update={"min_range_m": 0.5})).points) == 2


def test_the_order_of_points_does_not_matter():
    cloud, _ = scan([Body(8, 3), Body(10, -0.3), Body(10, 0.3), Body(20, 6)], walls=[(18, -5, -2, 1.5)], noise_m=0.05)
    expected = segment(cloud, PARAMS)
    assert len(expected.points) == 5
    for seed in range(3):
        shuffled = np.random.default_rng(seed).permutation(cloud.points_m)
        assert_same(segment(cloud_of(shuffled), PARAMS), expected)
    assert_same(segment(cloud_of(cloud.points_m[::-1].astype(float)), PARAMS), expected)


@pytest.mark.parametrize(
    "points",
    [
        np.zeros((0, 3)),
        np.array([[10.0, 0, 0]]),
        np.array([[10.0, 0, 0], [10.0, 0.01, 0], [10.0, 0.02, 0]]),  # too few
        np.full((50, 3), np.nan),
        np.array([[np.inf, 0, 0], [1e200, 0, 0], [0, 0, 0]]),
    ],
)
def test_nothing_to_see_gives_an_empty_scan(points):
    found = segment(cloud_of(points), PARAMS)
    assert found.centroids_m.shape == found.sizes_m.shape == (0, 3)
    assert found.points.shape == (0,)


def test_points_that_are_not_finite_change_nothing():
    cloud, _ = scan([Body(8, 3)])
    spoilt = np.concatenate([cloud.points_m, [[np.nan, 0, 0], [np.inf, 1, 1]]])
    assert_same(segment(cloud_of(spoilt), PARAMS), segment(cloud, PARAMS))


def test_without_ground_in_view_a_person_is_still_a_cluster():
    person = np.random.default_rng(0).uniform([9.9, -0.25, -1.2], [10.0, 0.25, 0.4], (60, 3))
    found = segment(cloud_of(person), PARAMS)
    assert found.points.tolist() == [60]
    np.testing.assert_allclose(found.centroids_m[0], person.mean(axis=0), atol=0.001)
    np.testing.assert_allclose(found.sizes_m[0], np.ptp(person, axis=0), atol=0.001)


@pytest.mark.parametrize("every", [2, 4])
def test_thinned_clouds_still_show_who_is_near(every):
    cloud, R = scan([Body(6, 1), Body(5, -2)])
    found = segment(cloud_of(cloud.points_m[::every]), PARAMS)
    assert len(found.points) == 2
    np.testing.assert_allclose(in_map(found, R)[:, :2], [[4.9, -1.95], [5.9, 1.0]], atol=0.12)


def test_denser_sensors_need_no_other_settings():
    cloud, _ = scan([Body(10, 0.4), Body(10, -0.4), Body(25, 8)], rings=64)
    assert len(cloud.points_m) > 40_000
    assert len(segment(cloud, PARAMS).points) == 3


person = st.tuples(st.floats(3, 30), st.floats(0, 6.28), st.floats(0.1, 0.8), st.floats(0.6, 2.5))


@settings(max_examples=25, deadline=None)
@given(st.lists(person, max_size=6), st.floats(-10, 10), st.integers(0, 5))
def test_laws_of_clusters(people, tilt_deg, seed):
    """Each has its points within its size of its centroid, all numbers are finite, and none has too few points."""
    bodies = [Body(r * np.cos(a), r * np.sin(a), width, 0.6 * width, top_m=top) for r, a, width, top in people]
    cloud, _ = scan(bodies, tilt_deg=tilt_deg, noise_m=0.04, seed=seed)
    found = segment(cloud, PARAMS)
    bearings = np.arctan2(found.centroids_m[:, 1], found.centroids_m[:, 0])
    assert (np.diff(bearings) >= 0).all()
    assert (found.points >= PARAMS.min_points).all()
    for centroid, size, points in zip(found.centroids_m, found.sizes_m, found.points, strict=True):
        assert np.isfinite([*centroid, *size]).all()
        assert (size >= 0).all()
        inside = (np.abs(cloud.points_m - centroid) <= size + 0.001).all(axis=1)
        assert inside.sum() >= points
    if not bodies:
        assert len(found.points) == 0


def test_fusion_makes_people_of_the_clusters_without_any_camera():
    places = [(8.0, 3.0), (12.0, -4.0), (-9.0, 2.0)]
    cloud, R = scan([Body(*place) for place in places])
    map_from_lidar = np.eye(4)
    map_from_lidar[:3, :3], map_from_lidar[2, 3] = R, HEIGHT_M
    frame = SensorFrame(123, segment(cloud, PARAMS), map_from_lidar, np.eye(4), (), "odom")
    measured = fuse(frame, no_predicted_tracks(), FusionParams())
    np.testing.assert_allclose(measured.positions_m, sorted(places), atol=0.12)
    assert (measured.pedestrian_probability > 0.5).all()


def test_every_setting_has_a_default_and_says_what_it_does():
    for name, field in SegmentationParams.model_fields.items():
        assert field.description, name
        assert not field.is_required(), name
    with pytest.raises(ValidationError):
        PARAMS.min_points = 3
    with pytest.raises(ValidationError, match="Extra inputs"):
        SegmentationParams(min_point=3)


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"min_range_m": 70.0}, "max_range_m 50 must be over min_range_m 70"),
        ({"min_height_m": 6.0}, "max_height_m 5 must be over min_height_m 6"),
        ({"min_points": 9, "max_points": 9}, "max_points 9 must be over min_points 9"),
        ({"max_range_m": 300.0}, "less than or equal to 180"),
    ],
)
def test_settings_that_cannot_be_are_refused(changes, problem):
    with pytest.raises(ValidationError, match=problem):
        SegmentationParams(**changes)
