"""One frame result as rows of rerun entities. Everything under `map/` is in the odometry frame, less an origin; metres.

map/vehicle            pose, with the body below it      map/predictions/paths     modal paths, opaque if likely
map/clusters           LiDAR clusters as boxes           map/predictions/mixture   one-sigma ellipses
map/measurements       fused, by pedestrian probability  map/predictions/fallback  extrapolations, dashed
map/tracks/seen        people, with their ids            map/tracks/coasting       people without a measurement
map/tracks/tails       where they were                   map/ground_truth          where people really were
cameras/NAME/...       detections and people             counts/...                time series
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import rerun as rr

from replay import colours
from replay.drawing import (
    PERSON_HEIGHT_M,
    PERSON_RADIUS_M,
    VEHICLE_CENTRE_M,
    VEHICLE_HEIGHT_M,
    VEHICLE_LENGTH_M,
    VEHICLE_WIDTH_M,
    dashes,
    drawn_steps,
    mixture_ellipses,
    modal_paths,
    people_in_image,
    split_by_fallback,
    vehicle_outline,
)
from replay.frame_result import FrameResult
from replay.rerun_columns import RerunColumns, Strips
from schemas.messages import FloatArray, IntArray, Track
from tracking.geometry import quaternion_of

FLOOR_M = 0.05  # what lies on the ground is drawn a little above the grid
TOP_M = PERSON_HEIGHT_M + 0.05  # what must not be hidden by people is drawn above them
LEAST_WEIGHT = 0.08  # mixture components lighter than this are left out
CROSS_M = 0.22
GRID_M, GRID_REACH_M = 5.0, 80.0

COUNTS = {
    "counts/tracks": ("tracks", (86, 180, 233)),
    "counts/measurements": ("measurements", (255, 244, 206)),
    "counts/predictions": ("predicted by the model", (52, 200, 150)),
}

LEGEND = """
**Disc with a number**: a tracked pedestrian; only its outline while coasting.
Thin line behind it: the last 3.6 s.

**Lines ahead**: modal paths, opaque if likely. **Clouds**: the mixture, one sigma, half way and at the end.
Grey dashes: fallback, the track is too young or coasting.

**Dot**: fused measurement, slate (hardly a person) to cream (surely one).
Grey box: LiDAR cluster. Grey cross: ground truth.

**In the images**, white: detection, in a track's colour: where that track should be seen.
"""


def log_static(recording: rr.RecordingStream) -> None:
    """Logs what does not change: the vehicle's body, the names of the time series, the legend."""
    length, width, height = VEHICLE_LENGTH_M, VEHICLE_WIDTH_M, VEHICLE_HEIGHT_M
    outline = vehicle_outline(np.eye(4))
    front = VEHICLE_CENTRE_M + length / 2
    body = rr.Boxes3D(
        centers=[[VEHICLE_CENTRE_M - 0.2, 0, height / 2]],
        half_sizes=[[length / 2 - 0.2, width / 2, height / 2]],
        colors=[(*colours.VEHICLE, 60)],
        fill_mode="solid",
    )
    recording.log("map/vehicle/body", body, static=True)
    strips = [np.column_stack([outline, np.full(len(outline), z)]) for z in (FLOOR_M, height)]
    recording.log("map/vehicle/outline", rr.LineStrips3D(strips, colors=[colours.VEHICLE], radii=[-0.8]), static=True)
    heading = rr.Arrows3D(origins=[[front, 0, FLOOR_M]], vectors=[[2.0, 0, 0]], colors=[colours.VEHICLE], radii=[0.05])
    recording.log("map/vehicle/heading", heading, static=True)
    solid, outline_only = rr.components.FillMode.Solid, rr.components.FillMode.MajorWireframe
    person: dict[str, Any] = {"lengths": PERSON_HEIGHT_M, "radii": PERSON_RADIUS_M, "line_radii": -0.7}
    for entity, looks in (
        ("map/grid", rr.LineStrips3D.from_fields(colors=colours.GRID, radii=-0.5)),
        ("map/clusters", rr.Boxes3D.from_fields(colors=(*colours.CLUSTER, 150), radii=-0.5)),
        ("map/measurements", rr.Points3D.from_fields(radii=0.09)),
        ("map/ground_truth", rr.LineStrips3D.from_fields(colors=(*colours.TRUTH, 190), radii=-0.6)),
        ("map/tracks/seen", rr.Cylinders3D.from_fields(fill_mode=solid, **person)),
        ("map/tracks/coasting", rr.Cylinders3D.from_fields(fill_mode=outline_only, **person)),
        ("map/tracks/tails", rr.LineStrips3D.from_fields(radii=-0.6)),
        ("map/predictions/fallback", rr.LineStrips3D.from_fields(colors=colours.FALLBACK, radii=-0.9)),
        ("map/predictions/mixture", rr.Ellipsoids3D.from_fields(fill_mode=solid)),
    ):
        recording.log(entity, looks, static=True)
    for entity, (name, colour) in COUNTS.items():
        recording.log(entity, rr.SeriesLines(names=name, colors=colour, widths=1.5), static=True)
    recording.log("legend", rr.TextDocument(LEGEND, media_type="text/markdown"), static=True)


def log_camera(recording: rr.RecordingStream, name: str, size_px: tuple[int, int]) -> None:
    """Logs a camera's border and how its boxes look: detections show labels on hover only, or a crowd's hide all."""
    border = rr.Boxes2D(mins=[0, 0], sizes=[size_px], colors=[colours.GRID], radii=[-0.8])
    recording.log(f"cameras/{name}/border", border, static=True)
    detections = rr.Boxes2D.from_fields(colors=(*colours.DETECTION, 130), radii=-0.6, show_labels=False)
    recording.log(f"cameras/{name}/detections", detections, static=True)
    recording.log(f"cameras/{name}/tracks", rr.Boxes2D.from_fields(radii=-0.9, show_labels=True), static=True)


def draw_map(columns: RerunColumns, result: FrameResult, origin_m: FloatArray) -> None:
    """Draws the vehicle, the clusters, the fused measurements and, where known, the truth."""
    sensors, measurements = result.sensors, result.measurements
    pose = sensors.map_from_vehicle
    columns.add(
        "map/vehicle",
        rr.Transform3D,
        translation=(pose[:3, 3] - origin_m)[None].astype(np.float32),
        quaternion=quaternion_of(pose)[None].astype(np.float32),
    )
    columns.add("map/centre", rr.Transform3D, translation=(pose[:3, 3] - origin_m)[None].astype(np.float32))
    lidar, clusters = sensors.map_from_lidar, sensors.clusters
    M = len(clusters.centroids_m)
    centres = clusters.centroids_m @ lidar[:3, :3].T + lidar[:3, 3] - origin_m
    columns.add(
        "map/clusters",
        rr.Boxes3D,
        centers=centres.astype(np.float32),
        half_sizes=(clusters.sizes_m / 2).astype(np.float32),
        quaternions=np.broadcast_to(quaternion_of(lidar).astype(np.float32), (M, 4)),
    )
    colour = colours.probability_colours(measurements.pedestrian_probability)
    columns.add(
        "map/measurements",
        rr.Points3D,
        positions=_at_height(measurements.positions_m, origin_m, TOP_M),
        colors=colour,
    )
    truth = result.ground_truth
    if truth is not None:
        places = _at_height(truth.positions_m, origin_m, TOP_M + 0.05)
        arms = np.array([[[-1, -1, 0], [1, 1, 0]], [[-1, 1, 0], [1, -1, 0]]], np.float32) * (CROSS_M / 2)
        points = (places[:, None, None] + arms).reshape(-1, 3)
        columns.add("map/ground_truth", rr.LineStrips3D, strips=Strips(points, np.full(len(points) // 2, 2)))


def grid_cell(result: FrameResult, origin_m: FloatArray) -> tuple[float, float]:
    """Returns the grid's middle: the crossing nearest the vehicle, less the origin."""
    x, y = (np.round((result.sensors.map_from_vehicle[:2, 3] - origin_m[:2]) / GRID_M) * GRID_M).tolist()
    return x, y


def draw_grid(columns: RerunColumns, middle_m: tuple[float, float]) -> None:
    """Draws the ground's grid around a crossing; it need not be drawn again before the vehicle has left its cell."""
    along = np.arange(-GRID_REACH_M, GRID_REACH_M + GRID_M, GRID_M, dtype=np.float32)
    ends = np.array([-GRID_REACH_M, GRID_REACH_M], np.float32)
    across_x = np.stack(np.meshgrid(along, ends, indexing="ij"), -1)  # (N, 2, 2)  lines of constant x
    points = np.concatenate([across_x, across_x[..., ::-1]]).reshape(-1, 2) + np.array(middle_m, np.float32)
    strips = Strips(np.column_stack([points, np.zeros(len(points), np.float32)]), np.full(len(points) // 2, 2))
    columns.add("map/grid", rr.LineStrips3D, strips=strips)


def draw_people(columns: RerunColumns, result: FrameResult, origin_m: FloatArray) -> None:
    """Draws the tracks as cylinders with their ids, solid ones where measured, and their tails."""
    tracks = result.tracks.tracks
    for entity, coasting in (("map/tracks/seen", False), ("map/tracks/coasting", True)):
        chosen = [track for track in tracks if track.coasting is coasting]
        ids = [track.id for track in chosen]
        columns.add(
            entity,
            rr.Cylinders3D,
            centers=_at_height(_places(chosen), origin_m, PERSON_HEIGHT_M / 2),
            colors=colours.track_colours(ids),
            labels=[str(number) for number in ids],
        )
    tails = [track.history.states[:, :2] for track in tracks]
    columns.add(
        "map/tracks/tails",
        rr.LineStrips3D,
        strips=Strips(
            _at_height(np.concatenate([np.zeros((0, 2)), *tails]), origin_m, FLOOR_M),
            np.array([len(tail) for tail in tails], np.int64),
        ),
        colors=colours.with_opacity(colours.track_colours([track.id for track in tracks]), 0.5),
    )


def draw_predictions(columns: RerunColumns, result: FrameResult, origin_m: FloatArray) -> None:
    """Draws modal paths and mixtures of the model's predictions, and fallbacks as dashes."""
    predicted, fallback = split_by_fallback(result.predictions.predictions)
    paths = modal_paths(result.tracks, predicted)
    columns.add(
        "map/predictions/paths",
        rr.LineStrips3D,
        strips=Strips(_at_height(paths.points_m, origin_m, FLOOR_M + 0.02), paths.lengths),
        colors=colours.with_opacity(colours.track_colours(paths.track_ids), colours.path_opacity(paths.probabilities)),
        radii=-(0.7 + 0.9 * paths.probabilities).astype(np.float32),  # negative: in points of the screen
    )
    dashed = [dashes(strip) for strip in modal_paths(result.tracks, fallback).strips_m()]
    points = np.concatenate([np.zeros((0, 2, 2)), *dashed]).reshape(-1, 2)
    columns.add(
        "map/predictions/fallback",
        rr.LineStrips3D,
        strips=Strips(_at_height(points, origin_m, FLOOR_M + 0.02), np.full(len(points) // 2, 2)),
    )
    ellipses = mixture_ellipses(predicted, drawn_steps(result.predictions), LEAST_WEIGHT)
    half, zero = ellipses.yaws_rad / 2, np.zeros(len(ellipses.weights))
    columns.add(
        "map/predictions/mixture",
        rr.Ellipsoids3D,
        centers=_at_height(ellipses.centres_m, origin_m, FLOOR_M),
        half_sizes=np.column_stack([ellipses.half_axes_m, zero + 0.01]).astype(np.float32),
        quaternions=np.column_stack([zero, zero, np.sin(half), np.cos(half)]).astype(np.float32),
        colors=colours.with_opacity(colours.track_colours(ellipses.track_ids), 0.08 + 0.30 * ellipses.weights),
    )


def draw_cameras(columns: RerunColumns, result: FrameResult, names: Sequence[str]) -> None:
    """Draws each camera's detections, and the tracked people where they should appear in it.

    A camera in `names` that has nothing for this frame gets empty rows, which takes the last ones away.
    """
    tracks = result.tracks.tracks
    states = np.array([track.state for track in tracks], float).reshape(-1, 4)
    ids: IntArray = np.array([track.id for track in tracks], np.int64)
    ground_m = float(result.sensors.map_from_vehicle[2, 3])
    cameras = {camera.name: camera for camera in result.sensors.cameras}
    for name in names:
        camera = cameras.get(name)
        boxes: FloatArray = np.zeros((0, 4))
        people, index, labels = boxes, ids[:0], list[str]()
        if camera is not None:
            found = camera.detections
            boxes = found.boxes_px
            labels = [f"{label} {score:.2f}" for label, score in zip(found.labels, found.scores.tolist(), strict=True)]
            people, index = people_in_image(camera, states, result.tracks.stamp_ns, ground_m)
        columns.add(f"cameras/{name}/detections", rr.Boxes2D, **_boxes(boxes), labels=labels)
        numbers = ids[index]
        columns.add(
            f"cameras/{name}/tracks",
            rr.Boxes2D,
            **_boxes(people),
            labels=[str(number) for number in numbers],
            colors=colours.track_colours(numbers),
        )


def draw_counts(columns: RerunColumns, result: FrameResult) -> None:
    """Adds this frame's point to each time series."""
    predicted, _ = split_by_fallback(result.predictions.predictions)
    values = (len(result.tracks.tracks), len(result.measurements.positions_m), len(predicted))
    for entity, value in zip(COUNTS, values, strict=True):
        columns.add(entity, rr.Scalars, scalars=np.array([value], float))


def _places(tracks: Sequence[Track]) -> FloatArray:
    return np.array([track.state[:2] for track in tracks], float).reshape(-1, 2)


def _at_height(places_m: FloatArray, origin_m: FloatArray, height_m: float) -> FloatArray:
    """Returns points (N, 2) of the ground as rerun takes them: (N, 3), less the origin, single precision."""
    points = np.empty((len(places_m), 3), np.float32)
    points[:, :2] = places_m - origin_m[:2]
    points[:, 2] = height_m
    return points


def _boxes(corners_px: FloatArray) -> dict[str, FloatArray]:
    low, high = corners_px[:, :2].astype(np.float32), corners_px[:, 2:].astype(np.float32)
    return {"centers": (low + high) / 2, "half_sizes": (high - low) / 2}
