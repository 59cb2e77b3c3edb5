import numpy as np
import pytest

from replay.simulator.motion import VehicleState
from replay.simulator.odometry_model import SimulatedOdometry
from replay.simulator.sensor_model import SensorModelV1


def test_odometry_wanders_by_centimetres_and_does_not_drift():
    model, yaw = SensorModelV1(), 1.1
    heading = np.array([np.cos(yaw), np.sin(yaw)])
    odometry = SimulatedOdometry(model, np.random.default_rng(0))
    errors, twists = [], []
    for k in range(12000):
        state = VehicleState(3.0 * 0.01 * k * heading, yaw, 3.0 * heading, 0.1)
        pose = odometry.pose(state, 0.01 * k, 1 + k)
        errors.append(pose.position_m[:2] - state.position_m)
        twists.append([*pose.velocity_mps, pose.angular_velocity_radps[2]])
    errors = np.array(errors)
    assert errors.std(axis=0) == pytest.approx([model.odometry_position_sd_m] * 2, rel=0.3)
    assert np.abs(errors[-4000:].mean(axis=0)).max() < 0.02
    assert np.abs(np.diff(errors, axis=0)).max() < 0.02  # smooth from message to message
    assert np.mean(twists, axis=0) == pytest.approx([3.0, 0.0, 0.0, 0.1], abs=0.01)
    assert 2 * np.arctan2(pose.quaternion_xyzw[2], pose.quaternion_xyzw[3]) == pytest.approx(yaw, abs=0.01)
