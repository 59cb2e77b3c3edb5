"""The simulated odometry filter: the vehicle's true state in, a slightly wandering `VehiclePose` out."""

import math

import numpy as np

from replay.simulator.motion import VehicleState
from replay.simulator.noise import CorrelatedNoise
from replay.simulator.rig import ODOMETRY_FRAME, VEHICLE_FRAME
from replay.simulator.sensor_model import SensorModelV1
from schemas.messages import VehiclePose

_VEHICLE_KEY = np.zeros(1, np.int64)


class SimulatedOdometry:
    """Turns the vehicle's states into poses, in order of time."""

    def __init__(self, model: SensorModelV1, rng: np.random.Generator):
        self._model = model
        self._rng = rng
        self._noise = CorrelatedNoise((model.odometry_correlation_s,) * 3, rng)

    def pose(self, vehicle: VehicleState, time_s: float, stamp_ns: int) -> VehiclePose:
        """Returns the filter's pose and twist of the vehicle at a time; the vehicle stays level on the ground."""
        model = self._model
        wander = self._noise.at(_VEHICLE_KEY, time_s)[0]  # (3,)
        white = self._rng.standard_normal(5)
        position = (
            vehicle.position_m + model.odometry_position_sd_m * wander[:2] + model.odometry_white_sd_m * white[:2]
        )
        yaw = vehicle.yaw_rad + model.odometry_yaw_sd_rad * float(wander[2])
        c, s = math.cos(yaw), math.sin(yaw)
        vx, vy = vehicle.velocity_mps
        forward, left = c * vx + s * vy, -s * vx + c * vy
        return VehiclePose(
            stamp_ns,
            ODOMETRY_FRAME,
            VEHICLE_FRAME,
            np.array([*position, 0.0]),
            np.array([0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)]),
            np.array([*(np.array([forward, left]) + model.odometry_velocity_sd_mps * white[2:4]), 0.0]),
            np.array([0.0, 0.0, vehicle.yaw_rate_radps + model.odometry_yaw_rate_sd_radps * float(white[4])]),
        )
