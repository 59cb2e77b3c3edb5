"""The vehicle's pose at any recent time, between the logged ones."""

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from schemas.messages import VehiclePose

KEEP_NS = 3_000_000_000
MAX_EXTRAPOLATION_NS = 50_000_000
DIFFERENCE_NS = 100_000_000  # on either side of a stamp, for poses logged without a velocity
MAX_GAP_NS = 500_000_000  # poses further apart than this do not bracket anything


@dataclass(frozen=True, eq=False)
class PosesAt:
    """The vehicle's poses at S asked stamps."""

    map_from_vehicle: NDArray[np.float64]  # (S, 4, 4)  meaningless where not known
    known: NDArray[np.bool_]  # (S,)  False: no logged pose within reach
    extrapolated: NDArray[np.bool_]  # (S,)


class PoseBuffer:
    """The last few seconds of poses, in stamp order."""

    def __init__(self) -> None:
        self._stamps_ns: list[int] = []
        self._poses: list[VehiclePose] = []
        self._rows: list[list[float]] = []  # position and quaternion of each, 7 numbers

    @property
    def latest_ns(self) -> int:
        """Stamp of the newest pose; 0 without one."""
        return self._stamps_ns[-1] if self._stamps_ns else 0

    def add(self, pose: VehiclePose) -> None:
        """Takes a pose; one out of order is put in its place, one of a known stamp replaces.

        One in another frame ends what was before: between two frames there is nothing to interpolate.
        """
        if self._poses and pose.frame_id != self._poses[-1].frame_id:
            for column in (self._stamps_ns, self._poses, self._rows):
                column.clear()
        index = bisect_left(self._stamps_ns, pose.stamp_ns)
        row = [*pose.position_m.tolist(), *pose.quaternion_xyzw.tolist()]
        if index < len(self._stamps_ns) and self._stamps_ns[index] == pose.stamp_ns:
            self._poses[index], self._rows[index] = pose, row
            return
        self._stamps_ns.insert(index, pose.stamp_ns)
        self._poses.insert(index, pose)
        self._rows.insert(index, row)
        if self._stamps_ns[0] < self.latest_ns - 2 * KEEP_NS:
            old = bisect_left(self._stamps_ns, self.latest_ns - KEEP_NS)
            del self._stamps_ns[:old], self._poses[:old], self._rows[:old]

    def nearest(self, stamp_ns: int) -> VehiclePose:
        """Returns the logged pose nearest in time; raises IndexError without any."""
        return self._poses[self._nearest_index(stamp_ns)]

    def velocity(self, stamp_ns: int) -> NDArray[np.float64]:
        """Returns the velocity (2,) in the odometry frame, m/s: as logged, or from the positions around the stamp."""
        pose = self.nearest(stamp_ns)
        if np.isfinite(pose.velocity_mps).all():
            velocity: NDArray[np.float64] = Rotation.from_quat(pose.quaternion_xyzw).apply(pose.velocity_mps)[:2]
            return velocity
        first = max(bisect_left(self._stamps_ns, stamp_ns - DIFFERENCE_NS) - 1, 0)
        last = min(bisect_left(self._stamps_ns, stamp_ns + DIFFERENCE_NS), len(self._stamps_ns) - 1)
        elapsed_ns = self._stamps_ns[last] - self._stamps_ns[first]
        if elapsed_ns == 0:
            return np.zeros(2)
        moved = self._poses[last].position_m - self._poses[first].position_m
        return np.asarray(moved[:2] / (elapsed_ns * 1e-9))

    def at(self, stamps_ns: Sequence[int]) -> PosesAt:
        """Interpolates positions linearly and rotations spherically between the bracketing poses.

        Past the newest or before the oldest pose, up to 50 ms are extrapolated from the two nearest.
        """
        S = len(stamps_ns)
        known = np.zeros(S, bool)
        extrapolated = np.zeros(S, bool)
        before, after, fractions = [], [], []
        for s, stamp_ns in enumerate(stamps_ns):
            pair = self._bracket(stamp_ns)
            if pair is None:
                continue
            first_ns, second_ns = self._stamps_ns[pair], self._stamps_ns[pair + 1]
            known[s] = True
            extrapolated[s] = not first_ns <= stamp_ns <= second_ns
            before.append(self._rows[pair])
            after.append(self._rows[pair + 1])
            fractions.append((stamp_ns - first_ns) / (second_ns - first_ns))
        poses = np.tile(np.eye(4), (S, 1, 1))
        if before:
            poses[known] = _interpolate(np.array(before), np.array(after), np.array(fractions))
        return PosesAt(poses, known, extrapolated)

    def _nearest_index(self, stamp_ns: int) -> int:
        after = bisect_left(self._stamps_ns, stamp_ns)
        if after == 0:
            return 0
        if after == len(self._stamps_ns):
            return after - 1
        return after - (stamp_ns - self._stamps_ns[after - 1] <= self._stamps_ns[after] - stamp_ns)

    def _bracket(self, stamp_ns: int) -> int | None:
        """Returns the index of the first of the two poses to interpolate or extrapolate from, or None."""
        stamps = self._stamps_ns
        if len(stamps) < 2:
            return None
        if not stamps[0] - MAX_EXTRAPOLATION_NS <= stamp_ns <= stamps[-1] + MAX_EXTRAPOLATION_NS:
            return None
        first = min(max(bisect_left(stamps, stamp_ns) - 1, 0), len(stamps) - 2)
        return first if stamps[first + 1] - stamps[first] <= MAX_GAP_NS else None


def _interpolate(
    start: NDArray[np.float64], end: NDArray[np.float64], fractions: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Returns map_from_vehicle (S, 4, 4) at `fractions` of the way between poses (S, 7), position and quaternion."""
    poses = np.tile(np.eye(4), (len(fractions), 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(_slerp(start[:, 3:], end[:, 3:], fractions)).as_matrix()
    poses[:, :3, 3] = start[:, :3] + fractions[:, None] * (end[:, :3] - start[:, :3])
    return poses


def _slerp(start: NDArray[np.float64], end: NDArray[np.float64], fractions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Spherical interpolation of unit quaternions (S, 4), the shorter way round (Shoemake 1985)."""
    cosine = np.einsum("sq,sq->s", start, end)
    end = np.where(cosine[:, None] < 0, -end, end)
    angle = np.arccos(np.minimum(np.abs(cosine), 1.0))
    # np.sinc keeps the ratio of sines finite where the two rotations are the same
    scale = np.sinc(angle / np.pi)
    first = (1 - fractions) * np.sinc((1 - fractions) * angle / np.pi) / scale
    second = fractions * np.sinc(fractions * angle / np.pi) / scale
    return np.asarray(first[:, None] * start + second[:, None] * end)
