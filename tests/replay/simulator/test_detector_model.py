import numpy as np
import pytest

from replay.simulator.detector_model import SimulatedDetector, silhouette_points
from replay.simulator.rig import campus_rig, planar_pose
from replay.simulator.sensor_model import SensorModelV1
from replay.simulator.visibility import ObjectTable
from tracking.geometry import apply, inverse

MODEL = SensorModelV1(false_boxes_per_image=0.0)
FRONT = next(camera for camera in campus_rig().cameras if camera.name == "A0")


def images(scene_at, count=200, model=MODEL, camera=FRONT):
    """Detections in images 0.7 s apart, so that misses are nearly independent."""
    detector = SimulatedDetector(camera, model, np.random.default_rng(0))
    table = ObjectTable(model, 0)
    scenes = [scene_at(0.7 * k) for k in range(count)]
    return detector.detect(scenes, [table.objects(scene) for scene in scenes], list(range(1, count + 1)))


@pytest.mark.parametrize("person", [(12.0, 0.0), (8.0, 5.0), (25.0, -10.0)])
def test_boxes_are_where_the_fisheye_projection_says(make_scene, person):
    place, yaw = (3.0, -2.0), 0.7
    person = np.array(person) @ np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]]) + place
    found = images(lambda t: make_scene([person], time_s=t, position=place, yaw=yaw))
    boxes = np.concatenate([d.boxes_px for d in found])
    camera_from_map = inverse(planar_pose(np.array(place), yaw) @ FRONT.vehicle_from_camera)
    line = np.array([[*person, z] for z in (0.0, 0.875, 1.75)])
    (foot, middle, head), valid = FRONT.model.project(apply(camera_from_map, line))
    assert valid.all()
    height = foot[1] - head[1]
    mean = boxes.mean(axis=0)
    assert mean[1] == pytest.approx(head[1], abs=0.08 * height + 2)
    assert mean[3] == pytest.approx(foot[1], abs=0.08 * height + 2)
    assert (mean[0] + mean[2]) / 2 == pytest.approx(middle[0], abs=0.06 * height + 3)
    assert 0.2 < (mean[2] - mean[0]) / height < 0.45
    assert boxes.std(axis=0).max() < 0.04 * height + 2
    assert len(boxes) > 0.9 * len(found)


def test_hidden_and_far_people_are_missed(make_scene):
    hidden = images(lambda t: make_scene([[20, 0], [8, 0]], time_s=t))
    assert max(len(d.scores) for d in hidden) == 1
    near = np.mean([len(d.scores) for d in images(lambda t: make_scene([[15, 0]], time_s=t))])
    far = np.mean([len(d.scores) for d in images(lambda t: make_scene([[57, 0]], time_s=t))])
    assert near > 0.93
    assert far < 0.6
    assert all(len(d.scores) == 0 for d in images(lambda t: make_scene([[65, 0], [-10, 0]], time_s=t), 20))


def test_who_is_half_hidden_has_a_narrower_box(make_scene):
    whole = images(lambda t: make_scene([[12, 0]], time_s=t))
    half = images(lambda t: make_scene([[12, 0], [6, -0.28]], time_s=t))  # the right part of the farther one is covered
    widths = [(d.boxes_px[:, 2] - d.boxes_px[:, 0]).mean() for d in whole if len(d.scores)]
    covered = []
    for d in half:
        heights = d.boxes_px[:, 3] - d.boxes_px[:, 1]
        covered += (d.boxes_px[:, 2] - d.boxes_px[:, 0])[heights < 230].tolist()
    assert len(covered) > 20
    assert np.mean(covered) < 0.85 * np.mean(widths)


def test_boxes_are_cut_at_the_border_and_in_order(make_scene):
    places = [[3, 2.2], [9, 8], [4, -2.5], [15, 3], [20, -6]]
    for found in images(lambda t: make_scene(places, time_s=t), 50):
        assert (found.boxes_px >= 0).all()
        assert (found.boxes_px <= (1920, 1208, 1920, 1208)).all()
        assert (found.boxes_px[:, 2:] - found.boxes_px[:, :2] >= MODEL.min_box_px).all()
        assert (np.diff(found.scores) <= 0).all()
        assert ((found.scores >= 0.3) & (found.scores < 1)).all()


def test_misses_come_in_bursts(make_scene):
    """At 30 Hz the next image is missed far more often after a miss than overall."""
    detector, table = SimulatedDetector(FRONT, MODEL, np.random.default_rng(1)), ObjectTable(MODEL, 0)
    scenes = [make_scene([[50, 0]], time_s=k / 30) for k in range(2500)]
    found = detector.detect(scenes, [table.objects(s) for s in scenes], list(range(1, 2501)))
    missed = np.array([len(d.scores) == 0 for d in found])
    assert 0.05 < missed.mean() < 0.7
    assert missed[1:][missed[:-1]].mean() > missed.mean() + 0.2


def test_blocks_and_single_images_agree_on_what_is_certain(make_scene):
    scenes = [make_scene([[10, 1], [14, -4]], time_s=0.7 * k) for k in range(30)]
    table = ObjectTable(MODEL, 0)
    objects = [table.objects(scene) for scene in scenes]
    block = SimulatedDetector(FRONT, MODEL, np.random.default_rng(2)).detect(scenes, objects, list(range(1, 31)))
    one = SimulatedDetector(FRONT, MODEL, np.random.default_rng(3))
    single = [one.detect([s], [o], [k + 1])[0] for k, (s, o) in enumerate(zip(scenes, objects, strict=True))]
    assert [d.stamp_ns for d in block] == [d.stamp_ns for d in single]
    for a, b in ((block, single),):
        first = np.mean(np.concatenate([np.sort(d.boxes_px[:, 0]) for d in a if len(d.scores) == 2]).reshape(-1, 2), 0)
        second = np.mean(np.concatenate([np.sort(d.boxes_px[:, 0]) for d in b if len(d.scores) == 2]).reshape(-1, 2), 0)
        np.testing.assert_allclose(first, second, atol=4)


def test_vehicles_are_cars_and_poles_are_seldom_people(make_scene):
    cars = images(lambda t: make_scene(others=[[15, 2, 0.4]], time_s=t), 50)
    assert {label for d in cars for label in d.labels} == {"car"}
    widths = [d.boxes_px[0, 2] - d.boxes_px[0, 0] for d in cars if len(d.scores)]
    assert 150 < np.mean(widths) < 300  # 2.5 m across, 14 m away
    poles = images(lambda t: make_scene(fixtures=[[12, 2, 0.2, 4.0]], time_s=t), 1500)
    assert 0.005 < np.mean([len(d.scores) for d in poles]) < 0.1
    assert {label for d in poles for label in d.labels} == {"person"}


def test_false_boxes_come_at_their_rate(make_scene):
    model = SensorModelV1()
    found = images(lambda t: make_scene(time_s=t), 3000, model)
    assert np.mean([len(d.scores) for d in found]) == pytest.approx(model.false_boxes_per_image, rel=0.3)


def test_silhouette_stands_on_the_ground():
    points = silhouette_points(np.array([[3.0, 4.0]]), np.array([0.25]), np.array([1.8]))
    assert points.shape == (1, 32, 3)
    assert points[..., 2].min() == 0
    assert points[..., 2].max() == 1.8
    np.testing.assert_allclose(np.linalg.norm(points[0, :, :2] - (3.0, 4.0), axis=1), 0.25)
