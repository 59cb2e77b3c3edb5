"""Made-up frame results for the tests of what is drawn: a crowd that walks in gentle arcs around a turning vehicle."""

from collections.abc import Iterator

import numpy as np

from replay.frame_result import FrameResult
from schemas.messages import (
    CameraCalibration,
    CameraDetections,
    GroundTruthFrame,
    LidarClusters,
    Mixture,
    ModalPath,
    Prediction,
    PredictionFrame,
    Track,
    TrackFrame,
    TrackHistory,
    VehicleHistory,
)
from tracking.camera import CameraModel
from tracking.fusion import Measurements
from tracking.geometry import inverse, transform_matrix
from tracking.sensor_frame import CameraFrame, SensorFrame

START_NS = 1_583_114_400_000_000_000
PERIOD_NS = 100_000_000
STEPS, DT_S, COMPONENTS = 12, 0.4, 6
CAMERA_YAWS_RAD = {"A0": 0.0, "A1": 0.95, "A2": -0.95, "A3": np.pi, "B0": 2.05, "B1": -2.05}
OPTICAL_FROM_BODY = np.array([[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]], float)


def walk(start: np.ndarray, heading: np.ndarray, speed: np.ndarray, turn: np.ndarray, t: float) -> np.ndarray:
    """Returns states (A, 4) after t seconds on arcs of constant speed and turn rate."""
    now = heading + turn * t
    safe = np.where(np.abs(turn) < 1e-6, 1e-6, turn)
    x = start[:, 0] + speed / safe * (np.sin(heading + safe * t) - np.sin(heading))
    y = start[:, 1] - speed / safe * (np.cos(heading + safe * t) - np.cos(heading))
    return np.column_stack([x, y, speed * np.cos(now), speed * np.sin(now)])


def yaw_transform(x: float, y: float, z: float, yaw: float) -> np.ndarray:
    return transform_matrix(np.array([x, y, z]), np.array([0, 0, np.sin(yaw / 2), np.cos(yaw / 2)]))


def crowd(
    people: int = 30, frames: int = 1, seed: int = 0, first: int = 60, cameras: bool = True
) -> Iterator[FrameResult]:
    """Yields `frames` results 0.1 s apart with `people` tracks; every seventh coasts, every ninth is a fallback."""
    rng = np.random.default_rng(seed)
    start = rng.uniform(-22, 22, (people, 2))
    near = np.hypot(*start.T) < 5
    start[near] += 6 * np.sign(start[near])
    heading = rng.choice([0.35, 0.35 + np.pi, 1.9, 1.9 + np.pi], people) + rng.normal(0, 0.3, people)
    speed = np.where(rng.random(people) < 0.15, 0.02, rng.normal(1.3, 0.25, people))
    turn = rng.normal(0, 0.04, people)
    spread = rng.uniform(0.15, 0.45, people)
    for index in range(first, first + frames):
        yield frame_at(index, (start, heading, speed, turn, spread), np.random.default_rng(seed + index), cameras)


def frame_at(index: int, motion: tuple[np.ndarray, ...], rng: np.random.Generator, cameras: bool) -> FrameResult:
    start, heading, speed, turn, spread = motion
    people = len(start)
    t, stamp_ns = index * 0.1 - 6.0, START_NS + index * PERIOD_NS
    yaw = 0.3 + 0.05 * t
    map_from_vehicle = yaw_transform(2.0 * t * np.cos(yaw), 2.0 * t * np.sin(yaw), 0.0, yaw)
    map_from_lidar = map_from_vehicle @ yaw_transform(1.2, 0.0, 1.37, 0.0)
    states = walk(start, heading, speed, turn, t)
    seen = np.arange(people) % 7 != 6

    positions = states[seen, :2] + rng.normal(0, 0.06, (int(seen.sum()), 2))
    poles = np.array([[14.0, 9], [14, -9], [-2, 9.5], [-2, -9.5], [-16, 6], [20, 3], [6, 18], [-9, -18]])
    places = np.vstack([positions, poles])
    points_map = np.column_stack([places, np.full(len(places), 0.9), np.ones(len(places))])
    centroids = (points_map @ np.linalg.inv(map_from_lidar).T)[:, :3]
    sizes = np.vstack(
        [rng.uniform([0.3, 0.3, 1.2], [0.6, 0.6, 1.8], (len(positions), 3)), np.full((8, 3), [0.3, 0.3, 2.5])]
    )
    clusters = LidarClusters(stamp_ns, "lidar", centroids, sizes, rng.integers(4, 60, len(places)))

    probability = np.concatenate([rng.uniform(0.75, 0.99, len(positions)), rng.uniform(0.02, 0.3, len(poles))])
    measurements = Measurements(
        positions_m=places,
        covariances_m2=np.broadcast_to(np.eye(2) * 0.01, (len(places), 2, 2)),
        pedestrian_probability=probability,
        cluster_index=np.arange(len(places)),
        gives_birth=np.ones(len(places), bool),
    )
    sensors = SensorFrame(
        stamp_ns, clusters, map_from_lidar, map_from_vehicle,
        tuple(camera_frame(name, map_from_vehicle, states, stamp_ns, rng) for name in CAMERA_YAWS_RAD if cameras),
        "odom",
    )  # fmt: skip

    stamps = stamp_ns - PERIOD_NS * np.arange(35, -1, -1)
    past = np.stack([walk(start, heading, speed, turn, t - 0.1 * k) for k in range(35, -1, -1)])  # (36, A, 4)
    past[..., :2] += rng.normal(0, 0.03, past[..., :2].shape)
    past[-1] = states
    tracks, predictions = [], []
    for i in range(people):
        history = TrackHistory(stamps, past[:, i], np.zeros(36, bool))
        covariance = np.diag([0.02, 0.02, 0.05, 0.05])
        tracks.append(Track(i + 1, states[i], covariance, 0.97, 3_500_000_000, not seen[i], history))
        predictions.append(predict(i + 1, states[i], float(spread[i]), i % 9 == 8, rng))
    vehicle = walk(np.zeros((1, 2)), np.array([yaw]), np.array([2.0]), np.array([0.05]), 0.0)[0]
    states_vehicle = np.tile([*map_from_vehicle[:2, 3], yaw, *vehicle[2:]], (36, 1))
    track_frame = TrackFrame(index, stamp_ns, "odom", VehicleHistory(stamps, states_vehicle), tuple(tracks))
    prediction_frame = PredictionFrame(index, stamp_ns, "odom", "made up", DT_S, tuple(predictions))
    truth = GroundTruthFrame(
        stamp_ns, "odom", np.arange(people), states[:, :2] + rng.normal(0, 0.08, (people, 2)), states[:, 2:],
        np.full(people, 20),
    )  # fmt: skip
    return FrameResult(stamp_ns + 90_000_000, sensors, measurements, track_frame, prediction_frame, {}, truth)


def predict(track_id: int, state: np.ndarray, spread: float, fallback: bool, rng: np.random.Generator) -> Prediction:
    """Returns up to three arcs that share a trunk, with a mixture of six components around them."""
    speed, heading = float(np.hypot(*state[2:])), float(np.arctan2(state[3], state[2]))
    count = 1 if fallback or speed < 0.1 else int(rng.choice([1, 2, 2, 3]))
    shares = np.array([[1.0], [0.68, 0.32], [0.55, 0.28, 0.17]][count - 1] if count > 1 else [1.0])
    bends = np.array([0.0, 1.0, -1.0])[:count] * spread
    time = np.arange(1, STEPS + 1) * DT_S
    angles = heading + np.outer(bends, np.clip(time - 0.8, 0, None))  # (paths, P)
    velocity = speed * np.stack([np.cos(angles), np.sin(angles)], -1)
    points = state[:2] + np.cumsum(velocity * DT_S, axis=1)  # (paths, P, 2)
    owner = np.arange(COMPONENTS) % count
    means = points[owner].transpose(1, 0, 2) + rng.normal(0, 0.05, (STEPS, COMPONENTS, 2)) * time[:, None, None]
    weights = np.tile(shares[owner] / np.bincount(owner)[owner], (STEPS, 1))
    sigmas = np.broadcast_to((0.06 + 0.10 * time)[:, None, None] * [1.0, 0.8], (STEPS, COMPONENTS, 2))
    mixture = Mixture(weights, means, np.array(sigmas), np.full((STEPS, COMPONENTS), 0.3))
    paths = tuple(ModalPath(float(share), path) for share, path in zip(shares, points, strict=True))
    return Prediction(track_id, fallback, paths, mixture)


def camera_model() -> CameraModel:
    intrinsics = np.array([[1176.93, 0, 962.275], [0, 1177.72, 612.725], [0, 0, 1]])
    distortion = np.array([-0.0540096, -0.0784275, 0.0959641, -0.0515253])
    return CameraModel.from_calibration(
        CameraCalibration(START_NS, "camera", 1920, 1208, "equidistant", distortion, intrinsics)
    )


def camera_frame(
    name: str, map_from_vehicle: np.ndarray, states: np.ndarray, stamp_ns: int, rng: np.random.Generator
) -> CameraFrame:
    """Returns a camera on the roof that sees everybody within 25 m, with a box around each."""
    model, yaw = camera_model(), CAMERA_YAWS_RAD[name]
    vehicle_from_body = yaw_transform(0.8 * np.cos(yaw), 0.5 * np.sin(yaw), 1.7, yaw)
    camera_from_map = OPTICAL_FROM_BODY @ inverse(map_from_vehicle @ vehicle_from_body)
    boxes = []
    for state in states:
        angles = np.linspace(0, 2 * np.pi, 12, endpoint=False)
        ring = state[:2] + 0.25 * np.column_stack([np.cos(angles), np.sin(angles)])
        body = np.vstack([np.column_stack([ring, np.full(12, z), np.ones(12)]) for z in (0.0, 1.75)])
        pixels, valid = model.project((body @ camera_from_map.T)[:, :3])
        if valid.all() and np.hypot(*(state[:2] - map_from_vehicle[:2, 3])) < 25:
            low, high = pixels.min(axis=0), pixels.max(axis=0)
            if high[0] > 0 and low[0] < model.width_px and high[1] > 0 and low[1] < model.height_px:
                boxes.append(np.clip(np.concatenate([low, high]) + rng.normal(0, 3, 4), 0, [1920, 1208, 1920, 1208]))
    boxes_px = np.array(boxes).reshape(-1, 4)
    detections = CameraDetections(
        stamp_ns, name, boxes_px, rng.uniform(0.4, 0.98, len(boxes)), ("person",) * len(boxes)
    )
    return CameraFrame(name, detections, model, camera_from_map)
