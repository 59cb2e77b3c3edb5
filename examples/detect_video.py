"""Runs a detector of your choice over the videos beside a USyd bag, and writes its boxes as MCAP for `pcgan replay`.

Week23.bag has Week23-A0.h264, Week23-A1.h264, ... beside it; its /gmsl/A0/frame_info says which frame was taken when.
Needs opencv-python; the default detector needs torchvision, too. See docs/usyd.md.
"""

import argparse
import importlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
from mcap_protobuf.writer import Writer
from rosbags.highlevel import AnyReader

from schemas import codec
from schemas.messages import CameraDetections

try:
    import cv2
except ImportError:
    raise SystemExit("this example reads videos with OpenCV: pip install opencv-python torchvision") from None

Detect = Callable[
    [np.ndarray], tuple[np.ndarray, np.ndarray, list[str]]
]  # RGB (H, W, 3) -> boxes (M, 4), scores, labels


def torchvision_detector() -> Detect:
    """Returns a small COCO detector; its weights are downloaded the first time."""
    import torch
    from torchvision.models import detection

    weights = detection.FasterRCNN_MobileNet_V3_Large_FPN_Weights.DEFAULT
    net, names = detection.fasterrcnn_mobilenet_v3_large_fpn(weights=weights).eval(), weights.meta["categories"]

    def detect(image: np.ndarray) -> tuple[np.ndarray, np.ndarray, list[str]]:
        with torch.inference_mode():
            found = net([torch.from_numpy(image).permute(2, 0, 1) / 255])[0]
        return found["boxes"].numpy(), found["scores"].numpy(), [names[k] for k in found["labels"]]

    return detect


def find_video(bag: Path, camera: str) -> Path:
    """Returns the video of a camera beside a bag."""
    for path in sorted(bag.parent.glob(f"{bag.stem}*{camera}*.*")):
        return path
    raise SystemExit(f"no video of {camera} beside {bag}: looked for {bag.stem}*{camera}*.*")


def run(bag: Path, output: Path, detect: Detect, cameras: list[str], least_score: float) -> int:
    """Writes a CameraDetections for every frame of the cameras' videos; returns how many."""
    written = 0
    with AnyReader([bag]) as reader, output.open("wb") as stream, Writer(stream) as writer:
        videos = {camera: cv2.VideoCapture(str(find_video(bag, camera))) for camera in cameras}
        next_frame, bias_ns = dict.fromkeys(cameras, 0), dict[str, int]()
        topics = {f"/gmsl/{camera}/frame_info": camera for camera in cameras}
        for connection, log_time_ns, data in reader.messages([c for c in reader.connections if c.topic in topics]):
            info, camera = reader.deserialize(data, connection.msgtype), topics[connection.topic]
            header_ns = info.header.stamp.sec * 1_000_000_000 + info.header.stamp.nanosec
            exposed_ns = info.camera_timestamp * 1000
            bias_ns.setdefault(camera, header_ns - exposed_ns)
            if abs(bias_ns[camera]) > 500_000_000:  # the cameras' computer has a clock of its own
                exposed_ns += bias_ns[camera]
            if info.frame_counter < next_frame[camera]:  # told twice; the video has gone on
                continue
            while next_frame[camera] < info.frame_counter:  # seeking in H.264 is not reliable
                videos[camera].grab()
                next_frame[camera] += 1
            there, image = videos[camera].read()
            next_frame[camera] += 1
            if not there:
                continue
            boxes, scores, labels = detect(cv2.cvtColor(image, cv2.COLOR_BGR2RGB))
            good = np.flatnonzero(scores >= least_score)
            message = CameraDetections(
                exposed_ns, info.header.frame_id, boxes[good], scores[good], tuple(labels[k] for k in good)
            )
            writer.write_message(f"/gmsl/{camera}/detections", codec.to_protobuf(message), log_time_ns, exposed_ns)
            written += 1
    return written


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bag", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--cameras", nargs="+", default=["A0", "A1", "A2"], help="those with known mounts by default")
    parser.add_argument("--detector", default="", metavar="MODULE:FUNCTION", help="a function that returns a detector")
    parser.add_argument("--least-score", type=float, default=0.3)
    given = parser.parse_args()
    module, _, function = given.detector.partition(":")
    detector = getattr(importlib.import_module(module), function)() if module else torchvision_detector()
    count = run(given.bag, given.output, detector, given.cameras, given.least_score)
    print(f"{given.output}: boxes of {count} images")
