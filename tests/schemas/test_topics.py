"""The table of topics."""

import zenoh

from schemas import codec, messages, topics

ALL = (*topics.INPUTS, *topics.OUTPUTS)


def test_names_are_unique_and_absolute():
    names = [topic.name for topic in ALL]
    assert len(set(names)) == len(names)
    assert all(name.startswith("/") and not name.endswith("/") for name in names)


def test_every_message_exists():
    for topic in ALL:
        assert hasattr(messages, topic.message) or topic.message == "foxglove.SceneUpdate", topic


def test_every_camera_has_detections_calibration_and_image():
    for camera in topics.CAMERAS:
        roles = {topic.role for topic in topics.INPUTS if topic.name.startswith(f"/gmsl/{camera}/")}
        assert roles == {"camera", "calibration", "image"}


def test_what_goes_over_the_bus_has_a_protobuf():
    for topic in (topics.TRACKS, topics.PREDICTIONS, topics.VEHICLE_POSE):
        assert f"pcgan.v1.{topic.message}" in codec.MESSAGE_TYPES


def test_zenoh_keys_are_names_without_the_leading_slash():
    assert topics.zenoh_key(topics.TRACKS) == "pcgan/tracks"
    assert topics.zenoh_key(topics.TRACKS, "car7") == "car7/pcgan/tracks"
    assert topics.zenoh_key(topics.TRACKS, "/fleet/car7/") == "fleet/car7/pcgan/tracks"


def test_zenoh_takes_every_key():
    keys = [topics.zenoh_key(topic, namespace) for topic in ALL for namespace in ("", "car7")]
    assert [str(zenoh.KeyExpr(key)) for key in keys] == keys
    assert len(set(keys)) == len(keys)
