"""F and Q against filterpy and against their definition."""

import numpy as np
import pytest

from tracking.motion_model import process_noise, transition


@pytest.mark.parametrize("dt_s", [0.0, 0.05, 0.1, 1.0])
def test_process_noise_agrees_with_filterpy(dt_s):
    common = pytest.importorskip("filterpy.common")
    expected = common.Q_discrete_white_noise(2, dt_s, 1.5**2, block_size=2, order_by_dim=False)
    np.testing.assert_allclose(process_noise(dt_s, 1.5), expected, atol=1e-15)


def test_transition_moves_along_the_velocity():
    np.testing.assert_allclose(transition(0.5) @ [1, 2, 3, -4], [2.5, 0, 3, -4])
    np.testing.assert_allclose(transition(0.2) @ transition(0.3), transition(0.5))
