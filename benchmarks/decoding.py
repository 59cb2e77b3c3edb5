"""What decoding a message of a camera's detections costs, by format and by library, side by side.

OMP_NUM_THREADS=1 python -m benchmarks.decoding [--boxes 20] [--seconds 1]

The same boxes as `pcgan.v1.CameraDetections` and as vision_msgs 4.x `Detection2DArray` in CDR. Ours ends in the checked
dataclass of arrays; the others end in objects of theirs, from which the arrays would still have to be made.
"""

import argparse
import json
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory
from rich.console import Console
from rich.table import Table
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from replay import ros, ros_reader
from replay.logged_message import LoggedSchema
from schemas import codec
from schemas.messages import CameraDetections

STAMP_NS = 1_700_000_000_000_000_000
TYPE = "vision_msgs/msg/Detection2DArray"


def make_detections(boxes: int, seed: int = 0) -> CameraDetections:
    """Returns that many boxes of people in an image; the same arguments give the same ones."""
    rng = np.random.default_rng(seed)
    corners = rng.uniform(0, 1000, (boxes, 2)).astype(np.float32)
    sizes = rng.uniform(20, 200, (boxes, 2)).astype(np.float32)
    scores = rng.uniform(0.3, 1, boxes).astype(np.float32)
    return CameraDetections(
        STAMP_NS, "gmsl_centre_link", np.hstack([corners, corners + sizes]), scores, ("person",) * boxes
    )


def calls(boxes: int) -> dict[str, Callable[[], object]]:
    """Returns one way of decoding per row of the table."""
    detections = make_detections(boxes)
    protobuf = codec.encode(detections)
    store = get_typestore(Stores.ROS2_JAZZY)
    types = {}
    for path in ros_reader.SHIPPED.glob("vision_msgs/*.msg"):
        types |= get_types_from_msg(path.read_text(), f"vision_msgs/msg/{path.stem}")
    store.register(types)
    definition = store.generate_msgdef(TYPE, ros_version=2)[0].encode()
    cdr = bytes(store.serialize_cdr(_ros_message(store.types, detections), TYPE))
    [ours] = ros.decoders(LoggedSchema(TYPE, "ros2msg", definition), "cdr")
    theirs = DecoderFactory().decoder_for("cdr", Schema(1, definition, "ros2msg", TYPE))
    assert theirs is not None
    np.testing.assert_array_equal(ours.decode(cdr).boxes_px, detections.boxes_px)
    return {
        "pcgan.v1, to arrays": partial(codec.decode, CameraDetections, protobuf),
        "CDR, ours, to arrays": partial(ours.decode, cdr),
        "CDR, rosbags, to objects": partial(store.deserialize_cdr, cdr, TYPE),
        "CDR, mcap-ros2-support, to objects": partial(theirs, cdr),
    }


def _ros_message(types: dict[str, type], detections: CameraDetections) -> object:
    """Returns the boxes as an object of rosbags."""
    vision, geometry = "vision_msgs/msg", "geometry_msgs/msg"
    time = types["builtin_interfaces/msg/Time"](STAMP_NS // 10**9, STAMP_NS % 10**9)
    header = types["std_msgs/msg/Header"](time, detections.frame_id)
    nowhere = types[f"{geometry}/Pose"](
        types[f"{geometry}/Point"](0.0, 0.0, 0.0), types[f"{geometry}/Quaternion"](0.0, 0.0, 0.0, 1.0)
    )
    pose = types[f"{geometry}/PoseWithCovariance"](nowhere, np.zeros(36))
    found = []
    for (x0, y0, x1, y1), score in zip(
        detections.boxes_px.astype(float).tolist(), detections.scores.astype(float).tolist(), strict=True
    ):
        hypothesis = types[f"{vision}/ObjectHypothesis"]("person", score)
        centre = types[f"{vision}/Pose2D"](types[f"{vision}/Point2D"]((x0 + x1) / 2, (y0 + y1) / 2), 0.0)
        box = types[f"{vision}/BoundingBox2D"](centre, x1 - x0, y1 - y0)
        result = types[f"{vision}/ObjectHypothesisWithPose"](hypothesis, pose)
        found.append(types[f"{vision}/Detection2D"](header, [result], box, ""))
    return types[TYPE](header, found)


def microseconds(call: Callable[[], object], seconds: float) -> tuple[float, float]:
    """Returns the median and the least time of a call, repeated for about so long, after some to warm up."""
    for _ in range(10):
        call()
    spent: list[float] = []
    while sum(spent) < 1e6 * seconds or len(spent) < 50:
        start = time.perf_counter()
        call()
        spent.append(1e6 * (time.perf_counter() - start))
    return float(np.median(spent)), min(spent)


def main() -> None:
    """Measures, prints a table, and writes the figures if asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--boxes", type=int, default=20, help="in each message (20)")
    parser.add_argument("--seconds", type=float, default=1.0, help="for each figure (1)")
    parser.add_argument("--json", type=Path, help="write the figures to this file as well")
    arguments = parser.parse_args()
    figures = {name: microseconds(call, arguments.seconds) for name, call in calls(arguments.boxes).items()}
    table = Table("", "median", "least", title=f"us per message of {arguments.boxes} boxes")
    for name, (median, least) in figures.items():
        table.add_row(name, f"{median:.1f}", f"{least:.1f}")
    Console(width=100).print(table)
    if arguments.json is not None:
        arguments.json.write_text(json.dumps({"median_and_least_us": figures}, indent=1) + "\n")


if __name__ == "__main__":
    main()
