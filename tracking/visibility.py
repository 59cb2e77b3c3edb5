"""How likely the LiDAR is to see a person somewhere: range, and what stands in between."""

from collections.abc import Callable
from typing import Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from schemas.messages import FloatArray
from tracking.clusters import sound_clusters
from tracking.geometry import apply
from tracking.sensor_frame import SensorFrame


class VisibilityParams(BaseModel):
    """Settings of the LiDAR's detection probability."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    p_detect: float = Field(default=0.95, gt=0, lt=1, description="of a person in plain view, nearby")
    p_detect_hidden: float = Field(default=0.3, gt=0, lt=1, description="of one hidden behind something nearer")
    full_range_m: float = Field(default=30.0, gt=0, description="up to here nothing is lost to distance")
    max_range_m: float = Field(default=55.0, gt=0, description="from here on nobody is seen: outside the view")
    person_radius_m: float = Field(default=0.25, gt=0)
    nearer_by_m: float = Field(default=0.35, gt=0, description="an object must be this much nearer to hide a person")
    hiding_height_m: float = Field(default=1.2, gt=0, description="an object this tall hides a person altogether")

    @model_validator(mode="after")
    def _falls(self) -> Self:
        if self.max_range_m <= self.full_range_m:
            raise ValueError(f"max_range_m {self.max_range_m:g} must be over full_range_m {self.full_range_m:g}")
        return self


def hidden_share(
    targets_m: FloatArray,
    target_radius_m: float,
    occluders_m: FloatArray,
    occluder_radii_m: FloatArray,
    *,
    nearer_by_m: float,
) -> FloatArray:
    """Returns how much of each target's angular width each nearer object covers, (K, J), 0 to 1.

    Seen from the origin of the positions, from above.

    Args:
        targets_m: (J, 2)
        target_radius_m: of all targets.
        occluders_m: (K, 2)
        occluder_radii_m: (K,) half widths across the line of sight.
        nearer_by_m: an object hides only what is at least this much farther away.
    """
    target_range = np.maximum(np.hypot(targets_m[:, 0], targets_m[:, 1]), 1e-3)  # (J,)
    occluder_range = np.maximum(np.hypot(occluders_m[:, 0], occluders_m[:, 1]), 1e-3)[:, None]  # (K, 1)
    bearing = np.arctan2(targets_m[:, 1], targets_m[:, 0])
    apart = np.abs(bearing - np.arctan2(occluders_m[:, 1], occluders_m[:, 0])[:, None])  # (K, J)
    apart = np.minimum(apart, 2 * np.pi - apart)
    half = np.arctan2(target_radius_m, target_range)
    occluder_half = np.arctan2(occluder_radii_m[:, None], occluder_range)
    overlap = np.minimum(apart + half, occluder_half) - np.maximum(apart - half, -occluder_half)
    covered: FloatArray = np.minimum(np.maximum(overlap / (2 * half), 0.0), 1.0) * (
        occluder_range < target_range - nearer_by_m
    )
    return covered


def detection_probability(frame: SensorFrame, params: VisibilityParams) -> Callable[[FloatArray], FloatArray]:
    """Returns the function from positions (J, 2) of the odometry frame to the probabilities (J,) of being measured.

    Exactly 0 out of range. The frame's own clusters are what hides.
    """
    origin = frame.map_from_lidar[:2, 3]
    clusters = frame.clusters
    sound = sound_clusters(frame)
    sizes = clusters.sizes_m[sound]
    occluders = apply(frame.map_from_lidar, clusters.centroids_m[sound])[:, :2] - origin
    radii = 0.5 * np.maximum(sizes[:, 0], sizes[:, 1])
    hides = np.minimum(np.maximum(sizes[:, 2] / params.hiding_height_m, 0.0), 1.0)

    def probability(positions_m: FloatArray) -> FloatArray:
        targets = positions_m - origin
        ranges = np.hypot(targets[:, 0], targets[:, 1])
        falloff = (params.max_range_m - ranges) / (params.max_range_m - params.full_range_m)
        clear = params.p_detect * np.minimum(np.maximum(falloff, 0.0), 1.0)
        if len(occluders) == 0 or len(targets) == 0:
            return clear
        covered = hidden_share(targets, params.person_radius_m, occluders, radii, nearer_by_m=params.nearer_by_m)
        hidden = (covered * hides[:, None]).max(axis=0)
        return np.where(clear > 0, clear * (1 - hidden) + np.minimum(params.p_detect_hidden, clear) * hidden, 0.0)

    return probability
