"""Logged bytes -> message dataclasses, by the schema's name. One stage must not care how a log was written."""

from collections.abc import Callable
from functools import partial
from typing import Any

from replay import foxglove
from schemas import codec

# schema name -> (name of the dataclass, decoder); a decoder of transforms returns a tuple of them
DECODERS: dict[str, tuple[str, Callable[[bytes], Any]]] = {
    **{
        schema: (message_type.__name__, partial(codec.decode, message_type))
        for schema, message_type in codec.MESSAGE_TYPES.items()
    },
    "foxglove.CameraCalibration": ("CameraCalibration", partial(foxglove.decode, "foxglove.CameraCalibration")),
    "foxglove.CompressedImage": ("CompressedImage", partial(foxglove.decode, "foxglove.CompressedImage")),
    "foxglove.FrameTransform": ("Transform", partial(foxglove.decode, "foxglove.FrameTransform")),
    "foxglove.FrameTransforms": ("Transform", partial(foxglove.decode, "foxglove.FrameTransforms")),
    "foxglove.Odometry": ("VehiclePose", partial(foxglove.decode, "foxglove.Odometry")),
    "foxglove.PoseInFrame": ("VehiclePose", partial(foxglove.decode, "foxglove.PoseInFrame")),
}
