import math

import numpy as np
import pytest

from replay.simulator.rig import campus_rig, planar_pose
from tracking.geometry import apply, inverse, yaw_of


@pytest.mark.parametrize("distance_m", [6.0, 25.0])
def test_every_direction_is_in_some_image_and_the_front_in_one_only_or_two(distance_m):
    rig = campus_rig()
    for bearing in np.radians(np.arange(0, 360, 2)):
        point = np.array([[distance_m * math.cos(bearing), distance_m * math.sin(bearing), 1.0]])
        views = []
        for camera in rig.cameras:
            pixels, valid = camera.model.project(apply(inverse(camera.vehicle_from_camera), point))
            u, v = pixels[0]
            if valid[0] and 0 <= u < 1920 and 0 <= v < 1208:
                views.append(camera.name)
        assert 1 <= len(views) <= 3, (math.degrees(bearing), views)


def test_cameras_look_where_their_names_say():
    rig = campus_rig()
    ahead, left = np.array([[20.0, 0.0, 1.7]]), np.array([[20.0, 3.0, 1.7]])
    front = next(camera for camera in rig.cameras if camera.name == "A0")
    pixels, _ = front.model.project(apply(inverse(front.vehicle_from_camera), np.concatenate([ahead, left])))
    assert pixels[0, 0] == pytest.approx(962.275, abs=1)
    assert pixels[1, 0] < pixels[0, 0]  # to the vehicle's left is to the image's left
    assert pixels[0, 1] < 612.725  # nose down: the horizon is above the middle
    side = next(camera for camera in rig.cameras if camera.name == "B0")
    assert side.vehicle_from_camera[1, 2] > 0.8  # the left side camera's axis points left


def test_lidar_nose_is_7_degrees_down():
    forward = campus_rig().vehicle_from_lidar[:3, :3] @ (1.0, 0.0, 0.0)
    assert math.degrees(math.asin(-forward[2])) == pytest.approx(7.0, abs=0.05)


def test_static_transforms_name_every_sensor_once():
    transforms = campus_rig().static_transforms(5)
    assert len({transform.child_frame_id for transform in transforms}) == 7
    assert {transform.parent_frame_id for transform in transforms} == {"base_link"}


def test_planar_pose_has_the_yaw_it_is_given():
    assert yaw_of(planar_pose(np.array([1.0, 2.0]), 2.5)) == pytest.approx(2.5)
