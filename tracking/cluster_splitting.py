"""Two people, one cluster: where the boxes of a camera say that a wide cluster holds several people, it is split."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from schemas.messages import BoolArray, FloatArray, IntArray
from tracking.box_matching import CameraView
from tracking.clusters import Clusters
from tracking.fusion_params import FusionParams
from tracking.geometry import inverse
from tracking.sensor_frame import CameraFrame

MOST_PEOPLE = 3  # that one cluster is split into
VISIBLE_SHARE = 0.42  # half of a person's visible width, of the width of the cylinder that stands for a person


def split_clusters(
    clusters: Clusters,
    cameras: Sequence[CameraFrame],
    moved_m: FloatArray,
    view: CameraView,
    params: FusionParams,
) -> Clusters | None:
    """Returns the clusters with one row per person where several boxes of a camera lie on a wide one; None if none do.

    People stand side by side as the boxes do, as far away as the cluster. The outermost ones are placed by their
    outer edges: a box ends where a neighbour hides the rest.

    Args:
        clusters: (M,)
        cameras: C of them.
        moved_m: (C, M, 2) where the clusters are at the cameras' stamps.
        view: the boxes, and which cluster each was matched to.
        params: settings.
    """
    wide = (clusters.width_m > params.wide_for_two_m) & (clusters.width_m < params.too_wide_to_split_m)
    if not wide.any():
        return None
    parts: dict[int, FloatArray] = {}  # cluster -> shifts of its people's places (k, 2)
    for pairs in _pairs_by_cluster(clusters, wide, view, params):
        camera = int(view.boxes.camera[view.pairs.box[pairs[0]]])
        cluster = int(view.pairs.cluster[pairs[0]])
        corners, outline = view.boxes.corners_px[view.pairs.box[pairs]], view.pairs.outline_px[:, pairs[0]]
        lateral = _lateral_m(corners, outline, params)
        if len(lateral) > max(1, len(parts.get(cluster, ()))):  # more people than another camera showed
            toward = moved_m[camera, cluster] - inverse(cameras[camera].camera_from_map)[:2, 3]
            right = np.array([toward[1], -toward[0]]) / max(float(np.hypot(*toward)), 1e-3)
            parts[cluster] = lateral[:, None] * right
    return _with_parts(clusters, parts) if parts else None


def _pairs_by_cluster(
    clusters: Clusters, wide: BoolArray, view: CameraView, params: FusionParams
) -> Iterator[IntArray]:
    """Yields the pairs of each camera's boxes that lie on one wide cluster, boxes from left to right.

    A box that was matched lies on its own cluster, one that was left over on the nearest.
    """
    pairs, boxes = view.pairs, view.boxes
    x0, _, x1, _ = pairs.outline_px
    u0, _, u1, _ = boxes.corners_px[pairs.box].T
    offset_m = np.abs(u0 + u1 - x0 - x1) / np.maximum(x1 - x0, 1.0) * params.radius_m  # from the cluster's middle
    matched = np.zeros(len(boxes), bool)
    matched[pairs.box[view.matched]] = True
    lies = wide[pairs.cluster] & (np.abs(pairs.height_log_ratio) < params.max_height_log_ratio)
    lies &= (offset_m < clusters.width_m[pairs.cluster] / 2) & (view.matched | ~matched[pairs.box])
    on = np.flatnonzero(lies)
    on = on[np.lexsort((offset_m[on], pairs.box[on]))]
    on = on[np.unique(pairs.box[on], return_index=True)[1]]
    on = on[np.lexsort((pairs.box[on], (u0 + u1)[on], pairs.cluster[on], boxes.camera[pairs.box[on]]))]
    group = np.stack([boxes.camera[pairs.box[on]], pairs.cluster[on]])
    starts = np.flatnonzero((group[:, 1:] != group[:, :-1]).any(axis=0)) + 1
    yield from (several for several in np.split(on, starts) if len(several) > 1)


def _lateral_m(boxes_px: FloatArray, outline_px: FloatArray, params: FusionParams) -> FloatArray:
    """Returns how far to the right of an outline's (4,) middle the people of boxes (k, 4) stand, in m.

    Boxes come from left to right; what is nearer to its left neighbour than people can be is the same person.
    """
    width = max(float(outline_px[2] - outline_px[0]), 1.0)
    middle = (outline_px[0] + outline_px[2]) / 2
    half = np.maximum((boxes_px[:, 2] - boxes_px[:, 0]) / 2, VISIBLE_SHARE * width)
    centre = (boxes_px[:, 0] + boxes_px[:, 2]) / 2
    centre[0] = boxes_px[0, 0] + half[0]
    centre[-1] = max(boxes_px[-1, 2] - half[-1], centre[0])
    lateral = (centre - middle) / width * 2 * params.radius_m
    apart = [0]
    for k in range(1, len(lateral)):
        if lateral[k] - lateral[apart[-1]] >= params.closest_people_m:
            apart.append(k)
    return np.asarray(lateral[apart[:MOST_PEOPLE]])


def _with_parts(clusters: Clusters, parts: dict[int, FloatArray]) -> Clusters:
    repeats = np.ones(len(clusters), np.int64)
    repeats[list(parts)] = [len(shifts) for shifts in parts.values()]
    rows = np.repeat(np.arange(len(clusters)), repeats)
    shift = np.zeros((len(rows), 2))
    for cluster, shifts in parts.items():
        shift[rows == cluster] = shifts
    k = repeats[rows]
    centroids = clusters.centroids_m[rows]
    centroids[:, :2] += shift
    sizes = clusters.sizes_m[rows]
    sizes[:, :2] /= k[:, None]
    return replace(
        clusters,
        index=clusters.index[rows],
        centroids_m=centroids,
        offsets_m=clusters.offsets_m[rows] + shift,
        sizes_m=sizes,
        width_m=clusters.width_m[rows] / k,
        points=np.maximum(clusters.points[rows] // k, 1),
        split=k > 1,
    )
