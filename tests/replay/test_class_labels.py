"""Labels of boxes and tracks: where none means a pedestrian, somebody has to say so."""

from dataclasses import replace

import pytest

from replay import ReplaySettings
from replay.class_labels import KEPT, ClassLabels, unmatched_line
from replay.live_tracker import LiveTracker
from replay.log_info import describe_log
from replay.simulator.sensor_suite import CLUSTERS_TOPIC
from schemas import codec
from schemas.messages import CameraDetections


def labelled(make, *labels):
    boxes = make.boxes(0, [(0, 0, 9, 9)] * len(labels))
    return replace(boxes, labels=labels)


@pytest.fixture
def coco(short_drive, edit_log):
    """The short drive, whose detector calls people 0."""

    def renamed(topic, data):
        if not topic.endswith("/detections"):
            return data
        boxes = codec.decode(CameraDetections, data)
        return codec.encode(replace(boxes, labels=tuple("0" if name == "person" else "2" for name in boxes.labels)))

    return edit_log(short_drive, lambda log: [(topic, at, renamed(topic, data)) for topic, at, data in log])


def test_labels_are_unmatched_only_if_none_of_them_means_a_pedestrian(make):
    labels = ClassLabels(("person",))
    assert labels.unmatched == []
    labels.see(make.scan(0))
    labels.see(labelled(make, "0", "car", "0"))
    assert labels.unmatched == ["0", "car"]
    labels.see(labelled(make, "person"))
    assert labels.unmatched == []
    assert labels.counts["0"] == 2


def test_a_flood_of_labels_is_bounded(make):
    labels = ClassLabels(("person",))
    for k in range(3 * KEPT):
        labels.see(labelled(make, f"label {k}"))
    assert len(labels.counts) == KEPT
    assert unmatched_line(labels.unmatched).endswith("label 7, ...: say which does with --pedestrian-label NAME")


def test_a_replay_says_that_no_label_means_a_pedestrian_and_the_option_mends_it(pcgan, coco, model, tmp_path):
    arguments = ("replay", coco, "--predictor", "inline", "--model", model, "-o", tmp_path / "out.mcap")
    outcome = pcgan(*arguments)
    assert outcome.code == 0
    assert "no label means a pedestrian; seen were " in outcome.out
    assert "--pedestrian-label" not in pcgan(*arguments, "--pedestrian-label", "0").out


def test_info_lists_the_labels(coco, short_drive):
    description = describe_log([coco])
    assert set(description["labels"]) == {"0"}
    assert description["unmatched_labels"] == ["0"]
    assert describe_log([short_drive])["unmatched_labels"] == []
    settings = ReplaySettings.model_validate({"tracking": {"fusion": {"pedestrian_labels": ["0"]}}})
    assert describe_log([coco], settings)["unmatched_labels"] == []


def test_a_live_tracker_misses_a_pedestrian_label(coco):
    from replay.log_reader import LogReader

    tracker = LiveTracker()
    for message in LogReader([coco]).messages():
        tracker.push(message)
        if message.topic == CLUSTERS_TOPIC:
            break
    assert any("no label means a pedestrian" in words for words in tracker.missing())
