"""Fusion on frames with rendered people: positions, matches, class evidence, refusal, independence of order."""

from dataclasses import replace

import numpy as np
import pytest

from schemas.messages import CameraDetections, LidarClusters
from tracking.camera import CameraModel
from tracking.fusion import FusionParams, explain, fuse
from tracking.geometry import inverse, transform_matrix
from tracking.measurements import PredictedTracks, no_predicted_tracks
from tracking.sensor_frame import CameraFrame, SensorFrame

PARAMS = FusionParams()
NOBODY = no_predicted_tracks()


def at(measurements, place):
    """The row of the measurement nearest a place."""
    return int(np.hypot(*(measurements.positions_m - place).T).argmin())


def test_positions_are_where_people_stand(world):
    """The bias towards the sensor is taken off along the line of sight, all round and at any range."""
    angle = np.linspace(0, 2 * np.pi, 9)[:-1]
    people = np.stack([np.cos(angle), np.sin(angle)], axis=1) * np.linspace(3, 30, 8)[:, None]
    scan = fuse(world.frame(people), NOBODY, PARAMS)
    assert len(scan) == 8
    order = scan.cluster_index
    np.testing.assert_allclose(scan.positions_m, people[order], atol=1e-6)


def test_people_get_their_boxes_and_are_likely_people(world):
    people = np.array([[8.0, 1], [6, -4], [-7, 2], [0, 9], [12, 5]])
    scan = fuse(world.frame(people), NOBODY, PARAMS)
    assert all(scan.evidence)
    assert (scan.pedestrian_probability > 0.9).all()
    for row, boxes in enumerate(scan.evidence):
        for evidence in boxes:
            assert evidence.score == pytest.approx(0.9)
            assert evidence.camera.startswith("C"), row


def test_evidence_names_the_right_box(world):
    frame = world.frame([[8.0, 1], [6, -4]])
    for place, only in ([8.0, 1], 0), ([6.0, -4], 1):
        alone = world.frame([[8.0, 1], [6, -4]], boxes_for=[only])
        scan = fuse(frame, NOBODY, PARAMS)
        for evidence in scan.evidence[at(scan, place)]:
            camera = next(c for c in frame.cameras if c.name == evidence.camera)
            single = next(c for c in alone.cameras if c.name == evidence.camera)
            np.testing.assert_allclose(camera.detections.boxes_px[evidence.box], single.detections.boxes_px[0])


def test_a_person_in_two_views_is_one_measurement_with_more_evidence(world):
    """At 30 degrees two neighbouring cameras see it; at 0 only one does."""
    places = np.array([[8 * np.cos(np.pi / 6), 8 * np.sin(np.pi / 6)], [8.0, 0.0]])
    scan = fuse(world.frame(places), NOBODY, PARAMS)
    assert len(scan) == 2
    assert len(scan.evidence[at(scan, places[0])]) == 2
    assert len(scan.evidence[at(scan, places[1])]) == 1


def test_what_cameras_see_without_a_box_is_no_person(world):
    scan = fuse(world.frame([[8, 1]], poles_m=[[7, -3], [-6, -2]]), NOBODY, PARAMS)
    person, poles = at(scan, [8, 1]), [at(scan, [7, -3]), at(scan, [-6, -2])]
    assert scan.pedestrian_probability[person] > 0.9
    assert (scan.pedestrian_probability[poles] < 0.35).all()
    assert all(scan.evidence[row] == () for row in poles)


def test_without_cameras_size_alone_speaks(world):
    scan = fuse(world.frame([[8, 1]], with_cameras=False), NOBODY, PARAMS)
    assert 0.5 <= scan.pedestrian_probability[0] < 0.7
    assert scan.evidence == ((),)


@pytest.mark.parametrize("size", [[4.5, 1.8, 1.5], [0.4, 0.4, 3.5], [8.0, 0.2, 2.5]])
def test_cars_walls_and_lamp_posts_are_no_people(world, size):
    frame = world.frame([[8, 1]], with_cameras=False)
    frame = replace(frame, clusters=replace(frame.clusters, sizes_m=np.array([size])))
    assert fuse(frame, NOBODY, PARAMS).pedestrian_probability[0] < 0.2


def test_out_of_view_is_no_evidence(world):
    """With the one camera looking ahead, a person behind is as likely as without cameras."""
    frame = world.frame([[-8.0, 0]])
    ahead = replace(frame, cameras=frame.cameras[:1])
    none = replace(frame, cameras=())
    np.testing.assert_array_equal(
        fuse(ahead, NOBODY, PARAMS).pedestrian_probability, fuse(none, NOBODY, PARAMS).pedestrian_probability
    )


def test_a_hidden_person_without_a_box_is_not_ruled_out(world):
    hidden = fuse(world.frame([[6, 0], [11, 0]], boxes_for=[0]), NOBODY, PARAMS)
    plain = fuse(world.frame([[6, 0], [11, 4]], boxes_for=[0]), NOBODY, PARAMS)
    assert hidden.pedestrian_probability[at(hidden, [11, 0])] > 0.5
    assert plain.pedestrian_probability[at(plain, [11, 4])] < 0.35


def test_the_nearer_of_two_in_line_gets_the_nearer_ones_box(world):
    """Both boxes overlap both people sideways; apparent height tells them apart."""
    frame = world.frame([[5.0, 0], [11, 0.2]])
    scan = fuse(frame, NOBODY, PARAMS)
    for place in [5.0, 0], [11, 0.2]:
        (evidence,) = scan.evidence[at(scan, place)]
        box = next(c for c in frame.cameras if c.name == evidence.camera).detections.boxes_px[evidence.box]
        height = box[3] - box[1]
        assert (height > 250) == (place[0] == 5.0)


def test_a_box_of_the_wrong_height_is_no_match(world):
    """A far person's box over a near pole."""
    frame = world.frame([[20.0, 0]], poles_m=[[5, 0.0]])
    frame = replace(frame, clusters=replace(
        frame.clusters, centroids_m=frame.clusters.centroids_m[1:], sizes_m=frame.clusters.sizes_m[1:],
        points=frame.clusters.points[1:],
    ))  # fmt: skip
    scan = fuse(frame, NOBODY, PARAMS.model_copy(update={"camera_only": False}))
    assert scan.evidence == ((),)
    assert scan.pedestrian_probability[0] < 0.35


def test_other_labels_are_not_pedestrians(world):
    frame = world.frame([[8.0, 0]])
    cars = tuple(
        replace(c, detections=replace(c.detections, labels=("car",) * len(c.detections.labels))) for c in frame.cameras
    )
    scan = fuse(replace(frame, cameras=cars), NOBODY, PARAMS)
    assert scan.evidence == ((),)
    assert scan.pedestrian_probability[0] < 0.35


def test_clusters_move_to_the_cameras_stamp_with_their_tracks(world):
    """A runner 4 m away crosses 0.45 m of view in 50 ms at 9 m/s: matched only if its track's velocity goes along."""
    velocity = np.array([[0.0, 9.0]])
    frame = world.frame([[4.0, 0]], velocities_mps=velocity, camera_delay_ns=50_000_000)
    strict = FusionParams(min_overlap=0.6, grown_box=1.0, radius_m=0.25)
    track = PredictedTracks(np.array([[4.0, 0.05]]), velocity, np.eye(2)[None] * 0.01)
    follow, stay = fuse(frame, track, strict), fuse(frame, NOBODY, strict)
    overlap = [scan.pedestrian_probability[0] for scan in (follow, stay)]
    assert len(follow.evidence[0]) > 0
    assert overlap[0] > overlap[1] or len(stay.evidence[0]) == 0


def test_rotating_the_scene_rotates_the_measurements(world):
    """With the vehicle and everyone turned and moved together, so are positions and covariances."""
    people = np.array([[8.0, 1], [6, -4], [-7, 2]])
    yaw = 0.7
    R = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    pose = transform_matrix([30, -20, 2.0], [0, 0, np.sin(yaw / 2), np.cos(yaw / 2)])
    a = fuse(world.frame(people), NOBODY, PARAMS)
    frame = world.frame(people @ R.T + [30, -20], map_from_vehicle=pose, with_cameras=False)
    b = fuse(frame, NOBODY, PARAMS)
    rows = np.argsort(b.cluster_index)[np.argsort(np.argsort(a.cluster_index))]
    rows = np.array([int(np.flatnonzero(b.cluster_index == i)[0]) for i in a.cluster_index])
    np.testing.assert_allclose(b.positions_m[rows], a.positions_m @ R.T + [30, -20], atol=1e-9)
    np.testing.assert_allclose(b.covariances_m2[rows], R @ a.covariances_m2 @ R.T, atol=1e-12)


def test_covariance_is_long_across_the_line_of_sight_far_away(world):
    scan = fuse(world.frame([[50.0, 0]]), NOBODY, PARAMS)
    cov = scan.covariances_m2[0]
    assert cov[1, 1] > 2 * cov[0, 0]
    assert abs(cov[0, 1]) < 1e-9


def test_few_points_and_an_extrapolated_pose_widen_the_covariance(world):
    frame = world.frame([[10.0, 0]])
    few = replace(frame, clusters=replace(frame.clusters, points=np.array([3])))
    extrapolated = replace(frame, pose_extrapolated=True)
    plain = np.trace(fuse(frame, NOBODY, PARAMS).covariances_m2[0])
    assert np.trace(fuse(few, NOBODY, PARAMS).covariances_m2[0]) > plain
    assert np.trace(fuse(extrapolated, NOBODY, PARAMS).covariances_m2[0]) > plain


def test_clusters_that_are_not_numbers_are_refused_and_counted(world):
    frame = world.frame([[8, 1], [6, -4], [5, 5], [4, 4]])
    centroids, sizes = frame.clusters.centroids_m.copy(), frame.clusters.sizes_m.copy()
    centroids[0, 2], sizes[1, 0], sizes[3, 1] = np.nan, np.inf, -1
    bad = replace(frame, clusters=replace(frame.clusters, centroids_m=centroids, sizes_m=sizes))
    scan = fuse(bad, NOBODY, PARAMS)
    assert scan.cluster_index[scan.cluster_index >= 0].tolist() == [2]
    assert scan.refused == 3
    assert scan.refused_cluster_index.tolist() == [0, 1, 3]


def test_boxes_that_are_not_boxes_are_passed_over(world):
    frame = world.frame([[8.0, 0]])
    cameras = []
    for camera in frame.cameras:
        d = camera.detections
        boxes = np.concatenate([[[np.nan, 0, 1, 1], [5, 5, 5, 9], [9, 9, 1, 1], [0, 0, np.inf, 9]], d.boxes_px])
        labels, scores = ("person",) * len(boxes), np.full(len(boxes), 0.9)
        cameras.append(replace(camera, detections=replace(d, boxes_px=boxes, labels=labels, scores=scores)))
    scan = fuse(replace(frame, cameras=tuple(cameras)), NOBODY, PARAMS)
    assert [evidence.box for evidence in scan.evidence[0]] == [4]


def test_empty_scans(world):
    assert len(fuse(world.frame([]), NOBODY, PARAMS)) == 0
    frame = world.frame([])
    nothing = LidarClusters(1, "lidar", np.full((2, 3), np.nan), np.ones((2, 3)), np.ones(2, np.int64))
    scan = fuse(replace(frame, clusters=nothing), NOBODY, PARAMS)
    assert (len(scan), scan.refused) == (0, 2)


def shuffled(frame: SensorFrame, seed: int) -> SensorFrame:
    generator = np.random.default_rng(seed)
    c = frame.clusters
    order = generator.permutation(len(c.points))
    clusters = replace(c, centroids_m=c.centroids_m[order], sizes_m=c.sizes_m[order], points=c.points[order])
    cameras = []
    for row in generator.permutation(len(frame.cameras)):
        d = frame.cameras[row].detections
        boxes = generator.permutation(len(d.boxes_px))
        labels = tuple(d.labels[i] for i in boxes)
        cameras.append(
            replace(
                frame.cameras[row],
                detections=replace(d, boxes_px=d.boxes_px[boxes], scores=d.scores[boxes], labels=labels),
            )
        )
    return replace(frame, clusters=clusters, cameras=tuple(cameras))


def test_no_order_matters(world):
    """Clusters, cameras and boxes in any order give the same bits."""
    generator = np.random.default_rng(2)
    frame = world.frame(generator.uniform(-15, 15, (20, 2)), poles_m=generator.uniform(-15, 15, (10, 2)), seed=3)
    a = fuse(frame, NOBODY, PARAMS)
    for seed in range(5):
        b = fuse(shuffled(frame, seed), NOBODY, PARAMS)
        for name in "positions_m", "covariances_m2", "pedestrian_probability":
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


def test_two_camera_models_in_one_frame(world):
    """A pinhole camera among the fisheyes sees the same people."""
    frame = world.frame([[8.0, 0.5]])
    front = frame.cameras[0]
    pinhole = CameraModel(1920, 1208, 1000, 1000, 960, 604, "plumb_bob", np.array([-0.05, 0.01, 0, 0]))
    from_map = front.camera_from_map
    corners = np.array([[8, y, z] for y in (0.25, 0.75) for z in (0.0, 1.75)])
    pixels, _ = pinhole.project(corners @ from_map[:3, :3].T + from_map[:3, 3])
    box = np.array([[*pixels.min(axis=0), *pixels.max(axis=0)]])
    detections = CameraDetections(frame.stamp_ns, "p", box, np.array([0.8]), ("person",))
    more = (*frame.cameras, CameraFrame("P", detections, pinhole, from_map))
    scan = fuse(replace(frame, cameras=more), NOBODY, PARAMS)
    assert {evidence.camera for evidence in scan.evidence[0]} == {"C0", "P"}


def test_on_a_slope(world):
    """The vehicle climbs 8 degrees and so does the ground: people still match their boxes."""
    pose = transform_matrix([5, 5, 1], [0, -np.sin(0.07), 0, np.cos(0.07)])
    people = np.array([[15.0, 6.0], [3.0, 12.0]])
    # Rendered on flat ground at z = 0, the pose tilts only the sensors: clusters contradict the vehicle's plane.
    scan = fuse(world.frame(people, map_from_vehicle=pose), NOBODY, PARAMS)
    assert all(scan.evidence)


def test_explain_tells_what_fuse_matched(world):
    frame = world.frame([[5.0, 0], [11, 0.2], [8, 5.5], [-7, 2], [6, 5.7]], seed=2)
    scan, candidates = fuse(frame, NOBODY, PARAMS), explain(frame, NOBODY, PARAMS)
    matched = {(c.camera, c.box, c.cluster) for c in candidates if c.matched}
    evidence = {
        (e.camera, e.box, int(cluster))
        for cluster, boxes in zip(scan.cluster_index, scan.evidence, strict=True)
        for e in boxes
        if cluster >= 0
    }
    assert matched == evidence != set()
    assert all(c.likeness > 0 for c in candidates if c.matched)
    assert any(not c.matched for c in candidates)


def test_explain_tells_which_gate_refused_a_box(world):
    """A far person's box over a near pole: too small for it."""
    frame = world.frame([[20.0, 0]], poles_m=[[5, 0.0]])
    (far,) = (c for c in explain(frame, NOBODY, PARAMS) if c.cluster == 0)
    (near,) = (c for c in explain(frame, NOBODY, PARAMS) if c.cluster == 1)
    assert far.matched
    assert near.likeness == 0
    assert not near.matched
    assert near.height_log_ratio < -PARAMS.max_height_log_ratio


def test_a_half_hidden_person_without_a_box_is_ruled_out_less_than_one_in_plain_view(world):
    """Somebody stands half behind another, as seen from the vehicle."""
    plain, hidden = (
        fuse(world.frame([[6.0, 0], [9.0, y]], boxes_for=[0]), NOBODY, PARAMS).pedestrian_probability
        for y in (3.0, 0.35)
    )
    assert hidden[1] > plain[1] + 0.1


def test_a_small_person_without_a_box_is_ruled_out_less_than_a_tall_one(world):
    """The same bearing, 15 and 55 m away: 140 and 38 pixels tall."""
    near, far = (
        fuse(world.frame([[x, 0.0]], boxes_for=[]), NOBODY, PARAMS).pedestrian_probability[0] for x in (15.0, 55.0)
    )
    assert far > near + 0.05


def test_a_kerb_hides_nobody_from_a_camera(world):
    """What is low in front of somebody without a box hides no box."""
    frame = world.frame([[5.0, 0], [11.0, 0]], boxes_for=[])
    low, tall = (
        fuse(
            replace(frame, clusters=replace(frame.clusters, sizes_m=np.array([[0.4, 0.5, height], [0.35, 0.45, 1.6]]))),
            NOBODY,
            PARAMS,
        ).pedestrian_probability
        for height in (0.15, 1.6)
    )
    assert low[1] < 0.45
    assert tall[1] > 0.55


def test_settings_that_would_turn_the_evidence_round_are_refused():
    with pytest.raises(ValueError, match="full_height_px 25 must be over min_height_px 45"):
        FusionParams(min_height_px=45.0, full_height_px=25.0)


def test_ground_is_where_the_vehicle_stands_at_any_altitude(world):
    """The same scene on a slope of 5 degrees, at sea level and 300 m above it."""
    pitch = np.radians(5) / 2
    found = []
    for altitude in (0.0, 300.0):
        pose = transform_matrix([0, 0, altitude], [0, np.sin(pitch), 0, np.cos(pitch)])
        frame = world.frame([[9.0, 1.0], [7.0, -3.0]])
        moved = replace(
            frame,
            map_from_vehicle=pose,
            map_from_lidar=pose @ frame.map_from_lidar,
            cameras=tuple(replace(c, camera_from_map=c.camera_from_map @ inverse(pose)) for c in frame.cameras),
        )
        found.append(fuse(moved, NOBODY, PARAMS))
    assert all(found[0].evidence)
    assert found[0].evidence == found[1].evidence
    np.testing.assert_allclose(found[0].pedestrian_probability, found[1].pedestrian_probability, atol=1e-9)
