"""The frozen parameters of the simulated sensors.

FROZEN: these numbers are the yardstick trackers and predictors are measured with. Nobody makes a tracker better by
softening the simulator; a test pins the checksum of version 1. Another set of numbers is another class with another
version, and drives name the one they were made with in their metadata.
"""

import hashlib
import json
from dataclasses import asdict, dataclass


@dataclass(frozen=True)
class SensorModelV1:
    """Six fisheye cameras with a person detector, a VLP-16 with a clustering stage, and filtered odometry.

    The rates and mounting are the USyd campus vehicle's (DOI 10.21227/sk74-7419); error sizes are what such detectors
    and sensors plausibly have, set once before any tracker was run on them.
    """

    version: int = 1

    # People: upright elliptic shapes, seen as cylinders.
    person_height_m: float = 1.75
    person_height_sd_m: float = 0.06
    person_radius_m: float = 0.25

    # Timing. Sensor stamps jitter; messages reach the log after a delay of base + jitter * Beta(2, 3).
    camera_rate_hz: float = 30.0
    lidar_rate_hz: float = 10.0
    odometry_rate_hz: float = 100.0
    stamp_jitter_sd_s: float = 0.0004
    camera_delay_s: float = 0.040
    camera_delay_jitter_s: float = 0.040
    lidar_delay_s: float = 0.060
    lidar_delay_jitter_s: float = 0.050
    odometry_delay_s: float = 0.004
    odometry_delay_jitter_s: float = 0.003
    p_camera_drops_frame: float = 0.003

    # LiDAR geometry: 16 rings 2 degrees apart, 0.2 degrees in azimuth (VLP-16 at 10 Hz).
    lidar_rings: int = 16
    lidar_lowest_ring_rad: float = -0.2617993877991494  # -15 degrees
    lidar_ring_spacing_rad: float = 0.03490658503988659  # 2 degrees
    lidar_columns: int = 1800
    lidar_pitch_jitter_rad: float = 0.003  # suspension: which rings hit, not where clusters are put
    ground_cut_m: float = 0.15  # points lower than this are taken for ground
    lidar_range_m: float = 65.0
    p_return: float = 0.85  # of a beam that meets the silhouette: gaps between legs, dark cloth
    return_falloff_range_m: float = 55.0
    return_falloff_m: float = 6.0

    # Clustering.
    cluster_min_points: int = 3
    p_cluster: float = 0.985  # of many points
    cluster_growth_points: float = 1.5  # p = p_cluster (1 - exp(-(n - 2) / this))
    miss_correlation_s: float = 0.25
    merge_gap_m: float = -0.05  # between two people's surfaces: centres 0.45 m apart
    merge_gap_other_m: float = 0.10  # where one of the two is no pedestrian
    merge_gap_sd_m: float = 0.04
    centroid_pull: float = 0.48  # towards the sensor, in radii: 0.12 m for a person
    sway_sd_m: float = 0.04  # gait: the centroid wanders about the body's axis
    sway_correlation_s: float = 0.3
    point_noise_sd_m: float = 0.06  # of one point; divided by the root of their number
    point_noise_sd_per_m: float = 0.002  # grows with range
    foliage_noise_sd_m: float = 0.12
    clutter_per_scan: float = 3.0  # Poisson; clusters of one scan only
    clutter_range_m: tuple[float, float] = (3.0, 40.0)

    # Detector.
    detector_range_m: float = 60.0
    p_detect: float = 0.97
    detect_half_height_px: float = 38.0  # detected half as often
    detect_height_scale_px: float = 7.0
    detect_half_visible: float = 0.38  # visible fraction of the width at which it is half as often
    detect_visible_scale: float = 0.07
    detect_correlation_s: float = 0.30  # misses come in bursts
    box_noise: float = 0.02  # of the box's height, each edge: half correlated over time, half not
    box_noise_px: float = 1.2
    box_correlation_s: float = 0.30
    min_box_px: float = 6.0
    false_boxes_per_image: float = 0.04
    p_fixture_called_person: float = 0.03
    fixture_correlation_s: float = 1.5
    score_spread: float = 0.7  # in logits

    # Odometry: a filter's output, wandering slowly around the truth, without drift.
    odometry_position_sd_m: float = 0.015
    odometry_yaw_sd_rad: float = 0.0015
    odometry_correlation_s: float = 2.0
    odometry_white_sd_m: float = 0.001
    odometry_velocity_sd_mps: float = 0.02
    odometry_yaw_rate_sd_radps: float = 0.003

    # Ground truth reaches this far.
    truth_range_m: float = 60.0

    def to_json(self) -> str:
        """Returns all parameters as JSON, keys sorted."""
        return json.dumps(asdict(self), sort_keys=True)

    def checksum(self) -> str:
        """Returns the SHA-256 of `to_json`, which a test pins."""
        return hashlib.sha256(self.to_json().encode()).hexdigest()
