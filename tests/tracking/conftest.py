"""Builders of mixtures, of calibrated cameras, and of sensor frames with people rendered into them."""

from dataclasses import dataclass

import numpy as np
import pytest

from schemas.messages import CameraCalibration, CameraDetections, LidarClusters
from tracking.camera import CameraModel
from tracking.geometry import apply, inverse, transform_matrix
from tracking.mixture_reduction import GaussianMixture
from tracking.sensor_frame import CameraFrame, SensorFrame

LIDAR_HEIGHT_M = 1.37
START_NS = 1_000_000_000_000


def random_mixture(seed=0, J=12, L=4):
    """A random mixture whose covariances are symmetric and positive definite."""
    generator = np.random.default_rng(seed)
    roots = generator.normal(size=(J, 4, 4))
    covs = roots @ roots.swapaxes(1, 2) + 0.1 * np.eye(4)
    return GaussianMixture(
        generator.uniform(0.01, 1, J), generator.normal(0, 3, (J, 4)), covs, generator.integers(0, L, J)
    )


@dataclass(frozen=True)
class World:
    """A vehicle with a LiDAR and cameras all round; renders upright people into a SensorFrame."""

    cameras: tuple[tuple[str, CameraModel, np.ndarray], ...]  # name, model, vehicle_from_camera

    def frame(
        self,
        people_m,
        stamp_ns=START_NS,
        *,
        poles_m=(),
        velocities_mps=None,
        with_cameras=True,
        boxes_for=None,
        camera_delay_ns=0,
        map_from_vehicle=None,
        bias_m=0.12,
        seed=None,
    ):
        """People at (A, 2) and poles at (B, 2) in the map frame give one cluster each; people also get boxes."""
        people = np.asarray(people_m, float).reshape(-1, 2)
        poles = np.asarray(poles_m, float).reshape(-1, 2)
        velocities = np.zeros_like(people) if velocities_mps is None else np.asarray(velocities_mps, float)
        pose = np.eye(4) if map_from_vehicle is None else map_from_vehicle
        map_from_lidar = pose @ transform_matrix([0, 0, LIDAR_HEIGHT_M], [0, 0, 0, 1])
        places = np.concatenate([people, poles])
        sight = places - map_from_lidar[:2, 3]
        sight /= np.maximum(np.linalg.norm(sight, axis=1, keepdims=True), 1e-9)
        noise = np.zeros_like(places) if seed is None else np.random.default_rng(seed).normal(0, 0.05, places.shape)
        centroids = np.column_stack([places - bias_m * sight + noise, np.full(len(places), 0.95)])
        sizes = np.concatenate(
            [np.tile([0.35, 0.45, 1.6], (len(people), 1)), np.tile([0.3, 0.3, 1.7], (len(poles), 1))]
        )
        clusters = LidarClusters(
            stamp_ns, "lidar", apply(inverse(map_from_lidar), centroids), sizes, np.full(len(places), 40)
        )
        frames = []
        for name, model, vehicle_from_camera in self.cameras if with_cameras else ():
            camera_from_map = inverse(pose @ vehicle_from_camera)
            shown = people if boxes_for is None else people[list(boxes_for)]
            moved = shown + (velocities if boxes_for is None else velocities[list(boxes_for)]) * camera_delay_ns * 1e-9
            boxes = [box for box in (render_box(model, camera_from_map, p) for p in moved) if box is not None]
            detections = CameraDetections(
                stamp_ns + camera_delay_ns,
                f"camera_{name}",
                np.array(boxes).reshape(-1, 4),
                np.full(len(boxes), 0.9),
                ("person",) * len(boxes),
            )
            frames.append(CameraFrame(name, detections, model, camera_from_map))
        return SensorFrame(stamp_ns, clusters, map_from_lidar, pose, tuple(frames), "odom")


def render_box(model, camera_from_map, place_m, radius_m=0.25, height_m=1.75):
    """Returns the box in the image of an upright person, from many points on its surface; None out of view."""
    angle, z = np.meshgrid(np.linspace(0, 2 * np.pi, 24), np.linspace(0, height_m, 12))
    x, y = place_m[0] + radius_m * np.cos(angle), place_m[1] + radius_m * np.sin(angle)
    pixels, valid = model.project(apply(camera_from_map, np.stack([x, y, z], axis=-1).reshape(-1, 3)))
    if valid.sum() < valid.size:
        return None
    size = np.array([model.width_px, model.height_px])
    low, high = np.clip(pixels.min(axis=0), 0, size), np.clip(pixels.max(axis=0), 0, size)
    if ((high - low) < 5).any():
        return None
    return [*low, *high]


def world_all_round(count=6):
    """Fisheye cameras evenly all round the roof, 1.7 m up."""
    K = np.array([[1176.93, 0, 962.275], [0, 1177.72, 612.725], [0, 0, 1]])
    D = np.array([-0.0540096, -0.0784275, 0.0959641, -0.0515253])
    model = CameraModel.from_calibration(CameraCalibration(1, "camera", 1920, 1208, "equidistant", D, K))
    body_from_optical = np.eye(4)
    body_from_optical[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    cameras = []
    for i in range(count):
        yaw = 2 * np.pi * i / count
        turn = transform_matrix([0.3 * np.cos(yaw), 0.3 * np.sin(yaw), 1.7], [0, 0, np.sin(yaw / 2), np.cos(yaw / 2)])
        cameras.append((f"C{i}", model, turn @ body_from_optical))
    return World(tuple(cameras))


@pytest.fixture(scope="session")
def world():
    return world_all_round()


@pytest.fixture(scope="session")
def make_mixture():
    return random_mixture
