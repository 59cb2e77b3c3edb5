"""Roles: which topic is what and why, and a clear word where one is missing, unfit or in doubt."""

import pytest

from replay.errors import LogError
from replay.logged_message import NO_SCHEMA, ChannelInfo, LoggedSchema, RawMessage
from replay.roles import (
    MESSAGES,
    WHAT,
    CameraChoice,
    RoleChoices,
    assign_roles,
    decoded,
    live_roles,
    schemas_for,
    static_only,
)
from schemas import codec, topics
from schemas.codec import CodecError

CLUSTERS, ODOMETRY = "/velodyne/front/clusters", "/vn100/odometry"


def channel(topic, schema, encoding="protobuf", count=10):
    return ChannelInfo(topic, LoggedSchema(schema, encoding, b""), encoding, count)


LIDAR = channel(CLUSTERS, "pcgan.v1.LidarClusters")
POSE = channel(ODOMETRY, "pcgan.v1.VehiclePose")
TF_STATIC = channel("/tf_static", "foxglove.FrameTransforms")
TF = channel("/tf", "foxglove.FrameTransforms")


def camera(name, kinds=("detections", "camera_info"), folder="/gmsl"):
    schemas = {
        "detections": "pcgan.v1.CameraDetections",
        "camera_info": "foxglove.CameraCalibration",
        "image": "foxglove.CompressedImage",
    }
    return [channel(f"{folder}/{name}/{kind}", schemas[kind]) for kind in kinds]


def roles_of(roles):
    return {topic: (reading.role, reading.camera) for topic, reading in roles.readings.items()}


# --- found by themselves ---------------------------------------------------------------------------------------------


def test_default_names():
    roles = assign_roles([LIDAR, POSE, TF_STATIC, *camera("A0"), *camera("B1")])
    assert roles.cameras == ("A0", "B1")
    assert (roles.scans, roles.pose) == (CLUSTERS, ODOMETRY)
    assert roles.topics("calibration", camera="B1") == ("/gmsl/B1/camera_info",)
    assert roles.readings[CLUSTERS].why == "the default name"


def test_other_names_are_found_by_their_messages():
    channels = [
        LIDAR._replace(topic="/lidar/objects"),
        POSE._replace(topic="/localization/odometry"),
        channel("/transforms", "foxglove.FrameTransform"),
        *camera("front", folder="/cameras"),
        channel("/somewhere/truth", "pcgan.v1.GroundTruthFrame"),
        channel("/diagnostics", "x.Y", "cdr"),
    ]
    roles = assign_roles(channels)
    assert roles_of(roles) == {
        "/lidar/objects": ("clusters", None),
        "/localization/odometry": ("pose", None),
        "/transforms": ("transforms", None),
        "/cameras/front/detections": ("camera", "front"),
        "/cameras/front/camera_info": ("calibration", "front"),
        "/somewhere/truth": ("truth", None),
    }
    assert roles.readings["/lidar/objects"].why == "the only topic with pcgan.v1.LidarClusters"
    assert all(reading.why for reading in roles.readings.values())


def test_a_default_name_goes_before_others_that_are_fit():
    roles = assign_roles([LIDAR, POSE, POSE._replace(topic="/odom"), LIDAR._replace(topic="/objects")])
    assert (roles.scans, roles.pose) == (CLUSTERS, ODOMETRY)


def test_our_own_outputs_are_no_inputs_where_there_are_others():
    ours = channel("/pcgan/vehicle_pose", "pcgan.v1.VehiclePose")
    assert assign_roles([LIDAR, POSE._replace(topic="/odom"), ours]).pose == "/odom"
    assert assign_roles([LIDAR, ours]).pose == "/pcgan/vehicle_pose"


def test_a_topic_is_fit_if_some_of_its_messages_are():
    others = [LIDAR._replace(schema=LoggedSchema(name, "", b""), encoding="cdr") for name in ("a", "z")]
    assert assign_roles([others[0], LIDAR, others[1], POSE]).scans == CLUSTERS


def test_points_serve_where_there_are_no_clusters():
    points = channel("/points", "foxglove.PointCloud")
    assert roles_of(assign_roles([points, POSE]))["/points"] == ("points", None)
    assert "/points" not in assign_roles([points, LIDAR, POSE]).readings


def test_transforms_say_where_the_vehicle_is_where_no_pose_does():
    roles = assign_roles([LIDAR, TF, TF_STATIC])
    assert roles.readings["/tf"].role == "pose"
    assert "transforms" in roles.readings["/tf"].why
    assert roles.topics("transforms") == ("/tf_static",)
    assert assign_roles([LIDAR, TF, TF_STATIC, POSE]).topics("transforms") == ("/tf", "/tf_static")


def test_static_transforms_are_told_by_their_name():
    assert static_only(["/tf", "/car/tf_static"]) == ["/car/tf_static"]
    assert static_only(["/transforms"]) == ["/transforms"]


def test_the_lidar_alone_is_enough_and_what_is_missing_is_said():
    roles = assign_roles([LIDAR, POSE])
    assert roles.cameras == ()
    assert roles.missing == ("camera detections: the LiDAR alone decides who is a pedestrian", "transforms")


def test_missing_cameras_of_the_usual_rig_are_named():
    missing = assign_roles([LIDAR, POSE, TF_STATIC, *camera("A0")]).missing
    assert missing == tuple(f"/gmsl/{name}/detections" for name in topics.CAMERAS if name != "A0")
    assert assign_roles([LIDAR, POSE, TF_STATIC, *camera("front", folder="/cameras")]).missing == ()


# --- cameras ---------------------------------------------------------------------------------------------------------


def test_what_lies_beside_the_detections_is_of_their_camera():
    roles = assign_roles([LIDAR, POSE, *camera("A0", ["detections", "camera_info", "image"]), *camera("A1")])
    assert roles.topics("image", camera="A0") == ("/gmsl/A0/image",)
    assert roles.topics("image", camera="A1") == ()
    assert roles.readings["/gmsl/A1/camera_info"].why == "beside /gmsl/A1/detections"


def test_frames_tell_whose_calibration_it_is_where_names_do_not():
    channels = [
        LIDAR,
        POSE,
        channel("/yolo/left", "pcgan.v1.CameraDetections"),
        channel("/yolo/right", "pcgan.v1.CameraDetections"),
        channel("/info_0", "foxglove.CameraCalibration"),
        channel("/info_1", "foxglove.CameraCalibration"),
    ]
    frames = {"/yolo/left": "left_optical", "/info_1": "left_optical", "/yolo/right": "r", "/info_0": "r"}
    roles = assign_roles(channels, frame_of=frames.get)
    assert roles.cameras == ("yolo_left", "yolo_right")
    assert roles.topics("calibration", camera="yolo_left") == ("/info_1",)
    assert "left_optical" in roles.readings["/info_1"].why


def test_a_camera_without_calibration_is_named_with_the_way_out():
    text = (
        r"camera A0 has detections \(/gmsl/A0/detections\) but no calibration: .*; "
        r"its topics are /gmsl/A0/detections, /velodyne/front/clusters, /vn100/odometry; "
        r"use --role camera\.A0:=/gmsl/A0/detections --role calibration\.A0:=TOPIC"
    )
    with pytest.raises(LogError, match=text):
        assign_roles([LIDAR, POSE, *camera("A0", ["detections"])])


def test_a_calibration_without_detections_makes_no_camera():
    assert assign_roles([LIDAR, POSE, *camera("A0", ["camera_info"])]).cameras == ()


# --- chosen ----------------------------------------------------------------------------------------------------------


def test_a_choice_goes_before_a_default_name():
    roles = assign_roles([LIDAR, POSE, POSE._replace(topic="/odom")], RoleChoices(pose="/odom"))
    assert roles.pose == "/odom"
    assert roles.readings["/odom"].why == "chosen"


def test_chosen_cameras_are_all_there_are():
    choices = RoleChoices().with_role("camera.rear", "/gmsl/A1/detections")
    roles = assign_roles([LIDAR, POSE, *camera("A0"), *camera("A1")], choices)
    assert roles.cameras == ("rear",)
    assert roles.topics("calibration", camera="rear") == ("/gmsl/A1/camera_info",)
    assert assign_roles([LIDAR, POSE, *camera("A0")], RoleChoices(cameras={})).cameras == ()


def test_roles_as_options():
    choices = RoleChoices()
    for role, topic in (
        ("camera.front", "/front/boxes"),
        ("calibration.front", "/front/info"),
        ("image.front", "/front/jpeg"),
        ("camera", "/gmsl/A0/detections"),
        ("pose", "/odom"),
        ("transforms", "/tf_a"),
        ("transforms", "/tf_b"),
    ):
        choices = choices.with_role(role, topic)
    assert choices.cameras == {
        "front": CameraChoice(detections="/front/boxes", calibration="/front/info", image="/front/jpeg"),
        "A0": CameraChoice(detections="/gmsl/A0/detections"),
    }
    assert (choices.pose, choices.transforms) == ("/odom", ("/tf_a", "/tf_b"))


def test_a_second_camera_of_one_name_does_not_take_the_first_one_s_place():
    choices = RoleChoices().with_role("camera", "/yolo/front")
    with pytest.raises(LogError, match=r"/yolo/front and /yolo/rear would both be of the camera yolo; name them with"):
        choices.with_role("camera", "/yolo/rear")


@pytest.mark.parametrize("role", ["odometry", "pose.front", "calibration", "calibration.rear", ""])
def test_roles_nobody_knows_are_refused(role):
    with pytest.raises(LogError, match="role"):
        RoleChoices().with_role(role, "/x")


def test_tracks_take_the_place_of_clusters_and_cameras():
    tracks = channel("/tracks", "pcgan.v1.TrackFrame")
    channels = [tracks, LIDAR, POSE, *camera("A0")]
    assert roles_of(assign_roles(channels, RoleChoices(tracks="/tracks"))) == {
        "/tracks": ("tracks", None),
        ODOMETRY: ("pose", None),
    }
    assert assign_roles(channels).scans == CLUSTERS  # never without being asked
    with pytest.raises(LogError, match=r"no LiDAR clusters and no LiDAR points: .* use --tracks /tracks"):
        assign_roles([tracks, POSE])


# --- errors ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("channels", "text"),
    [
        (
            [POSE],
            r"the log has no LiDAR clusters and no LiDAR points: looked for /velodyne/front/clusters and for any topic "
            r"of .*pcgan\.v1\.LidarClusters.*; its topics are /vn100/odometry$",
        ),
        (
            [LIDAR],
            r"the log has no vehicle pose: looked for /vn100/odometry and for any topic of .*pcgan\.v1\.VehiclePose.*; "
            r"its topics are /velodyne/front/clusters; use --role pose:=TOPIC",
        ),
        ([], r"the log has no LiDAR clusters .*; its topics are none"),
    ],
    ids=["no lidar", "no pose", "nothing"],
)
def test_a_missing_topic_names_what_was_looked_for_and_what_there_is(channels, text):
    with pytest.raises(LogError, match=text):
        assign_roles(channels)


@pytest.mark.parametrize(("role", "fit"), [("pose", POSE), ("clusters", LIDAR)])
def test_several_that_are_fit_are_listed_with_the_way_out(role, fit):
    rest = [c for c in (LIDAR, POSE) if c is not fit]
    text = rf"2 topics could be the {WHAT[role]}: /a, /b; choose one with --role {role}:=TOPIC"
    with pytest.raises(LogError, match=text):
        assign_roles([*rest, fit._replace(topic="/a"), fit._replace(topic="/b")])


def test_a_wrong_schema_is_named():
    wrong = channel(CLUSTERS, "foxglove.Grid")
    text = (
        r"/velodyne/front/clusters cannot serve as LiDAR clusters: wanted .*pcgan\.v1\.LidarClusters.*, "
        r"found foxglove\.Grid in protobuf"
    )
    with pytest.raises(LogError, match=text):
        assign_roles([wrong, POSE])
    with pytest.raises(LogError, match=text):
        assign_roles([wrong, POSE], RoleChoices(clusters=CLUSTERS))


def test_an_unknown_encoding_is_named():
    with pytest.raises(
        LogError, match=r"/vn100/odometry cannot serve as vehicle pose: .* found nav_msgs/Odometry in x"
    ):
        assign_roles([LIDAR, channel(ODOMETRY, "nav_msgs/Odometry", "x")])
    with pytest.raises(LogError, match="found no schema in no encoding"):
        assign_roles([LIDAR, ChannelInfo(ODOMETRY, NO_SCHEMA, "", 10)])


def test_a_choice_the_log_lacks_lists_what_it_has():
    with pytest.raises(LogError, match=r"the log has no topic /odom; its topics are /velodyne/front/clusters, /vn100"):
        assign_roles([LIDAR, POSE], RoleChoices(pose="/odom"))


def test_two_roles_cannot_share_a_topic():
    choices = RoleChoices(cameras={name: CameraChoice(detections="/gmsl/A0/detections") for name in ("a", "b")})
    with pytest.raises(LogError, match="camera_info cannot play two roles, calibration of a and calibration of b;"):
        assign_roles([LIDAR, POSE, *camera("A0")], choices)


def test_two_kinds_of_scans_are_one_too_many():
    with pytest.raises(LogError, match="only one of points and tracks can give the frames"):
        assign_roles([LIDAR, POSE], RoleChoices(points="/p", tracks="/t"))


# --- live and decoding -----------------------------------------------------------------------------------------------


def test_a_live_node_listens_to_the_usual_topics_or_to_those_chosen():
    roles = live_roles()
    assert roles.cameras == topics.CAMERAS
    assert (roles.scans, roles.pose) == (CLUSTERS, ODOMETRY)
    assert roles.topics("transforms") == ("/tf_static", "/tf")
    roles = live_roles(RoleChoices(points="/p", pose="/odom").with_role("camera", "/front/boxes"))
    assert (roles.scans, roles.pose, roles.cameras) == ("/p", "/odom", ("front",))
    assert roles.topics("calibration", camera="front") == ("/front/camera_info",)


def test_a_message_is_decoded_as_its_role_wants_it(make):
    reading = assign_roles([LIDAR, POSE]).readings[CLUSTERS]
    message = RawMessage(CLUSTERS, 1, LIDAR.schema, "protobuf", codec.encode(make.scan(5)))
    (scan,) = decoded(message, reading)
    assert scan.stamp_ns == make.stamp(5)
    with pytest.raises(CodecError, match=r"pcgan\.v1\.VehiclePose in protobuf is no clusters"):
        decoded(message._replace(schema=POSE.schema), reading)


def test_every_role_has_a_schema():
    assert set(MESSAGES) == set(WHAT)
    for role in WHAT:
        assert schemas_for(role), role
