"""Inspected frames in rerun: what a replay's recording shows, and on top of it what fusion made of boxes and clusters.

map/verdicts            clusters, by what came of them, the reason beside them
cameras/NAME/clusters   people that the clusters would be, by whether a box of this camera was matched to them
cameras/NAME/left_over  boxes without a cluster, the reason beside them
"""

from pathlib import Path
from typing import Any

import numpy as np

from replay.frame_result import FrameResult
from replay.inspection import ClusterReport, Inspected, Outcome
from replay.reprojection import reproject
from replay.rerun_view import NullView, RerunView
from schemas.messages import FloatArray, PredictionFrame
from tracking.fusion import FusionParams
from tracking.geometry import quaternion_of
from tracking.label_report import LabelReport

GREEN, AMBER, RED, GREY = (52, 200, 150), (240, 163, 30), (245, 90, 80), (108, 124, 143)
_COLOUR = {Outcome.TRACKED: GREEN, Outcome.UNCONFIRMED: AMBER, Outcome.FADED: AMBER, Outcome.NO_BIRTH: GREY}
LEAST_SHARE = 0.3  # of a person inside the image: less is not drawn

LEGEND = """
**On the map**, boxes round the clusters: green, tracked; amber, unconfirmed or faded; red, no pedestrian or clutter;
grey, gives no birth. Hover or select one to read why.

**In the images**, outlines of the people that clusters would be: green, a box was matched; amber, a box touches it and
was not; red, no box near. #7 is cluster 7. White: detection; red with a label: one without a cluster.

**Disc with a number**: a tracked pedestrian. Grey cross: ground truth.
"""


class NullInspectionView(NullView):
    """Shows nothing."""

    def show_inspected(self, inspected: Inspected) -> None:
        """Shows nothing."""


class InspectionView(RerunView):
    """Draws inspected frames into a rerun recording."""

    params = FusionParams()
    _has_looks = False

    def show_inspected(self, inspected: Inspected) -> None:
        """Draws one frame, with what its clusters and boxes came to."""
        import rerun as rr

        result = _as_result(inspected)
        self._draw(result)
        assert self._recording is not None, "_draw refuses a closed view"
        if not self._has_looks:
            self._recording.log("legend", rr.TextDocument(LEGEND, media_type="text/markdown"), static=True)
            self._has_looks = True
        self._draw_verdicts(inspected)
        self._draw_outlines(inspected)
        self._columns.end_frame(result.tracks.stamp_ns, result.tracks.sequence)

    def _draw_verdicts(self, inspected: Inspected) -> None:
        import rerun as rr

        scan, lidar = inspected.frame.sensors.clusters, inspected.frame.sensors.map_from_lidar
        assert self._origin_m is not None, "_draw sets it"
        reports = [c for c in inspected.report.clusters if c.cluster >= 0 and c.outcome is not Outcome.REFUSED]
        rows = np.array([c.cluster for c in reports], np.int64)
        centres = scan.centroids_m[rows] @ lidar[:3, :3].T + lidar[:3, 3] - self._origin_m
        self._columns.add(
            "map/verdicts",
            rr.Boxes3D,
            centers=centres.astype(np.float32),
            half_sizes=(scan.sizes_m[rows] / 2 + 0.05).astype(np.float32),
            quaternions=np.broadcast_to(quaternion_of(lidar).astype(np.float32), (len(rows), 4)),
            colors=_colours([_COLOUR.get(c.outcome, RED) for c in reports]),
            labels=[f"#{c.cluster}: {c.reason}" for c in reports],
        )

    def _draw_outlines(self, inspected: Inspected) -> None:
        import rerun as rr

        sensors, measurements = inspected.frame.sensors, inspected.measurements
        moving = velocities(inspected.labels, len(measurements))
        people = reproject(sensors, measurements.positions_m, moving, self.params)
        row_of = {camera.name: c for c, camera in enumerate(sensors.cameras)}
        for name in self._cameras:
            mine = np.flatnonzero((people.camera == row_of.get(name, -1)) & (people.share_inside >= LEAST_SHARE))
            drawn = [
                (row, *_look(inspected.clusters[m], name)) for row, m in zip(mine, people.person[mine], strict=True)
            ]
            kept = [(row, colour, label) for row, colour, label in drawn if label]
            self._columns.add(
                f"cameras/{name}/clusters",
                rr.Boxes2D,
                **_boxes(people.corners_px[:, [row for row, _, _ in kept]].T),
                colors=_colours([colour for _, colour, _ in kept]),
                labels=[label for _, _, label in kept],
            )
            left_over = [b for b in inspected.report.boxes if b.camera == name and b.cluster is None]
            self._columns.add(
                f"cameras/{name}/left_over",
                rr.Boxes2D,
                **_boxes(np.array([b.corners_px for b in left_over], float).reshape(-1, 4)),
                colors=_colours([RED] * len(left_over)),
                labels=[f"box {b.box}: {b.why}" for b in left_over],
            )


def velocities(labels: LabelReport, M: int) -> FloatArray:
    """Returns the velocity (M, 2) of each measurement: its label's, or 0. Of several labels the oldest counts."""
    owned = np.flatnonzero(labels.measurement >= 0)
    rows, first = np.unique(labels.measurement[owned], return_index=True)  # labels are sorted, oldest first
    found = np.zeros((M, 2))
    found[rows] = labels.states[owned[first], 2:]
    return found


def view(path: Path | None, recording_id: str, params: FusionParams) -> InspectionView | NullInspectionView:
    """Returns a view that writes an .rrd file, or without a path one that shows nothing; raises ViewError."""
    if path is None:
        return NullInspectionView()
    shown = InspectionView.to_file(path, recording_id)
    assert isinstance(shown, InspectionView)
    shown.params = params
    return shown


def _as_result(inspected: Inspected) -> FrameResult:
    """Returns the frame as a replay would, had nobody been predicted."""
    tracks, frame = inspected.tracks, inspected.frame
    nothing = PredictionFrame(tracks.sequence, tracks.stamp_ns, tracks.frame_id, "none", 0.1)
    return FrameResult(
        frame.log_time_ns, frame.sensors, inspected.measurements, tracks, nothing, frame.images, frame.ground_truth
    )


def _look(cluster: ClusterReport, camera: str) -> tuple[tuple[int, int, int], str]:
    """Returns colour and label of a cluster's outline in a camera; no label: it is not worth drawing."""
    for matched in cluster.boxes:
        if matched.camera == camera:
            return GREEN, f"#{cluster.cluster}"
    near = [f"box {miss.box} {miss.why}" for miss in cluster.near_misses if miss.camera == camera]
    if near:
        return AMBER, f"#{cluster.cluster}: {', '.join(near)}"
    by_size = cluster.size_log_odds
    return RED, f"#{cluster.cluster}: no box" if by_size is None or by_size > 0 else ""


def _colours(rows: list[tuple[int, int, int]]) -> np.ndarray[Any, np.dtype[np.uint8]]:
    return np.array(rows, np.uint8).reshape(-1, 3)


def _boxes(corners_px: FloatArray) -> dict[str, FloatArray]:
    low, high = corners_px[:, :2].astype(np.float32), corners_px[:, 2:].astype(np.float32)
    return {"centers": (low + high) / 2, "half_sizes": (high - low) / 2}
