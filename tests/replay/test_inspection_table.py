"""What the tables of an inspection say, figure by figure."""

import io

from rich.console import Console

from replay.camera_check import CameraCheck
from replay.inspection import FrameReport
from replay.inspection_summary import InspectionLog
from replay.inspection_table import print_frame, print_recording, print_summary
from replay.recording_check import RecordingReport, TopicTiming


def printed(print_it, report) -> str:
    out = io.StringIO()
    print_it(report, Console(file=out, width=160))
    return out.getvalue()


def frame(*cameras) -> FrameReport:
    return FrameReport(1.5, 1_500_000_000, 0, cameras, 1, (), (), (), None)


def test_one_is_not_several():
    log = InspectionLog()
    log.add(frame())
    assert printed(print_summary, log.summary()).startswith("1 frame, 1.5 to 1.5 s of the log")
    log.add(frame())
    assert printed(print_summary, log.summary()).startswith("2 frames, ")
    assert "0 measurements, 0 pedestrian boxes in 1 camera, 1 track\n" in printed(print_frame, frame("A0"))


def recording(*cameras: CameraCheck) -> RecordingReport:
    names = [check.topic for check in cameras]
    topics = [TopicTiming(name, "camera", 9, 0, 30.0, 0.5, None, None, 1.0, 0, 0.03, 1.0) for name in names]
    return RecordingReport(tuple(topics), (), cameras, ())


def test_a_camera_with_few_boxes_says_how_many_fit():
    text = printed(print_recording, recording(CameraCheck("A0", "/gmsl/A0/detections", 21, 34)))
    assert "21 / 34" in text
    assert "no mount: there are too few boxes on people" in text


def test_without_cameras_the_boxes_are_not_to_blame():
    assert "checked: the stamps, no mount: there are no cameras" in printed(print_recording, recording())
