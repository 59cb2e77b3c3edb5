"""How many false measurements a scan brings: counted, while tracking, from what no track explains."""

import math
from dataclasses import dataclass

import numpy as np

from schemas.messages import FloatArray

FEWEST_MEASUREMENTS = 4  # whose spread says how large an area the sensor looks at
SMALLEST_AREA_M2 = 100.0
STRAY = 16.0  # times the median squared distance from the middle
LARGEST_CHANGE = 10.0  # of the rate against the setting it starts from


@dataclass(frozen=True)
class ClutterEstimate:
    """What recent scans say of clutter."""

    per_m2: float  # false measurements per scan and square metre
    area_m2: float  # that measurements come from; 0: not known yet


def updated(
    estimate: ClutterEstimate,
    positions_m: FloatArray,
    unexplained: float,
    dt_s: float,
    *,
    prior: float,
    memory_s: float,
) -> ClutterEstimate:
    """Returns the estimate after one more scan: an exponential average over the scans of about `memory_s`.

    Args:
        estimate: after the scan before.
        positions_m: (M, 2) the scan's measurements.
        unexplained: how many of them are no label's, expected.
        dt_s: since the scan before.
        prior: rate to start from; the estimate stays within a factor of LARGEST_CHANGE of it.
        memory_s: time constant.
    """
    area = estimate.area_m2
    share = -math.expm1(-dt_s / memory_s)
    if len(positions_m) >= FEWEST_MEASUREMENTS:
        seen = max(area_of(positions_m), SMALLEST_AREA_M2)
        # Few points seldom reach as far as the sensor does: believe the larger areas.
        area = seen if seen > area else area + share * (seen - area)
    if area == 0:
        return estimate
    rate = estimate.per_m2 + share * (unexplained / area - estimate.per_m2)
    return ClutterEstimate(min(max(rate, prior / LARGEST_CHANGE), prior * LARGEST_CHANGE), area)


def area_of(positions_m: FloatArray) -> float:
    """Returns the area that points (M, 2) are spread over: half of a disc's lie within 1 / sqrt(2) of its radius.

    What lies much farther out than half of the points is left out, so that one stray point does not stretch it.
    """
    for _ in range(2):
        delta = positions_m - np.add.reduce(positions_m) / len(positions_m)
        squared = delta[:, 0] ** 2 + delta[:, 1] ** 2
        middle = [(len(squared) - 1) // 2, len(squared) // 2]
        median = float(np.partition(squared, middle)[middle].sum()) / 2  # as np.median, in a third of its time
        positions_m = positions_m[squared <= STRAY * median]
    return 2 * math.pi * median
