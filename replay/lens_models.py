"""What recordings say of lenses -> the model and coefficients that `tracking.camera` knows."""

import numpy as np

from schemas.messages import FloatArray

_OURS = {"fisheye": "equidistant", "kannala_brandt": "equidistant"}  # OpenCV's name, Foxglove's


def lens(model: str, distortion: FloatArray) -> tuple[str, FloatArray]:
    """Returns a lens's model and distortion; of images that are rectified, or simulated, and so have none, zeros."""
    if model in ("", "plumb_bob") and len(distortion) == 0:
        return "plumb_bob", np.zeros(5)
    return _OURS.get(model, model), distortion
