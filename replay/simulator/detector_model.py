"""The simulated person detector of one camera: scenes in, `CameraDetections` out.

Images are worked on by the block, which costs a third of doing them one by one. One letter per axis: I images,
O objects of all images, J discs they are made of, N objects seen, M boxes.
"""

import math
from collections.abc import Sequence

import numpy as np
from scipy.special import expit, ndtri

from replay.simulator.motion import Scene
from replay.simulator.noise import CorrelatedNoise
from replay.simulator.rig import MountedCamera, planar_pose
from replay.simulator.sensor_model import SensorModelV1
from replay.simulator.visibility import FIXTURE, VEHICLE, Objects, View, look, stacked
from schemas.messages import BoolArray, CameraDetections, FloatArray, IntArray
from tracking.camera import CameraModel
from tracking.geometry import inverse

_COLUMNS = 1440  # 0.25 degrees, 5 pixels
_HALF_VIEW_RAD = math.radians(75.0)  # wide of the image's edge, so that who is half in the picture counts
_LEVELS = np.linspace(0.0, 1.0, 4)  # of a silhouette, from foot to head
_AROUND = np.array([(math.cos(a), math.sin(a)) for a in np.arange(8) * math.pi / 4])  # (8, 2) on a unit circle


def silhouette_points(centres_m: FloatArray, radii_m: FloatArray, heights_m: FloatArray) -> FloatArray:
    """Returns points (N, 32, 3) around upright cylinders on the ground: 4 rings of 8, map frame."""
    points = np.empty((len(centres_m), len(_LEVELS), len(_AROUND), 3))
    points[..., :2] = (centres_m[:, None] + radii_m[:, None, None] * _AROUND)[:, None]
    points[..., 2] = (heights_m[:, None] * _LEVELS)[..., None]
    return points.reshape(len(centres_m), len(_LEVELS) * len(_AROUND), 3)


def bounding_boxes(camera: CameraModel, points_camera: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Returns the boxes (N, 4) around projected points (N, P, 3), not cut at the image's border, and which exist.

    Points that the camera cannot project are left out; a box needs at least two others.
    """
    pixels, valid = camera.project(points_camera)
    low = np.where(valid[..., None], pixels, np.inf).min(axis=1)
    high = np.where(valid[..., None], pixels, -np.inf).max(axis=1)
    exists = valid.sum(axis=1) >= 2
    return np.where(exists[:, None], np.concatenate([low, high], axis=1), 0.0), exists


class SimulatedDetector:
    """Turns scenes into one camera's detections, in order of time."""

    def __init__(self, camera: MountedCamera, model: SensorModelV1, rng: np.random.Generator):
        self._camera = camera
        self._model = model
        self._rng = rng
        detect, box = model.detect_correlation_s, model.box_correlation_s
        self._noise = CorrelatedNoise((detect, box, box, box, box, model.fixture_correlation_s), rng)

    def detect(
        self, scenes: Sequence[Scene], objects_of_scenes: Sequence[Objects], stamps_ns: Sequence[int]
    ) -> list[CameraDetections]:
        """Returns what the detector reports of each scene and its solid objects, best score first."""
        poses = np.stack([planar_pose(scene.vehicle.position_m, scene.vehicle.yaw_rad) for scene in scenes])
        map_from_camera = poses @ self._camera.vehicle_from_camera  # (I, 4, 4)
        camera_from_map = inverse(map_from_camera)
        objects = stacked(objects_of_scenes)
        image = np.repeat(np.arange(len(scenes)), [len(each.kinds) for each in objects_of_scenes])  # (O,)
        view = self._look(objects, image[objects.owners], map_from_camera)
        columns = np.bincount(objects.owners, weights=view.columns, minlength=len(image))
        visible = np.bincount(objects.owners, weights=view.visible, minlength=len(image))
        seen = np.flatnonzero(visible > 0)  # (N,) objects
        boxes, exist = self._full_boxes(objects, view, image, seen, camera_from_map)
        share = visible[seen] / columns[seen]
        kinds, image = objects.kinds[seen], image[seen]
        p = self._p_detect(boxes, share)
        keys = objects.keys[seen]
        noise = np.concatenate([self._noise.at(keys[image == i], scene.time_s) for i, scene in enumerate(scenes)])
        p_look_alike = p * self._model.p_fixture_called_person / self._model.p_detect
        found = exist & np.where(kinds == FIXTURE, noise[:, 5] < ndtri(p_look_alike), noise[:, 0] < ndtri(p))
        boxes = self._with_noise(_visible_part(objects, view, seen, boxes), noise[:, 1:5])
        false_boxes, false_images = self._false_boxes(map_from_camera, camera_from_map)

        false_count = len(false_boxes)
        quality = np.concatenate([np.where(kinds == FIXTURE, 0.25, p)[found], np.full(false_count, 0.2)])
        return self._reported(
            np.concatenate([boxes[found], false_boxes]),
            np.concatenate([kinds[found] == VEHICLE, np.zeros(false_count, bool)]),
            self._scores(quality),
            np.concatenate([image[found], false_images]),
            stamps_ns,
        )

    def _look(self, objects: Objects, images: IntArray, map_from_camera: FloatArray) -> View:
        axes = map_from_camera[:, :2, 2]  # (I, 2)  the optical axis, seen from above
        forward = (axes / np.linalg.norm(axes, axis=1, keepdims=True))[images]  # (J, 2)
        from_camera = objects.centres_m - map_from_camera[images, :2, 3]
        ahead = (from_camera * forward).sum(axis=1)
        left = from_camera[:, 1] * forward[:, 0] - from_camera[:, 0] * forward[:, 1]
        candidates = (ahead > math.cos(_HALF_VIEW_RAD) * np.hypot(ahead, left)) & (ahead < self._model.detector_range_m)
        return look(np.stack([ahead, left], axis=-1), objects.radii_m, candidates, images, columns=_COLUMNS, phase=0.5)

    def _full_boxes(
        self, objects: Objects, view: View, images: IntArray, seen: IntArray, camera_from_map: FloatArray
    ) -> tuple[FloatArray, BoolArray]:
        """Returns boxes (N, 4) around all visible discs of each object seen, uncut, and which can be projected."""
        shown = np.flatnonzero(view.visible > 0)  # (S,) discs
        owners = objects.owners[shown]
        heights = objects.heights_m[owners]
        heights = np.where(objects.kinds[owners] == FIXTURE, np.minimum(heights, 1.9), heights)  # like a person
        points = silhouette_points(objects.centres_m[shown], objects.radii_m[shown], heights)
        T = camera_from_map[images[owners]]  # (S, 4, 4)
        disc_boxes, disc_exists = bounding_boxes(
            self._camera.model, points @ T[:, :3, :3].transpose(0, 2, 1) + T[:, None, :3, 3]
        )
        place = np.searchsorted(seen, owners)[disc_exists]
        boxes = np.tile([np.inf, np.inf, -np.inf, -np.inf], (len(seen), 1))
        np.minimum.at(boxes[:, :2], place, disc_boxes[disc_exists, :2])
        np.maximum.at(boxes[:, 2:], place, disc_boxes[disc_exists, 2:])
        exists = np.isfinite(boxes).all(axis=1)
        return np.where(exists[:, None], boxes, 0.0), exists

    def _p_detect(self, boxes: FloatArray, share: FloatArray) -> FloatArray:
        """Returns the probability (N,) that objects with full boxes (N, 4) and visible shares (N,) are detected.

        What the image's border cuts off counts as hidden; the height decides whether there are pixels enough.
        """
        model, camera = self._model, self._camera.model
        inside = np.minimum(np.maximum(boxes, 0.0), (camera.width_px, camera.height_px) * 2)
        inside_x, inside_y = (inside[:, 2:] - inside[:, :2]).T
        full_x, full_y = np.maximum(boxes[:, 2:] - boxes[:, :2], 1e-6).T
        p: FloatArray = (
            model.p_detect
            * expit((inside_y - model.detect_half_height_px) / model.detect_height_scale_px)
            * expit((share * inside_x / full_x - model.detect_half_visible) / model.detect_visible_scale)
            * np.minimum(1.0, 2 * inside_y / full_y)
        )
        return p

    def _with_noise(self, boxes: FloatArray, lasting: FloatArray) -> FloatArray:
        """Returns boxes (N, 4) with every edge off by some pixels, half of it lasting for a while."""
        model = self._model
        height = (boxes[:, 3] - boxes[:, 1])[:, None]
        sd = (model.box_noise_px + model.box_noise * height) / math.sqrt(2)
        noisy = boxes + sd * (lasting + self._rng.standard_normal(boxes.shape))
        return np.concatenate([np.minimum(noisy[:, :2], noisy[:, 2:]), np.maximum(noisy[:, :2], noisy[:, 2:])], axis=1)

    def _false_boxes(self, map_from_camera: FloatArray, camera_from_map: FloatArray) -> tuple[FloatArray, IntArray]:
        """Returns boxes (M, 4) of people who are not there, each for one image alone, and which (M,)."""
        rng = self._rng
        counts = rng.poisson(self._model.false_boxes_per_image, len(map_from_camera))
        images = np.repeat(np.arange(len(counts)), counts)
        M = len(images)
        if M == 0:
            return np.zeros((0, 4)), images
        axes = np.arctan2(map_from_camera[images, 1, 2], map_from_camera[images, 0, 2])
        bearings = axes + rng.uniform(-0.8, 0.8, M)
        ranges = rng.uniform(4.0, 40.0, M)
        offsets = ranges[:, None] * np.stack([np.cos(bearings), np.sin(bearings)], axis=-1)
        centres = map_from_camera[images, :2, 3] + offsets
        points = silhouette_points(centres, rng.uniform(0.15, 0.45, M), rng.uniform(1.0, 2.0, M))
        T = camera_from_map[images]
        boxes, exist = bounding_boxes(self._camera.model, points @ T[:, :3, :3].transpose(0, 2, 1) + T[:, None, :3, 3])
        return boxes[exist], images[exist]

    def _scores(self, quality: FloatArray) -> FloatArray:
        """Returns scores (M,), 0.3 (the detector's threshold) to 0.99, higher for what is easier to see."""
        logits = 4.5 * quality - 1.5 + self._model.score_spread * self._rng.standard_normal(len(quality))
        scores: FloatArray = 0.3 + 0.69 * expit(logits)
        return scores

    def _reported(
        self, boxes: FloatArray, cars: BoolArray, scores: FloatArray, images: IntArray, stamps_ns: Sequence[int]
    ) -> list[CameraDetections]:
        """Returns a message per image of the boxes (M, 4), cut at the border and sorted; what is too small goes."""
        camera = self._camera
        boxes = np.minimum(np.maximum(boxes, 0.0), (camera.model.width_px, camera.model.height_px) * 2)
        big = (boxes[:, 2:] - boxes[:, :2]).min(axis=1, initial=np.inf) >= self._model.min_box_px
        order = np.lexsort([-scores, images])
        order = order[big[order]]
        bounds = np.searchsorted(images[order], np.arange(len(stamps_ns) + 1))
        messages = []
        for i, stamp_ns in enumerate(stamps_ns):
            mine = order[bounds[i] : bounds[i + 1]]
            labels = tuple("car" if car else "person" for car in cars[mine])
            messages.append(CameraDetections(stamp_ns, camera.frame_id, boxes[mine], scores[mine], labels))
        return messages


def _visible_part(objects: Objects, view: View, seen: IntArray, boxes: FloatArray) -> FloatArray:
    """Returns boxes (N, 4) narrowed to what nearer objects leave of a person's or fixture's width.

    A vehicle's stays whole: detectors know how long cars are.
    """
    disc = np.searchsorted(objects.owners, seen)  # the first, and but for vehicles only, disc of each object
    total = np.maximum(view.columns[disc], 1)
    narrow = (objects.kinds[seen] != VEHICLE) * (boxes[:, 2] - boxes[:, 0]) / total
    narrowed = boxes.copy()
    one = view.visible[disc] > 0
    narrowed[:, 0] += np.where(one, total - 1 - view.last[disc], 0) * narrow  # bearings grow to the left
    narrowed[:, 2] -= np.where(one, view.first[disc], 0) * narrow
    return narrowed
